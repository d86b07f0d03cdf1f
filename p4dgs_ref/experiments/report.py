"""The pictures of a run: truth beside decoded beside error, the motion, the bytes, the training; a CSV beside each."""
import csv
from pathlib import Path

import numpy as np

from ..training.progress import COLUMNS

STAGE_NAMES = ("static", "+ noise", "+ motion", "+ rate")
LABELS = {"header": "header", "positions": "anchor positions", "features": "features f", "scales": "scales s",
          "offset_scales": "offset scales l", "offsets": "offsets O", "masks": "masks", "hash_grid": "hash grid",
          "deformation_mlp": "deformation MLP", "anchor_mlps": "anchor MLPs", "context_mlps": "context MLPs"}
# Okabe and Ito's palette: told apart by colour-blind readers
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#F0E442", "#999999", "#000000")


def pyplot():
    """matplotlib.pyplot without a window, with type that stays readable when a README shrinks it."""
    import matplotlib
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    plt.rcParams.update({"font.size": 12, "axes.titlesize": 13, "axes.spines.top": False, "axes.spines.right": False,
                         "figure.dpi": 110, "savefig.bbox": "tight", "svg.hashsalt": "p4dgs_ref"})
    return plt


def save_figure(figure, path):
    """Write a figure without the date and version that would make equal pictures differ, and close it."""
    figure.savefig(path, metadata={"Software": None} if str(path).endswith(".png") else None)
    pyplot().close(figure)


def write_csv(path, rows, columns=None):
    """Write rows (dictionaries, or lists under `columns`) as CSV."""
    columns = columns or list(rows[0])
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([row[c] for c in columns] if isinstance(row, dict) else row for row in rows)


def draw_comparison(path, views, images, rows, count=4):
    """Truth, decoded, and absolute error of a few test views spread over time."""
    plt = pyplot()
    order = np.argsort([view.time for view in views], kind="stable")
    chosen = order[np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)]
    figure, axes = plt.subplots(3, len(chosen), figsize=(2.6 * len(chosen) + 1, 8), squeeze=False, layout="constrained")
    for column, i in enumerate(chosen):
        image = np.clip(images[i], 0, 1)
        error = np.abs(image - views[i].image).mean(axis=2)
        axes[0, column].set_title(f"t = {views[i].time:.2f}\ntruth")
        axes[0, column].imshow(views[i].image, vmin=0, vmax=1)
        axes[1, column].set_title(f"decoded, {rows[i]['psnr_db']:.1f} dB")
        axes[1, column].imshow(image)
        axes[2, column].set_title(f"error, mean {error.mean():.3f}")
        shown = axes[2, column].imshow(error, cmap="magma", vmin=0, vmax=0.25)
    for ax in axes.ravel():
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    figure.colorbar(shown, ax=axes[2, :], label="mean absolute error of RGB", shrink=0.9)
    save_figure(figure, path)


def write_motion(path, model, camera, frames=24, zoom=4):
    """A GIF of the model over t from one held camera, forth and back."""
    import imageio.v3 as iio
    images = [np.clip(model.render(camera, t), 0, 1) for t in np.linspace(0, 1, frames)]
    pixels = [(image * 255).round().astype(np.uint8).repeat(zoom, 0).repeat(zoom, 1) for image in images]
    iio.imwrite(path, pixels + pixels[-2:0:-1], duration=60, loop=0)


def draw_size(path, components, explicit):
    """Bytes by component, and the file beside the same Gaussians as plain float32."""
    plt = pyplot()
    names = sorted(components, key=components.get)
    values = [components[name] for name in names]
    total = sum(values)
    figure, ax = plt.subplots(figsize=(8.5, 4.6))
    bars = ax.barh([LABELS[name] for name in names], values, color=COLORS[0])
    ax.bar_label(bars, [f" {v:,} ({100 * v / total:.1f} %)" for v in values])
    ax.set(xlabel="bytes in the file", xlim=(0, 1.3 * max(values)),
           title=f"{total:,} bytes; the same Gaussians as float32: {explicit:,} ({explicit / total:.1f} times as much)")
    save_figure(figure, path)


def draw_training(path, history, stage_ends):
    """PSNR of the training views and coded bits per number, over iterations, with the paper's four stages."""
    plt = pyplot()
    table = {name: np.array([row[i] for row in history], float) for i, name in enumerate(COLUMNS)}
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(8.5, 5.6), sharex=True, layout="constrained")
    at, values = table["iteration"], table["psnr_db"]
    top.plot(at, values, ".", color=COLORS[5], markersize=3, label="one view")
    width = max(1, min(10, len(values) // 4))
    smooth = np.convolve(values, np.full(width, 1 / width), "valid")
    top.plot(at[len(at) - len(smooth):], smooth, color=COLORS[0], label=f"mean of {width}")
    top.set(ylabel="PSNR, training views (dB)")
    top.legend(loc="lower right", frameon=False)
    rated = table["stage"] == 4
    bottom.plot(at[rated], table["bits_per_parameter"][rated], color=COLORS[3])
    bottom.set(xlabel="iteration", ylabel="bits per coded number", ylim=(0, None))
    starts = (0, *stage_ends[:3])
    for number, (start, end, name) in enumerate(zip(starts, stage_ends, STAGE_NAMES), 1):
        if end > start:
            for ax in (top, bottom):
                ax.axvline(start, color="#bbbbbb", linewidth=0.8)
            label = f"{number} {name}" if end - start > 0.12 * stage_ends[-1] else f"{number}"
            top.text(start + 0.005 * stage_ends[-1], top.get_ylim()[1], label, va="bottom", fontsize=11)
    save_figure(figure, path)


def write_report(folder, model, scene, rows, images, components, explicit, history, stage_ends):
    """All pictures and tables of a run into `folder`; training's only where there is a history."""
    folder = Path(folder)
    draw_comparison(folder / "comparison.png", scene.test, images, rows)
    write_csv(folder / "comparison.csv", rows)
    write_motion(folder / "motion.gif", model, scene.test[0].camera)
    draw_size(folder / "size.png", components, explicit)
    write_csv(folder / "size.csv", [{"component": name, "bytes": n} for name, n in components.items()])
    if history:
        draw_training(folder / "training.png", history, stage_ends)
        write_csv(folder / "training.csv", history, COLUMNS)
