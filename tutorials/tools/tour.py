"""The paper in ten pictures: tutorials/tour/*.png and tour.pdf, from the demo's file.

`python -m tutorials.tools.syllabus tour` draws them. tutorials/tour.md is their text, whose numbers
a test finds in the pictures. `python -m tutorials.tools.tour` trains the failures of the last
picture anew, which takes a few minutes; their files lie beside the pictures, so that nobody has to
train in order to draw.
"""

from dataclasses import fields, replace

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from p4dgs_ref.beyond import file
from scipy.special import ndtr

from p4dgs_ref import designs, lessons, model, output
from p4dgs_ref.codec import quantise, rans
from p4dgs_ref.lab.tables import compare
from p4dgs_ref.report import evaluate, figures, inspect
from p4dgs_ref.scenes import load, simulator
from p4dgs_ref.scenes.files import write_image
from tutorials.tools import animation, handout, shared, show

PLACE = shared.FOLDER / "tour"
SCENE = simulator.read_description(load.find_scene("bouncing") / load.DESCRIPTION)
WALK = {a: simulator.camera_at(SCENE, np.radians(a), np.radians(26)) for a in range(361)}
CAMERA, T = WALK[305], 0.3  # which all pictures show
VIEW = {"xlim": (1, 62), "ylim": (59, 10)}  # without the empty margins
DATA = (shared.FOLDER / "demo.p4dgs").read_bytes()
PRESET = designs.PRESETS["tiny_coded"]
FILE = designs.quantised_of(DATA)
MODEL, DESIGN = FILE.model, FILE.model.design
TRUTH = animation.truth(SCENE, CAMERA, T, MODEL.background)

# Of each of the paper's datasets: what it claims, the limits of PSNR in the picture, and (MB, PSNR
# in dB) of P-4DGS at four rates, from its last table. The paper does not say which files it
# divides; the second one fits what it claims.
PAPER = {
    "D-NeRF": (
        "synthetic scenes (D-NeRF): “over 40×”",
        (34, 41),
        ((1.03, 38.10), (0.78, 37.73), (0.71, 37.38), (0.57, 35.10)),
    ),
    "NeRF-DS": (
        "real scenes (NeRF-DS): “over 90×”",
        (23, 25.2),
        ((0.70, 24.18), (0.65, 23.93), (0.57, 23.60), (0.54, 23.34)),
    ),
}
SECTIONS = {  # in the order of the strip: label and colour
    "positions": ("positions", show.PARTS["position, masks"]),
    "masks": ("masks", show.GREY),
    "features": ("features", show.PARTS["feature"]),
    "scales": ("scales", show.PARTS["scales"]),
    "offset_scales": ("offset\nscales", show.PARTS["offset scales"]),
    "offsets": ("offsets", show.PARTS["offsets"]),
    "hash_grid": ("hash grid", show.CONTEXT),
    "context_mlps": ("context\nnetworks", show.CONTEXT),
    "deformation_mlp": ("motion network", show.TIME),
    "anchor_mlps": ("prediction networks", show.SPACE),
    "header": ("header", show.GREY),
}


class Silent(np.random.Generator):
    """A generator that makes the noise of Eq. (7) zero: only this noise is drawn in float32."""

    def random(self, size=None, dtype=np.float64):
        return super().random(size) if dtype is np.float64 else np.full(size, 0.5, dtype)


FAILURES = {  # title: generator of training, and what of the demo's preset changes
    "no noise": (Silent, {}),
    "no rate": (np.random.Generator, {"lambda_rate": 0.0}),
    "rate times 100": (np.random.Generator, {"lambda_rate": 100 * PRESET.lambda_rate}),
    "one frequency in time": (np.random.Generator, {"L_t": 1}),
}


def train():
    """Train the failures and write their files."""
    for title, (generator, changes) in FAILURES.items():
        preset = replace(PRESET, **changes)
        run = designs.trainer_of(load.load_scene("bouncing"), preset)
        run.rng = generator(run.rng.bit_generator)
        (PLACE / f"{title.replace(' ', '_')}.p4dgs").write_bytes(designs.encode(run.run()))


# --- the pictures that are not in `show` ----------------------------------------------------------
def why(figure):
    """What a moving scene costs: ours, and those of the paper with P-4DGS and with D3DGS."""
    left, *panels = figure.subplot_mosaic("ab;ac", width_ratios=(1, 1.4)).values()
    count = len(MODEL.gaussians(T, CAMERA).x)
    for size, x, color, label in (
        (
            evaluate.explicit_bytes(MODEL, count),
            10,
            show.PALE,
            f"{count} Gaussians\nof {evaluate.FLOATS_PER_GAUSSIAN} float32 numbers,\nand a network",
        ),
        (len(DATA), 105, show.SPACE, "our file, entropy coded"),
    ):
        side = np.sqrt(size)
        left.fill((0, side, side, 0), (0, 0, side, side), color=color)
        left.text(x, side - 12, f"{label}:\n{size:,} bytes", va="top")
    left.set(aspect="equal", title="our scene (area = bytes)", **show.BARE)
    for ax, (dataset, (claim, limits, rates)) in zip(panels, PAPER.items()):
        ax.plot(*zip(*rates), "o-", color=show.SPACE)
        small, quality = rates[1]
        for method, name, color in (
            ("p4dgs", "P-4DGS", show.SPACE),
            ("d3dgs", "D3DGS", show.GREY),  # the last one, whose size is divided below
        ):
            psnr, _, size, fps = compare.PAPER[dataset][method].split()
            ax.plot(float(size), float(psnr), "o", ms=10, color=color)
            ax.text(
                0.9 * float(size),
                float(psnr),
                f"{name}: {fps} frames/s\n{size} MB, {psnr} dB\n",
                color=color,
                size=14,
                va="bottom",
            )
        ax.annotate(
            f"{size} MB / {small} MB = {float(size) / small:.0f},\nat {quality} dB",
            (small, quality),
            (2, quality),
            size=14,
            va="top",
            arrowprops={"arrowstyle": "->", "shrinkB": 6},
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
    """The file as a strip, section by section, in the paper's design and with coded networks."""
    ax = figure.subplots()
    design = model.Design(**{row.name: vars(DESIGN)[row.name] for row in fields(model.Design)})
    numbers = {row.name: vars(MODEL)[row.name] for row in fields(model.Model)}
    plain = designs.encode(model.Model(**{**numbers, "design": design}))
    paper, coded = inspect.components(plain), inspect.components(DATA)
    zoom, colors = sum(paper.values()) / len(DATA), {n: color for n, (_, color) in SECTIONS.items()}
    labels = {  # of narrow parts above the strip, of the others below it
        name: (1.45 if coded[name] < 400 else -0.2, f"{coded[name]:,}\n{label}")
        for name, (label, _) in SECTIONS.items()
    }
    for y, sizes, title in (
        (4, paper, "our model, written in the paper's design"),
        (2.4, coded, "the same model, written with coded networks"),
    ):
        networks = sum(size for name, size in sizes.items() if "mlp" in name)
        total = f"{sum(sizes.values()):,} bytes, {networks:,} of them networks"
        ax.text(0, y + 0.45, f"{title}: {total}", size=18)
        show.strip(ax, {name: sizes[name] for name in SECTIONS}, y, colors)
    ax.fill(
        (0, len(DATA), zoom * len(DATA), 0),
        (2.05, 2.05, 0.9, 0.9),
        color=show.PALE,
        alpha=0.5,
        lw=0,
    )
    show.strip(ax, {name: zoom * coded[name] for name in SECTIONS}, 0.4, colors, 1, labels)
    ax.set(xlim=(0, zoom * len(DATA)), ylim=(-1.3, 4.9), **show.BARE)


def breaks(figure):
    """The same picture after failures of training and of decoding."""
    sections = designs.read_container(DATA)
    first, *rest = sections["deformation_mlp"]
    sections["deformation_mlp"] = bytes([first ^ 64, *rest])
    files = {
        "the file": DATA,
        **{title: (PLACE / f"{title.replace(' ', '_')}.p4dgs").read_bytes() for title in FAILURES},
        "one bit changed": file.write_container(sections),
    }
    shown = {title: (designs.decode(data), data) for title, data in files.items()}
    shown["one ulp in the decoder"] = one_ulp()
    first, *axes = figure.subplots(2, 4).flat
    truth = animation.truth(SCENE, show.enlarged(CAMERA, 8), T, MODEL.background)
    show.picture(first, truth, CAMERA, **VIEW, title="the truth,\nray traced")
    for ax, (title, decoded) in zip(axes, shown.items()):
        show.scored_picture(ax, *decoded, CAMERA, T, TRUTH, VIEW, title)


def one_ulp(wrong=2230):
    """The model that a decoder finds if sigma of one symbol is an ulp too large, and the message.

    The coder's tables come from floats here, as tutorial 21 explains. The decoder reads zeros after
    the data, as many do.
    """
    sent, symbols = FILE.symbols[FILE.kept], np.zeros_like(FILE.symbols)
    n, values = np.arange(len(sent)), np.arange(sent.min(), sent.max() + 1)
    ctx, q = inspect.float_context(MODEL), np.repeat(FILE.context.q, DESIGN.widths, axis=1)
    mu, sigma = ((array / q)[FILE.kept].astype(np.float32) for array in (ctx.mu, ctx.sigma))

    def keys():
        below = ndtr((np.append(-np.inf, values[1:] - 0.5) - mu[:, None]) / sigma[:, None])
        counts = (below * (rans.CERTAIN - len(values))).astype(np.int64) + np.arange(len(values))
        return np.append(counts + (n[:, None] << rans.PRECISION), len(n) << rans.PRECISION)

    data = rans.encode(n * len(values) + sent - values[0], keys(), lanes=1)
    sigma[wrong] = np.nextafter(sigma[wrong], np.float32(np.inf))
    *_, state, start = rans.read_head(data, 0, len(n), "message")
    words, entries = np.append(np.frombuffer(data, "<u4", offset=start), 0 * n), 0 * n
    rans.pop_rows_plainly([state], words, n, keys(), entries)
    symbols[FILE.kept] = entries - n * len(values) + values[0]
    f, s, l, O = quantise.dequantise(symbols, FILE.context, DESIGN)
    return replace(MODEL, anchors=MODEL.anchors._replace(f_a=f, s_a=s, l_a=l, O_a=O)), data


# --- all pictures ---------------------------------------------------------------------------------
# Anchor 41 has its children all over the blue ball; the pixel is at the lower edge of the red one.
PICTURES = {  # title: what fills its figure
    "1  Why": why,
    "2  Anchors and children": lambda figure: show.anchors(figure, MODEL, CAMERA, 41, VIEW),
    "3  Prediction": lambda figure: show.prediction(figure, FILE, CAMERA, T, 41, WALK),
    "4  Time": lambda figure: show.time(figure, MODEL, CAMERA, T, VIEW),
    "5  Splatting": lambda figure: show.pixel(figure, MODEL, CAMERA, T, (36, 32)),
    "6  Steps": lambda figure: show.steps(figure, MODEL, CAMERA, T, TRUTH, VIEW),
    "7  Context": lambda figure: show.knowledge(figure, FILE, level=0.0),
    "8  Bits": lambda figure: show.bits(figure, DATA, CAMERA, T, VIEW),
    "9  Bytes": parts,
    "10  What breaks": breaks,
}


@figures.styled(show.STYLE)
def page(title):
    """The figure of one picture, 1,280 pixels wide."""
    figure = figures.new_figure(figsize=(12.8, 7.2), layout="constrained")
    PICTURES[title](figure)
    figure.suptitle(title, x=0.01, ha="left", size=24, weight="bold")
    return figure


@figures.styled(lessons.STYLE)  # of the colour bars' numbers, which the drawing makes
def draw_pictures():
    """Write all pictures, in 256 colours each, and the PDF, one picture a page."""
    with (
        output.staged_folder(shared.FOLDER) as staging,
        PdfPages(staging / "tour.pdf", metadata=handout.UNDATED) as pages,
    ):
        (staging / "tour").mkdir()
        for i, title in enumerate(PICTURES, 1):
            figure = page(title)
            pages.savefig(figure, bbox_inches=figure.bbox_inches)  # whatever rcParams say
            figure.canvas.draw()  # after the pass for the page, so that the layout has settled
            pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
            write_image(staging / "tour" / f"{i:02d}.png", pixels, optimize=True, bits=8)


if __name__ == "__main__":
    train()
