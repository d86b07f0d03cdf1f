"""The pictures of a run, each with a CSV: test views, motion, bytes, training."""

import csv
import io
from contextlib import contextmanager

import numpy as np

from ..effects import moves
from ..scenes.files import image_bytes
from ..splatting.camera import look_at
from ..training.progress import COLUMNS
from .evaluate import names_in_training

STAGES = "iteration (stages: 1 static, 2 + noise, 3 + motion, 4 + rate)"
LABELS = {
    "header": "header",
    "positions": "anchor positions",
    "features": "features f",
    "scales": "scales s",
    "offset_scales": "offset scales l",
    "offsets": "offsets O",
    "masks": "masks",
    "hash_grid": "hash grid",
    "deformation_mlp": "deformation MLP",
    "anchor_mlps": "anchor MLPs",
    "context_mlps": "context MLPs",
}
# The colours of Okabe and Ito, which colour-blind readers can tell apart.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
BLUE, RED, GREEN, PINK, ORANGE, LIGHT_BLUE, _ = COLORS
ERROR_RANGE = 0.25  # the end of the error pictures' colours, the same in every report
STYLE = {  # letters that stay readable in a small picture
    "font.size": 13,
    "axes.titlesize": 13,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.dpi": 110,
    "savefig.bbox": "tight",
}


@contextmanager
def figure_style(settings=STYLE):
    """Within this context, or this decorator, figures look the same in every program.

    The settings of matplotlib are its defaults and these; afterwards they are as they were.
    """
    from matplotlib import style

    with style.context(["default", settings]):
        yield


def new_figure(**settings):
    """Return a figure unknown to pyplot: it has no window, and the program keeps its backend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    return FigureCanvasAgg(Figure(**settings)).figure


def subplots(*shape, figsize, layout="constrained", **settings):
    """Return a new figure and its axes, like those of pyplot."""
    figure = new_figure(figsize=figsize, layout=layout)
    return figure, figure.subplots(*shape, **settings)


def save_figure(figure, path):
    """Write a PNG without matplotlib's version in it, so that equal pictures are equal files."""
    # In memory first: if the disk is full, `savefig` would remove the file that the error names.
    png = io.BytesIO()
    figure.savefig(png, metadata={"Software": None})
    path.write_bytes(png.getvalue())


def write_csv(path, rows):
    """Write rows {column: value} as CSV; what a row lacks is left empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def error_of(image, truth):
    """Return the absolute error [H, W] of an image, averaged over R, G and B, and its title."""
    error = np.abs(image - truth).mean(axis=2)
    return error, f"mean {error.mean():.3f}"


def literal(text):
    """Return a text for a title: `$` would begin mathematics, and the font lacks some letters."""
    from matplotlib.font_manager import findfont, get_font

    font = get_font(findfont("DejaVu Sans"))
    known = (letter if font.get_char_index(ord(letter)) else "?" for letter in text)
    return "".join(known).replace("$", r"\$")


@figure_style()
def draw_pictures(path, title, rows):
    """Draw rows (label, [(picture, title), ...]); the last row must show errors."""
    shape = len(rows), len(rows[0][1])
    figure, axes = subplots(
        *shape, figsize=(2.6 * shape[1] + 0.5, 9.2 / 3 * shape[0]), squeeze=False
    )
    for row, (label, pictures) in zip(axes, rows):
        for ax, (picture, above) in zip(row, pictures):
            shown = ax.imshow(picture, cmap="magma", vmin=0, vmax=ERROR_RANGE)
            ax.set(xticks=[], yticks=[], title=above)
            ax.spines[:].set_visible(False)
        row[0].set_ylabel(literal(label), fontsize=15)
    figure.colorbar(
        shown,
        ax=axes,
        location="bottom",
        extend="max",
        aspect=40,
        shrink=0.7,
        pad=0.01,
        label="absolute error, mean of R, G, B (of 1)",
    )
    figure.suptitle(literal(title), fontsize=15)
    save_figure(figure, path)


def write_comparison(folder, scene, rows, images, count=4):
    """Write comparison.csv, and comparison.png: truth, decoded image and error of a few views.

    The views are test views spread over time.
    """
    write_csv(folder / "comparison.csv", rows)
    order = np.argsort([view.time for view in scene.test], kind="stable")
    index = order[np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int)]
    views, images = [scene.test[i] for i in index], [np.clip(images[i], 0, 1) for i in index]
    unseen = "" if names_in_training(scene) else ", not used in training"
    draw_pictures(
        folder / "comparison.png",
        f"{scene.name}: test views of {rows[0]['size']} pixels{unseen}",
        [
            ("truth", [(view.image, f"t = {view.time:.2f}") for view in views]),
            ("decoded", [(a, f"PSNR {rows[i]['psnr_db']:.1f} dB") for a, i in zip(images, index)]),
            ("absolute error", [error_of(image, view.image) for image, view in zip(images, views)]),
        ],
    )


def fixed_camera(model, azimuth=40.0, elevation=30.0, distance=3.6, size=128):
    """Return the camera that looks at the middle of the anchors' box; angles in degrees."""
    azimuth, elevation = np.radians([azimuth, elevation])
    middle, level = (model.box[0].astype(float) + model.box[1]) / 2, np.cos(elevation)
    outward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    focal = size / 2 / np.tan(np.radians(41.0) / 2)  # a field of view of 41 degrees
    return look_at(middle + distance * outward, middle, focal, focal, size, size)


def gif_of(images):
    """Return the bytes of a GIF of images (H, W, 3) in [0, 1] that plays forwards and backwards."""
    pictures = (*images, *images[-2:0:-1])
    frames = [(image * 255).round().astype(np.uint8) for image in pictures]
    return image_bytes(frames, ".gif", duration=60, loop=0)


def film_views(model, frames=24, azimuth=40.0, **options):
    """Return the (camera, time) pairs of a film. The camera moves only if the model does not."""
    turn = 0 if moves(model.design.effects) else 360
    return [
        (fixed_camera(model, azimuth + turn * i / frames, **options), t)
        for i, t in enumerate(np.linspace(0, 1, frames))
    ]


def write_motion(path, model, scene, frames=24):
    """Write a GIF of the model over time, seen by a test camera; small pictures are enlarged.

    If the model does not move, the scene's cameras take turns.
    """
    views = [*scene.test, *scene.train]
    cameras = [view.camera for view in views[:: 1 + len(views) // frames]]
    if moves(model.design.effects):
        cameras = [views[0].camera] * frames
    zoom = max(1, min(4, 256 // cameras[0].width))
    images = [
        np.clip(model.render(camera, t), 0, 1).repeat(zoom, 0).repeat(zoom, 1)
        for camera, t in zip(cameras, np.linspace(0, 1, frames))
    ]
    path.write_bytes(gif_of(images))


@figure_style()
def write_size(folder, name, metrics):
    """Write size.csv and size.png: the bytes of a file by component, the largest first."""
    components, size = metrics["components"], metrics["bytes"]
    write_csv(
        folder / "size.csv",
        [{"component": part, "bytes": count} for part, count in components.items()],
    )
    parts = sorted(components, key=components.get)
    values = [components[part] for part in parts]
    figure, ax = subplots(figsize=(8.5, 5.25), layout=None)
    bars = ax.barh([LABELS[part] for part in parts], values, color=BLUE)
    ax.bar_label(bars, [f" {v:,} ({100 * v / size:.1f} %)" for v in values])
    ax.set(xlabel="bytes in the file", xmargin=0.35)  # room for the numbers
    ax.xaxis.set_major_formatter("{x:,.0f}")
    ax.locator_params(axis="x", nbins=5)
    explicit = metrics["explicit_bytes"]
    figure.suptitle(
        f"{name}: {size:,} bytes\nits Gaussians and ψ_d as float32: {explicit:,} bytes, "
        f"{explicit / size:.1f} times as many",
        fontsize=14,
    )
    save_figure(figure, folder / "size.png")


@figure_style()
def write_training(folder, history, stage_ends):
    """Write training.csv, and training.png: PSNR of the training views and L_rate over stages."""
    write_csv(folder / "training.csv", [dict(zip(COLUMNS, row)) for row in history])
    table = dict(zip(COLUMNS, np.array(history, float).T))
    figure, (top, bottom) = subplots(2, 1, figsize=(8.5, 6), sharex=True)
    at, values = table["iteration"], table["psnr_db"]
    top.plot(at, values, ".", color=LIGHT_BLUE, markersize=4, label="the iteration's view")
    width = max(1, min(10, len(values) // 4))
    smooth = np.convolve(values, np.full(width, 1 / width), "valid")
    top.plot(
        at[len(at) - len(smooth) :], smooth, color=BLUE, label=f"mean of the last {width} dots"
    )
    top.set(ylabel="PSNR, training view (dB)")
    top.legend(loc="lower right", frameon=False)
    rated = table["stage"] == 4
    bottom.plot(at[rated], table["bits_per_parameter"][rated], color=RED)
    bottom.set(
        ylabel="L_rate (bits per coded number)",
        ylim=(0, None),
        xlim=(0, stage_ends[-1]),
        xlabel=STAGES,
    )
    for number, (start, end) in enumerate(zip((0, *stage_ends[:3]), stage_ends), 1):
        if end > start:
            top.axvline(start, color="#bbbbbb", linewidth=0.8)
            bottom.axvline(start, color="#bbbbbb", linewidth=0.8)
            top.text(
                start + 0.005 * stage_ends[-1],
                1.01,
                f"stage {number}" if end - start > 0.12 * stage_ends[-1] else f"{number}",
                va="bottom",
                transform=top.get_xaxis_transform(),
            )
    save_figure(figure, folder / "training.png")
