"""Study 1, rendering: what footprint, precision, stop and tile size cost and save."""

from functools import partial
from itertools import product

import numpy as np

from ...splatting.settings import SETTINGS, Settings
from .. import bench
from ..clock import alternate, compare, stated, stretch_of
from .diagram import (
    TIME,
    Finding,
    at,
    draw_panels,
    finish,
    legend_below,
    number,
    select,
    table,
    work_precision,
)

GRADIENTS = {"mean2d": "centres", "conic": "conics", "alpha": "opacities", "color": "colours"}
CUTS = {"1e-2": 1e-2, "1/255": 1 / 255, "1e-3": 1e-3, "5e-5": 5e-5, "1e-6": 1e-6, "1e-9": 1e-9}
STOPS = {"0": 0.0, "1e-4": 1e-4, "1e-2": 1e-2}
TILES = (4, 8, 16, 32)
SCENES = {
    "small splats": dict(sigma=(1.5, 4.0), alpha=(0.05, 0.9)),
    "large, opaque": dict(sigma=(4.0, 12.0), alpha=(0.5, 0.98)),
}
SUMMARY_SIZE = (1000, 64)  # splats, pixels along a side
IMAGE_ERROR = TIME._replace(y_label="largest error of the image (of 1)")


def splat_scene(name, n, size):
    """Inputs of both renderers."""
    return bench.splat_scene(n, size, (0.9, 0.5, 0.2), **SCENES[name])


def exact(scene, dtype="float64"):
    """The exact twin in one precision: image, gradients, Gaussian-pixel pairs."""
    image, gradients = bench.run_exact(scene, dtype)
    height, width, _ = image.shape
    return image, gradients, int(scene[0]["visible"].sum()) * height * width


def tiled(scene, settings):
    """The fast renderer: image, gradients, Gaussian-pixel pairs evaluated, with the padding."""
    image, gradients, saved = bench.run_fast(scene, settings)
    return image, gradients, evaluated_pairs(saved)


def evaluated_pairs(saved):
    """How many pairs of a Gaussian and a pixel the fast renderer evaluated."""
    chunks, *_ = saved
    return sum(chunk.A.size for chunk in chunks)


def errors(found, truth):
    """Largest and root mean square error of the image, relative L2 error of every gradient."""
    image, gradients, pairs = found
    gap = image.astype(float) - truth[0]
    relative = {
        f"{name}_error": bench.relative_error(gradients[name], truth[1][name]) for name in GRADIENTS
    }
    return {
        "pairs": pairs,
        "error": float(np.abs(gap).max()),
        "rms_error": float(np.sqrt((gap**2).mean())),
        **relative,
        "gradient_error": max(relative.values()),
    }


def grid(quick):
    """Every combination of the settings: [(the columns that distinguish it, Settings)]."""
    cuts = ("1/255", "5e-5", "1e-6") if quick else CUTS
    footprints = [("all", ""), ("box", ""), *(("ellipse", cut) for cut in cuts)]
    tiles, stops = ((8, 16), ("0", "1e-4")) if quick else (TILES, STOPS)
    combinations = []
    for dtype, tile, stop, (footprint, cut) in product(
        ("float32", "float64"), tiles, stops, footprints
    ):
        what = dict(footprint=footprint, cut=cut, dtype=dtype, tile=tile, stop=stop)
        levels = dict(cut=CUTS.get(cut, 0.0), stop=STOPS[stop])
        combinations.append((what, Settings("study", footprint, dtype, tile=tile, **levels)))
    return combinations


def measure(name, n, size, combinations, repeats):
    """Rows of the combinations, both exact twins and the three named settings, timed in turn."""
    scene = splat_scene(name, n, size)
    runs = {
        ("combination", *what.values()): (what, partial(tiled, scene, settings))
        for what, settings in combinations
    }
    blank = dict(footprint="dense", cut="", dtype="float32", tile="", stop="0")
    runs["dense"] = blank, lambda: exact(scene, "float32")
    for setting, s in SETTINGS.items():
        what = {**blank, "footprint": setting, "dtype": s.dtype, "stop": f"{s.stop:g}"}
        run = partial(exact, scene) if s.footprint == "all" else partial(tiled, scene, s)
        runs[setting] = what, run
    times = alternate({key: run for key, (_, run) in runs.items()}, repeats)
    truth = exact(scene)
    return [
        {"scene": name, **what, **times[key].columns(), **errors(run(), truth)}
        for key, (what, run) in runs.items()
    ]


def summary_rows(repeats=7):
    """Error and time of the three named settings on the study's first scene."""
    rows = measure("small splats", *SUMMARY_SIZE, [], repeats)
    columns = ["ms", "ms_low", "ms_high", "stretch", "pairs", "error", "rms_error"]
    columns += [f"{name}_error" for name in GRADIENTS]
    named = {name: at(rows, footprint=name) for name in SETTINGS}
    return [{"settings": name, **{key: named[name][key] for key in columns}} for name in named]


def method_rows(rows, tile=8, stop="1e-4"):
    """The rows of the diagram: a method is footprint and precision, the knob the ellipse's cut."""
    labels = {"ellipse": "ellipse, cut labelled", "all": "all pairs", "box": "3σ box"}
    single = {"dense": "exact twin, float32", "paper": "setting `paper`", "fast": "setting `fast`"}
    chosen = []
    for row in rows:
        where = row["footprint"]
        side = 16 if where == "box" else tile
        if where in labels and (row["tile"], row["stop"]) == (side, stop):
            chosen.append({**row, "method": f"{labels[where]}, {row['dtype']}", "knob": row["cut"]})
        elif where in single:
            chosen.append({**row, "method": single[where], "knob": ""})
    first = ["ellipse, cut labelled, float32", "ellipse, cut labelled, float64", "3σ box, float32"]
    order = {method: place for place, method in enumerate(first)}
    return sorted(chosen, key=lambda row: order.get(row["method"], len(first)))


def run(folder, quick, progress, jobs=1):
    n, size, repeats = (300, 48, 3) if quick else (*SUMMARY_SIZE, 5)
    rows = []
    for name in SCENES:
        progress(f"rendering: {name}")
        count = n if name == "small splats" else n // 3
        rows += measure(name, count, size, grid(quick), repeats)
    small = select(rows, scene="small splats")
    exact_ms = at(small, footprint="exact")["ms"]
    title = (
        f"{n} splats in {size}×{size} pixels, forward and backward\nreference: exact twin in "
        f"float64, {exact_ms:.3g} ms; stop at T < 1e-4, tiles of 8×8 (box: 16×16)"
    )
    work_precision(folder / "rendering.png", method_rows(small), IMAGE_ERROR, title, 3)
    draw_gradients(folder / "rendering_gradients.png", method_rows(small), title)
    draw_tiles(folder / "rendering_tiles.png", rows)
    return Finding(
        "rendering",
        "Rendering",
        "the exact twin in float64, which takes every Gaussian at every pixel",
        [
            ("rendering.png", "Error of the image against time."),
            (
                "rendering_gradients.png",
                "Error of every gradient against time, for a white-noise cotangent.",
            ),
            (
                "rendering_tiles.png",
                "Tile size and stop, for small splats and for large opaque ones.",
            ),
        ],
        [table(folder, "rendering", rows)],
        read(rows),
        f"median and quartiles of {repeats} alternating repeats, forward and backward",
        stretch_of(rows),
    )


def draw_gradients(path, rows, title):
    axes = TIME._replace(x_label="processor time (ms)", y_label="relative L2 error")
    contents = [
        (f"gradient of {label}", rows, axes._replace(y=f"{name}_error"))
        for name, label in GRADIENTS.items()
    ]
    fig, panels = draw_panels(contents, (8, 7.5), rows=2, sharex=True, label=False)
    legend_below(fig, panels[0], 3)
    finish(fig, path, title)


def draw_tiles(path, rows):
    """Error over time of the ellipse footprint in float32, one line per stop."""
    names = {"0": "no stop", **{stop: f"stop at T < {stop}" for stop in STOPS if stop != "0"}}
    ellipses = [
        {**row, "method": names[row["stop"]], "knob": row["tile"]}
        for row in select(rows, footprint="ellipse", dtype="float32", cut="5e-5")
    ]
    axes = IMAGE_ERROR._replace(x_label="processor time (ms)")
    contents = [(name, select(ellipses, scene=name), axes) for name in SCENES]
    fig, panels = draw_panels(contents, (8, 5), margins=(0.15, 0.15))
    legend_below(fig, panels[0], 3)
    finish(
        fig,
        path,
        "tile side (labelled) and stop: ellipse cut at 5e-5, float32\n"
        "reference: exact twin in float64",
    )


def read(rows):
    """What the numbers say."""
    small, large = (select(rows, scene=name) for name in SCENES)
    exact_, paper, fast_ = (at(small, footprint=name) for name in ("exact", "paper", "fast"))
    all_pairs = select(small, footprint="all", dtype="float32", stop="0")
    rounding = min(row["error"] for row in all_pairs)
    ellipses = select(large, footprint="ellipse", dtype="float32", cut="5e-5")
    without, early = (
        min(select(ellipses, stop=stop), key=lambda row: row["ms"]) for stop in ("0", "1e-4")
    )
    faster = compare("`fast`", fast_, "`paper`", paper)
    stop = compare(
        f"on large opaque splats the best tile without a stop ({without['tile']} pixels)",
        without,
        f"the best one with the stop ({early['tile']} pixels)",
        early,
    )
    return (
        f"{faster} The exact twin takes {stated(exact_)}. They evaluate {fast_['pairs']:,}, "
        f"{paper['pairs']:,} and {exact_['pairs']:,} Gaussian–pixel pairs. The largest error of "
        f"the image is {number(fast_['error'])} for `fast` and {number(paper['error'])} for "
        f"`paper`; the worst gradient is off by {number(fast_['gradient_error'])} and "
        f"{number(paper['gradient_error'])}. float32 without any cut costs {number(rounding)} in "
        f"the image, so the cut of `fast` weighs {number(fast_['error'] / rounding)} times as much "
        f"as its precision. {stop}"
    )
