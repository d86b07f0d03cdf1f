"""The paper in ten pictures: tutorials/tour/*.png and tour.pdf, from the demo's file.

`python -m tutorials.tools.syllabus tour` draws them; tutorials/tour.md is their text.
`python -m tutorials.tools.tour` makes the other trainings again (the failures of the last picture,
and other rates), which takes some minutes. Their files are beside the pictures, so that nobody has
to train in order to draw.
"""

from dataclasses import replace

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages

from p4dgs_ref import output
from p4dgs_ref.codec import container, quantise
from p4dgs_ref.codec.file import decode, encode, quantised_of
from p4dgs_ref.report import evaluate, figures, inspect
from p4dgs_ref.scenes import load, simulator
from p4dgs_ref.scenes.files import write_image
from p4dgs_ref.training.presets import TINY
from p4dgs_ref.training.trainer import Trainer
from tutorials import tour_moving
from tutorials.tools import animation, handout, shared, show
from tutorials.tools.figures import STYLE, THREAD

PLACE = shared.FOLDER / "tour"
SCENE = simulator.read_description(load.find_scene("bouncing") / load.DESCRIPTION)
CAMERA, T = simulator.camera_at(SCENE, *np.radians((305, 26))), 0.3  # which all pictures show
VIEW = {"xlim": (1, 62), "ylim": (59, 10)}  # without the empty margins
DATA = (shared.FOLDER / "demo.p4dgs").read_bytes()
FILE = quantised_of(container.read_container(DATA))
MODEL, DESIGN = FILE.model, FILE.model.design
TRUTH = animation.truth(SCENE, CAMERA, T, MODEL.background)

SIDES = {
    name: simulator.camera_at(SCENE, *np.radians((azimuth, 26)))
    for name, azimuth in {"from one side": 30, "from the other": 210}.items()
}

# Of each of the paper's datasets: what it claims, the limits of PSNR in the picture, (MB, PSNR in
# dB) of P-4DGS at four rates, from its last table, and (MB, PSNR, frames/s) of both methods, from
# its first ones.
PAPER = (
    (
        "synthetic scenes (D-NeRF): “over 40×”",
        (34, 41),
        ((1.03, 38.10), (0.78, 37.73), (0.71, 37.38), (0.57, 35.10)),
        {"P-4DGS": ("1.039", "38.10", "262"), "D3DGS": ("39.45", "38.28", "149")},
    ),
    (
        "real scenes (NeRF-DS): “over 90×”",
        (23, 25.2),
        ((0.70, 24.18), (0.65, 23.93), (0.57, 23.60), (0.54, 23.34)),
        {"P-4DGS": ("0.704", "24.18", "274"), "D3DGS": ("59.38", "23.75", "58")},
    ),
)
SECTIONS = {  # in the order of the strip: label and colour
    "positions": ("positions", show.PARTS["position, masks"]),
    "masks": ("masks", show.GREY),
    "features": ("features", show.PARTS["feature"]),
    "scales": ("scales", show.PARTS["scales"]),
    "offset_scales": ("offset\nscales", show.PARTS["offset scales"]),
    "offsets": ("offsets", show.PARTS["offsets"]),
    "hash_grid": ("hash grid", show.CONTEXT),
    "deformation_mlp": ("motion network", show.TIME),
    "anchor_mlps": ("prediction\nnetworks", show.SPACE),
    "context_mlps": ("context\nnetworks", show.CONTEXT),
    "header": ("header", show.GREY),
}
# The paper's file of the scene T-Rex at its higher rate, in kB, with the colours of our sections.
T_REX = {
    "positions": 118,
    "features": 191,
    "scales": 99,
    "offsets": 188,
    "hash_grid": 18,
    "deformation_mlp": 241,
    "anchor_mlps": 38,
}


class Silent(np.random.Generator):
    """A generator that makes the noise of Eq. (7) zero: only this noise is drawn in float32."""

    def random(self, size=None, dtype=np.float64):
        return super().random(size) if dtype is np.float64 else np.full(size, 0.5, dtype)


PRICES = {0: "no rate", 4: "rate times 4", 16: "rate times 16", 100: "rate times 100"}
OTHERS = {  # title of a file: generator of training, and by what the demo's rate is multiplied
    "no noise": (Silent, 1),
    **{title: (np.random.Generator, price) for price, title in PRICES.items()},
}


def place_of(title):
    """The file of another training."""
    return PLACE / f"{title.replace(' ', '_')}.p4dgs"


def train():
    """Make the other trainings and write their files."""
    for title, (generator, price) in OTHERS.items():
        preset = replace(TINY, lambda_rate=price * TINY.lambda_rate)
        run = Trainer(load.load_scene("bouncing"), preset)
        run.rng = generator(run.rng.bit_generator)
        place_of(title).write_bytes(encode(run.run()))


# --- the pictures that are not in `show` ----------------------------------------------------------
def why(figure):
    """What a moving scene costs: ours, and those of the paper with P-4DGS and with D3DGS."""
    left, *panels = figure.subplot_mosaic("ab;ac", width_ratios=(1, 1.4)).values()
    count = len(MODEL.gaussians(T, CAMERA).x)
    explicit = evaluate.explicit_bytes(MODEL, count)
    for size, color in ((explicit, show.PALE), (len(DATA), show.SPACE)):
        side = np.sqrt(size)
        left.fill((0, side, side, 0), (0, 0, side, side), color=color)
    of_numbers = f"of {evaluate.FLOATS_PER_GAUSSIAN} float32 numbers,\nand a network"
    text = f"{count} Gaussians\n{of_numbers}:\n{explicit:,} bytes"
    left.text(10, np.sqrt(explicit) - 12, text, va="top")
    left.text(10, side - 12, f"our file:\n{len(DATA):,} bytes", va="top", color="white")
    left.set(aspect="equal", title="our scene (area = bytes)", **show.BARE)
    for ax, (claim, limits, rates, methods) in zip(panels, PAPER):
        ax.plot(*zip(*rates), "o-", color=show.SPACE)
        for (name, (size, psnr, fps)), color in zip(methods.items(), (show.SPACE, show.GREY)):
            ax.plot(float(size), float(psnr), "o", ms=10, color=color)
            ax.text(
                0.9 * float(size),
                float(psnr),
                f"{name}: {fps} frames/s\n{size} MB, {psnr} dB\n",
                color=color,
                size=14,
                va="bottom",
            )
        ax.set(
            title=f"the paper's {claim}",
            ylabel="PSNR (dB)",
            xscale="log",
            xlim=(0.4, 700),
            xticks=(1, 10, 100),
            xticklabels=("1", "10", "100 MB"),
            ylim=limits,
        )


def parts(figure):
    """The file section by section, its parts without networks enlarged, and a file of the paper."""
    ax = figure.subplots()
    sizes = {name: inspect.components(DATA)[name] for name in SECTIONS}
    anchors = dict(list(sizes.items())[: list(sizes).index("deformation_mlp")])
    whole, coded = sum(sizes.values()), sum(anchors.values())
    networks = sum(size for name, size in sizes.items() if "mlp" in name)
    rows = (
        (4, sizes, f"our file: {whole:,} bytes, {networks:,} of them networks", "{:,}"),
        (2.1, anchors, f"its first parts, enlarged: {coded:,} bytes", "{:,}"),
        (0, T_REX, f"the paper's T-Rex, higher rate: {sum(T_REX.values())} kB", "{:,} kB"),
    )
    for y, row, title, form in rows:
        scale = 100 / sum(row.values())
        ax.text(0, y + 0.45, title, size=18)
        show.strip(
            ax,
            {name: scale * size for name, size in row.items()},
            y,
            {name: color for name, (_, color) in SECTIONS.items()},
            labels={
                name: (y - 0.42, f"{form.format(size)}\n{SECTIONS[name][0]}")
                for name, size in row.items()
                if scale * size > 5
            },
        )
    share = 100 * coded / whole
    ax.fill((0, share, 100, 0), (3.65, 3.65, 2.45, 2.45), color=show.PALE, alpha=0.5, lw=0)
    ax.set(xlim=(0, 100), ylim=(-1.4, 4.9), **show.BARE)


def bits(figure):
    """What anchors cost, and the files of other rates."""
    ax, scene = show.bits(figure, DATA, CAMERA, T, VIEW), load.load_scene("bouncing")
    files = {1: DATA} | {price: place_of(title).read_bytes() for price, title in PRICES.items()}
    for price, data in files.items():
        quality = evaluate.evaluate(decode(data), scene)[0]["psnr_db"]
        ax.plot(len(data), quality, "o", color=show.RATE)
        align = "bottom" if price < 4 else "top"
        ax.text(len(data) + 200, quality, f"λ × {price}", va=align)
    ax.set(title="trainings with other λ", xlabel="bytes", ylabel="PSNR (dB)")
    ax.set(xlim=(35500, 50000), xticks=range(36000, 50000, 4000), ylim=(26, 35.5))


def breaks(figure):
    """The same picture after failures of training and of decoding."""
    sections = container.read_container(DATA)
    weights = np.frombuffer(sections["deformation_mlp"], "<f2").copy()
    head = weights[-3 * (DESIGN.deformation[-1] + 1) : -3]  # behind it, there are only its biases
    head[np.abs(head).argmax()] *= 16  # the one that the viewer breaks
    files = {
        "the file": DATA,
        **{t: place_of(t).read_bytes() for t in ("no noise", "no rate", "rate times 100")},
        "one weight changed": container.write_container(
            {**sections, "deformation_mlp": weights.tobytes()}
        ),
    }
    shown = {title: (decode(data), data) for title, data in files.items()}
    shown["one symbol twice"] = one_symbol_twice()
    for ax, (title, decoded) in zip(figure.subplots(2, 3).flat, shown.items()):
        show.scored_picture(ax, *decoded, CAMERA, T, TRUTH, VIEW, title)


def one_symbol_twice(wrong=2276):
    """The model of a decoder that reads one symbol twice, so that the others come too late."""
    sent, symbols = FILE.symbols[FILE.kept], np.zeros_like(FILE.symbols)
    symbols[FILE.kept] = np.insert(sent, wrong, sent[wrong])[:-1]
    f, s, l, O = quantise.dequantise(symbols, FILE.context, DESIGN)
    return replace(MODEL, anchors=MODEL.anchors._replace(f_a=f, s_a=s, l_a=l, O_a=O)), DATA


# --- all pictures ---------------------------------------------------------------------------------
EDGE = (36, 32)  # column and row of a pixel at the lower edge of the red ball
FAMILY = THREAD.index
PICTURES = {  # title: the sentence to take home, and what fills the figure
    "1  Why": ("A file need not store what it can predict.", why),
    "2  Anchors and children": (
        "Few anchors are stored; they predict many Gaussians.",
        lambda figure: show.anchors(figure, MODEL, CAMERA, FAMILY, VIEW),
    ),
    "3  Prediction": (
        "Shared networks turn a few integers and the camera's place into Gaussians.",
        lambda figure: show.prediction(figure, FILE, SIDES, T, FAMILY),
    ),
    "4  Time": (
        "The scene is stored once; a network says where it is at time t.",
        lambda figure: show.time(figure, MODEL, CAMERA, T, VIEW),
    ),
    "5  Splatting": (
        "A pixel mixes a few Gaussians smoothly, so training can follow the slope.",
        lambda figure: show.pixel(figure, MODEL, CAMERA, T, EDGE),
    ),
    "6  Steps": (
        "Wider steps give fewer integers, fewer bytes and a worse picture.",
        lambda figure: show.steps(figure, MODEL, CAMERA, T, TRUTH, VIEW),
    ),
    "7  Context": (
        "What both sides can guess costs little.",
        lambda figure: show.knowledge(figure, FILE),
    ),
    "8  Bits": ("Training minimises error + λ · bits; λ says what a bit may cost.", bits),
    "9  Bytes": ("Here networks are most of a file; in the paper anchors are.", parts),
    "10  What breaks": ("Noise, rate and exact decoding are all needed.", breaks),
}


@figures.figure_style(show.STYLE)
def page(title):
    """The figure of one picture, 1,280 pixels wide."""
    figure = figures.new_figure(figsize=(12.8, 7.2), layout="constrained")
    sentence, fill = PICTURES[title]
    fill(figure)
    figure.supxlabel(sentence, size=20, style="italic")
    figure.suptitle(title, x=0.01, ha="left", size=24, weight="bold")
    return figure


@figures.figure_style(STYLE)  # of the colour bars' numbers, which the drawing makes
def draw_pictures():
    """Write all pictures, in 256 colours each, and the PDF with one picture per page."""
    with (
        output.staged_folder(shared.FOLDER) as staging,
        PdfPages(staging / "tour.pdf", metadata=handout.UNDATED) as pages,
    ):
        (staging / "tour").mkdir()
        tour_moving.write(staging / "tour")
        for i, title in enumerate(PICTURES, 1):
            figure = page(title)
            # Whatever rcParams say; text and lines are sharp, and pictures have 72 dpi.
            pages.savefig(figure, bbox_inches=figure.bbox_inches, dpi=72)
            figure.canvas.draw()  # after the pass for the page, so that the layout has settled
            pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
            pixels = shared.in_few_colors(pixels)
            write_image(staging / "tour" / f"{i:02d}.png", pixels, optimize=True, bits=8)


if __name__ == "__main__":
    train()
