"""Study 1, rendering: what footprint, precision, stop and tile size cost in the image and in every gradient."""

import numpy as np

from ...splatting import compositing, fast
from ...splatting.settings import SETTINGS, Settings
from ..report import pyplot
from .diagram import (
    TIME,
    Finding,
    at,
    figure,
    finish,
    legend,
    lines,
    number,
    table,
    work_precision,
)
from .timing import alternate

GRADIENTS = {"mean2d": "centres", "conic": "conics", "alpha": "opacities", "color": "colours"}
CUTS = {"1e-2": 1e-2, "1/255": 1 / 255, "1e-3": 1e-3, "5e-5": 5e-5, "1e-6": 1e-6, "1e-9": 1e-9}
STOPS = {"0": 0.0, "1e-4": 1e-4, "1e-2": 1e-2}
TILES = (4, 8, 16, 32)
SCENES = {
    "small splats": dict(sigma=(1.5, 4.0), alpha=(0.05, 0.9)),
    "large, opaque": dict(sigma=(4.0, 12.0), alpha=(0.5, 0.98)),
}


SUMMARY_SIZE = (1000, 64)  # splats, pixels along a side


def splat_scene(name, n, size):
    """Inputs of both renderers: random splats, their covariances, the frame, and a white-noise cotangent of the image."""
    splats = compositing.random_splats(np.random.default_rng(0), n, size, size, **SCENES[name])
    a, b, c = splats["conic"].T
    cov2d = np.stack([c, -b, a], axis=1) / (a * c - b * b)[:, None]
    frame = dict(background=np.array([0.9, 0.5, 0.2]), height=size, width=size)
    return splats, cov2d, frame, np.random.default_rng(1).normal(size=(size, size, 3))


def exact(scene, dtype="float64"):
    """The exact twin in some precision: image, gradients, Gaussian-pixel pairs."""
    splats, _, frame, image_bar = scene
    cast = {name: a.astype(dtype) if a.dtype.kind == "f" else a for name, a in splats.items()}
    out, res = compositing.forward(
        **cast, **{**frame, "background": frame["background"].astype(dtype)}
    )
    return (
        out.image,
        compositing.backward(res, image_bar.astype(dtype)),
        len(res.order) * out.transmittance.size,
    )


def tiled(scene, settings):
    """The fast renderer under some settings: image, gradients, Gaussian-pixel pairs evaluated, padding included."""
    splats, cov2d, frame, image_bar = scene
    out, res = fast.forward(**splats, cov2d=cov2d, **frame, settings=settings)
    return out.image, fast.backward(res, image_bar), sum(chunk.A.size for chunk in res.chunks)


def errors(found, truth):
    """Largest and root mean square error of the image, relative L2 error of every gradient."""
    image, bars, pairs = found
    gap = image.astype(float) - truth[0]
    relative = {
        f"{name}_error": float(
            np.linalg.norm(bars[name] - truth[1][name]) / np.linalg.norm(truth[1][name])
        )
        for name in GRADIENTS
    }
    return {
        "pairs": pairs,
        "error": float(np.abs(gap).max()),
        "rms_error": float(np.sqrt((gap**2).mean())),
        **relative,
        "gradient_error": max(relative.values()),
    }


def grid(quick):
    """Every combination: [(row of what distinguishes it, Settings)], with and without stop, at several tile sizes."""
    cuts = {key: CUTS[key] for key in (("1/255", "5e-5", "1e-6") if quick else CUTS)}
    combinations = []
    for dtype in ("float32", "float64"):
        for tile in (8, 16) if quick else TILES:
            for stop, level in list(STOPS.items())[: 2 if quick else 3]:
                for footprint, cut, value in (
                    ("all", "", 0.0),
                    ("box", "", 0.0),
                    *(("ellipse", key, value) for key, value in cuts.items()),
                ):
                    settings = Settings("study", footprint, dtype, tile=tile, cut=value, stop=level)
                    combinations.append(
                        (
                            dict(footprint=footprint, cut=cut, dtype=dtype, tile=tile, stop=stop),
                            settings,
                        )
                    )
    return combinations


def measure(name, n, size, combinations, repeats):
    """Rows of the given combinations, of both exact twins and of the three named points, all timed in turn."""
    scene = splat_scene(name, n, size)
    truth = exact(scene)
    runs = {
        ("combination", *what.values()): (what, lambda s=settings: tiled(scene, s))
        for what, settings in combinations
    }
    blank = dict(footprint="all", cut="", dtype="", tile="", stop="0")
    runs["dense"] = (
        {**blank, "footprint": "dense", "dtype": "float32"},
        lambda: exact(scene, "float32"),
    )
    for point, s in SETTINGS.items():
        run = (lambda: exact(scene)) if s.footprint == "all" else (lambda s=s: tiled(scene, s))
        runs[point] = {**blank, "footprint": point, "dtype": s.dtype, "stop": f"{s.stop:g}"}, run
    ms = alternate({key: run for key, (_, run) in runs.items()}, repeats)
    return [
        {"scene": name, **what, "ms": ms[key], **errors(run(), truth)}
        for key, (what, run) in runs.items()
    ]


def summary_rows(repeats=7):
    """Error and time of the three named points on the study's first scene."""
    rows = measure("small splats", *SUMMARY_SIZE, [], repeats)
    return [
        {
            "settings": name,
            **{
                key: at(rows, footprint=name)[key]
                for key in ("ms", "pairs", "error", "rms_error", *(f"{g}_error" for g in GRADIENTS))
            },
        }
        for name in SETTINGS
    ]


def method_rows(rows, tile=8, stop="1e-4"):
    """The rows of a work-precision diagram: a method is footprint and precision, the knob is the ellipse's cut."""
    chosen = []
    for row in rows:
        where = row["footprint"]
        if where in ("ellipse", "all", "box"):
            if (row["tile"], row["stop"]) != ((16 if where == "box" else tile), stop):
                continue
            label = {"ellipse": "ellipse, cut labelled", "all": "all pairs", "box": "3σ box"}[where]
            chosen.append({**row, "method": f"{label}, {row['dtype']}", "knob": row["cut"]})
        elif where == "dense":
            chosen.append({**row, "method": "exact twin, float32", "knob": ""})
        elif where in ("paper", "fast"):
            chosen.append({**row, "method": f"setting `{where}`", "knob": ""})
    order = ["ellipse, cut labelled, float32", "ellipse, cut labelled, float64", "3σ box, float32"]
    return sorted(
        chosen, key=lambda row: order.index(row["method"]) if row["method"] in order else len(order)
    )


def run(folder, quick, progress):
    n, size, repeats = (300, 48, 3) if quick else (*SUMMARY_SIZE, 5)
    rows = []
    for name in SCENES:
        progress(f"rendering: {name}")
        rows += measure(name, n if name == "small splats" else n // 3, size, grid(quick), repeats)
    files = [table(folder, "rendering", rows)]
    small = [row for row in rows if row["scene"] == "small splats"]
    exact_ms = at(small, footprint="exact")["ms"]
    title = (
        f"rendering {n} splats into {size}×{size} pixels, forward and backward\n"
        f"reference: exact twin in float64, {exact_ms:.3g} ms; stop at T < 1e-4, tiles of 8×8 (box: 16×16)"
    )
    work_precision(
        folder / "rendering.png",
        method_rows(small),
        title=title,
        axes=TIME._replace(y_label="largest error of the image (of 1)"),
    )
    draw_gradients(folder / "rendering_gradients.png", method_rows(small), title)
    draw_tiles(folder / "rendering_tiles.png", rows)
    figures = [
        ("rendering.png", "Error of the image against time."),
        ("rendering_gradients.png", "Error of every gradient against time, white-noise cotangent."),
        ("rendering_tiles.png", "Tile size and stop, for small splats and for large opaque ones."),
    ]
    return Finding(
        "rendering",
        "Rendering",
        "the exact twin in float64: every Gaussian at every pixel",
        figures,
        files,
        read(rows),
        f"median of {repeats} alternating repeats, forward and backward",
    )


def draw_gradients(path, rows, title):
    fig, axes = pyplot().subplots(2, 2, figsize=(8, 7.5), sharex=True, layout="constrained")
    for ax, (name, label) in zip(axes.ravel(), GRADIENTS.items()):
        lines(
            ax,
            rows,
            TIME._replace(y=f"{name}_error", x_label="", y_label="relative L2 error"),
            label=False,
        )
        ax.set_title(f"gradient of {label}")
    for ax in axes[1]:
        ax.set_xlabel("time (ms)")
    fig.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=2,
        fontsize=10,
        frameon=False,
    )
    finish(fig, path, title)


def draw_tiles(path, rows):
    """Time of the ellipse footprint in float32 over the tile's side, one line a stop."""
    fig, axes = figure(len(SCENES), (8, 5))
    for ax, name in zip(axes, SCENES):
        own = [
            {
                **row,
                "method": f"stop at T < {row['stop']}" if row["stop"] != "0" else "no stop",
                "knob": row["tile"],
            }
            for row in rows
            if row["scene"] == name
            and row["footprint"] == "ellipse"
            and row["dtype"] == "float32"
            and row["cut"] == "5e-5"
        ]
        lines(
            ax, own, TIME._replace(y_label="largest error of the image (of 1)", x_label="time (ms)")
        )
        ax.set_title(name)
        ax.margins(0.15)
    legend(axes[0])
    finish(
        fig,
        path,
        "tile side (labelled) and stop: ellipse cut at 5e-5, float32; reference: exact twin in float64",
    )


def read(rows):
    """What the numbers say."""
    small, large = ([row for row in rows if row["scene"] == name] for name in SCENES)
    exact_, paper, fast_ = (at(small, footprint=name) for name in ("exact", "paper", "fast"))
    rounding = min(
        row["error"]
        for row in small
        if (row["footprint"], row["dtype"], row["stop"]) == ("all", "float32", "0")
    )
    stops = {
        stop: [
            row
            for row in large
            if row["footprint"] == "ellipse"
            and row["cut"] == "5e-5"
            and row["stop"] == stop
            and row["dtype"] == "float32"
        ]
        for stop in ("0", "1e-4")
    }
    best = {stop: min(found, key=lambda row: row["ms"]) for stop, found in stops.items()}
    return (
        f"`fast` takes {fast_['ms']:.3g} ms, `paper` {paper['ms']:.3g} ms, the exact twin {exact_['ms']:.3g} ms; they "
        f"evaluate {fast_['pairs']:,}, {paper['pairs']:,} and {exact_['pairs']:,} Gaussian–pixel pairs. The image of "
        f"`fast` is off by at most {number(fast_['error'])}, that of `paper` by {number(paper['error'])}; the worst "
        f"gradient by {number(fast_['gradient_error'])} and {number(paper['gradient_error'])}. float32 without any "
        f"cut costs {number(rounding)} in the image, so the cut of `fast` weighs {number(fast_['error'] / rounding)} "
        "times as much as its precision. On large opaque splats the stop changes the quickest time from "
        f"{best['0']['ms']:.3g} ms (tiles of {best['0']['tile']}) to {best['1e-4']['ms']:.3g} ms (tiles of "
        f"{best['1e-4']['tile']})."
    )
