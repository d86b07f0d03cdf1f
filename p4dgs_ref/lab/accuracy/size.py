"""Study 8, cost against size: time and memory of every part of a step over anchors and pixels.

The architecture is the paper's (its preset `paper_synthetic`) with fewer anchors, at the start of
stage 4. Arithmetic carries the costs on to the paper's size: the work of every part is counted
there, and takes the time per unit of the largest size that was measured.
"""

import tracemalloc
from dataclasses import replace
from itertools import product

import numpy as np

from ...model import ANCHOR_NETWORKS, CONTEXT_NETWORKS
from ...scenes import load_scene
from ...scenes.scene import Scene
from ...splatting import fast
from ...training.presets import PAPER_SYNTHETIC
from ...training.trainer import Trainer
from ..bench import memory_of, part_by_part, replaced, step_times
from ..clock import stretch_of, times_of
from .diagram import Axes, Finding, draw_panels, finish, legend_below, number, select, table
from .fits import multiply_adds
from .rendering import evaluated_pairs

GOAL_ANCHORS, GOAL_SIDE = 21_000, 800  # the paper's synthetic scenes
SMALL = 32  # pixels along a side of the scene that others are blown up from
LIVE = 4  # rendered children of an anchor: the paper speaks of three to four of its ten
FIRST_STAGE = {"deformation": 3, "rate": 4}  # of the parts that begin late
UNITS = {  # what the work of every part is counted in
    "prediction": "multiply-adds",
    "deformation": "multiply-adds",
    "projection": "Gaussians",
    "compositing": "pairs",
    "loss": "pixels",
    "rate": "multiply-adds",
    "optimiser": "parameters",
}
WINDOWS, WINDOW_SIDE = (
    4,
    40,
)  # the picture at the goal is sampled by 4 x 4 windows of 40 x 40 pixels


def blown_up(scene, factor, frames=None):
    """The scene with every pixel repeated factor x factor times; only the first `frames` views."""
    views = []
    for view in scene.train[:frames]:
        c = view.camera
        camera = replace(
            c,
            f_x=factor * c.f_x,
            f_y=factor * c.f_y,
            c_x=factor * (c.c_x + 0.5) - 0.5,
            c_y=factor * (c.c_y + 0.5) - 0.5,
            width=factor * c.width,
            height=factor * c.height,
        )
        image = view.image.repeat(factor, 0).repeat(factor, 1)
        views.append(replace(view, image=image, alpha=None, camera=camera))
    return Scene(scene.name, views, effects=scene.effects, background=scene.background)


def prepared(scene, anchors):
    """A trainer at the start of stage 4, LIVE children per anchor, opacities 0.1 to 0.9.

    Untrained networks would give all anchors the same opacities of random signs, so that the number
    of Gaussians would be a matter of chance.
    """
    trainer = Trainer(scene, PAPER_SYNTHETIC._replace(anchors=anchors))
    trainer.mask[:, LIVE:] = False
    weights, biases = trainer.networks["psi_alpha"]
    opacities = np.resize(np.linspace(0.1, 0.9, LIVE), trainer.design.k)
    weights[-1][...], biases[-1][...] = 0, np.arctanh(opacities)
    trainer.iteration = trainer.preset.stage_ends[2]
    return trainer


def at_stage_4(scene, anchors):
    """A prepared trainer after its first step."""
    trainer = prepared(scene, anchors)
    trainer.step()
    return trainer


def weighed(function, *args, **kwargs):
    """The result of a function and the megabytes it holds at its worst moment."""
    tracemalloc.reset_peak()
    before, _ = tracemalloc.get_traced_memory()
    result = function(*args, **kwargs)
    return result, (tracemalloc.get_traced_memory()[1] - before) / 1e6


def part_memory(trainer):
    """Megabytes that each part of a step and the whole step hold at their worst moment."""
    whole = memory_of(trainer.step)
    tracemalloc.start()
    try:
        parts = part_by_part(trainer, weighed)
    finally:
        tracemalloc.stop()
    return {**{part: max(calls) for part, calls in parts.items()}, "whole step": whole}


def counted(trainer, pixels):
    """Work of one step: {part: amount} in the units of every part, and its Gaussians."""
    found, forward = {}, fast.forward

    def run(mean2d, *args, **kwargs):
        output, saved = forward(mean2d, *args, **kwargs)
        found.update(gaussians=len(mean2d), pairs=evaluated_pairs(saved))
        return output, saved

    with replaced(fast, forward=run):
        trainer.step()
    return work_of(trainer, pixels=pixels, **found)


def work_of(trainer, gaussians, pairs, pixels):
    """{part: amount of work} of one step."""
    A, design = len(trainer.mask), trainer.design
    return {
        "prediction": multiply_adds(design, ANCHOR_NETWORKS, A),
        "deformation": multiply_adds(design, ("psi_d",), gaussians),
        "projection": gaussians,
        "compositing": pairs,
        "loss": pixels,
        "rate": multiply_adds(design, CONTEXT_NETWORKS, A),
        "optimiser": trainer.parameters.vector.size,
    }


def work_at_goal():
    """The work of one step at the size of the paper's synthetic scenes, without doing it.

    The pairs are counted in some windows of the picture and scaled up to all of it.
    """
    small = load_scene("bouncing", downscale=64 // SMALL)
    trainer = prepared(blown_up(small, GOAL_SIDE // SMALL, 1), GOAL_ANCHORS)
    view, found, forward = trainer.scene.train[0], {}, fast.forward
    corners = np.linspace(0, GOAL_SIDE - WINDOW_SIDE, WINDOWS).round()

    def run(mean2d, cov2d, conic, alpha, color, depth, visible, background, height, width, *rest):
        splats, pairs = (alpha, color, depth, visible, background), 0
        for corner in product(corners, corners):
            moved = mean2d - np.array(corner)
            output, saved = forward(
                moved, cov2d, conic, *splats, WINDOW_SIDE, WINDOW_SIDE, *rest[:2]
            )
            pairs += evaluated_pairs(saved)
        share = (WINDOWS * WINDOW_SIDE) ** 2 / (height * width)
        found.update(gaussians=len(mean2d), pairs=round(pairs / share))
        return output, saved

    with replaced(fast, forward=run):
        trainer.model().render(view.camera, view.time)
    return work_of(trainer, pixels=GOAL_SIDE**2, **found)


def measure(points, rounds, progress):
    """Rows of every part at every (anchors, side).

    Times are medians over rounds that visit all sizes.
    """
    small = load_scene("bouncing", downscale=64 // SMALL)
    progress("size: trainers")
    times, rows = {point: [] for point in points}, []
    with np.errstate(all="ignore"):
        trainers = {
            (anchors, side): at_stage_4(blown_up(small, side // SMALL, 8), anchors)
            for anchors, side in points
        }
        for i in range(rounds):
            progress(f"size: times, round {i + 1} of {rounds}")
            for point, trainer in trainers.items():
                times[point].append(step_times(trainer))
        progress("size: memory")
        for (anchors, side), trainer in trainers.items():
            about = {"anchors": anchors, "side": side, "pixels": side**2}
            memory, work = part_memory(trainer), counted(trainer, side**2)
            for part, mb in memory.items():
                taken = times_of([measured[part] for measured in times[anchors, side]])
                amount = {"work": work.get(part, ""), "unit": UNITS.get(part, "")}
                pairs = {"pairs": work["compositing"]}
                rows.append({"part": part, **about, **taken.columns(), "mb": mb, **amount, **pairs})
    return rows


# --- the size of the paper's scenes --------------------------------------------------------------
def hours(rows, goal):
    """Rows of every part: time per unit of work, hours of the paper's schedule, gigabytes.

    Time and memory per unit are those of the largest size. What a part does once in a step,
    whatever the size, is counted as if it grew with the size, so both are rather too large.
    """
    ends, found = (0, *PAPER_SYNTHETIC.stage_ends), []
    for part, unit in UNITS.items():
        largest = max(select(rows, part=part), key=lambda row: row["work"])
        steps = ends[4] - ends[FIRST_STAGE.get(part, 1) - 1]
        total = goal[part] * steps / 3.6e6
        gb = largest["mb"] / largest["work"] * goal[part] / 1e3
        row = {"part": part, "unit": unit, "work": goal[part], "steps": steps, "gb": gb}
        for end in ("", "_low", "_high"):
            rate = largest[f"ms{end}"] / largest["work"]
            row |= {f"ns_per_unit{end}": 1e6 * rate, f"hours{end}": rate * total}
        found.append(row)
    return found


def run(folder, quick, progress, jobs=1):
    middle, side = (500, 64) if quick else (1000, 64)
    anchors = (125, 2000) if quick else (250, 500, 2000, 4000)
    sides = (32, 128) if quick else (32, 128, 256)
    points = [(middle, side), *((A, side) for A in anchors), *((middle, s) for s in sides)]
    rounds = 3 if quick else 5
    rows = measure(points, rounds, progress)
    progress("size: counting the work at the paper's size")
    goal = work_at_goal()
    by_part = hours(rows, goal)
    for name, what, label in (
        ("size.png", "ms", "processor time of a step (ms)"),
        ("size_memory.png", "mb", "memory at its worst moment (MB)"),
    ):
        draw_parts(folder / name, rows, middle, side, what, label)
    return Finding(
        "size",
        "Cost against size",
        "none, as these are costs; the paper's architecture with fewer anchors",
        [
            (
                "size.png",
                "Processor time of every part of a training step over anchors and pixels.",
            ),
            ("size_memory.png", "Memory of every part of a training step."),
        ],
        [
            table(folder, "size", rows),
            table(folder, "size_hours", by_part),
        ],
        read(rows, by_part),
        f"median and quartiles over {rounds} rounds through all sizes, one step each",
        stretch_of(rows),
    )


def draw_parts(path, rows, middle, side, what, label):
    """Two panels: over anchors at one size of the picture, over pixels at one number of anchors."""
    by_size = sorted(rows, key=lambda row: (row["anchors"], row["pixels"]))
    shown = [{**row, "method": row["part"]} for row in by_size]
    over_anchors = Axes("anchors", what, f"anchors, {side}×{side} pixels", label)
    over_pixels = Axes("pixels", what, f"pixels, {middle} anchors", label)
    contents = [
        ("", select(shown, side=side), over_anchors),
        ("", select(shown, anchors=middle), over_pixels),
    ]
    fig, panels = draw_panels(contents, (8, 6.2), sharey=True, label=False)
    legend_below(fig, panels[0], 4)
    finish(fig, path, "the paper's architecture with fewer anchors, a step of stage 4")


def read(rows, by_part):
    """What the numbers say."""
    total, low, high = (sum(row[f"hours{end}"] for row in by_part) for end in ("", "_low", "_high"))
    order = sorted(by_part, key=lambda row: -row["hours"])
    rates = [
        f"{row['part']} {number(row['ns_per_unit'])} ns for each of "
        f"{number(row['work'])} {row['unit']}"
        for row in order[:3]
    ]
    largest = [f"{row['part']} {amount(row['hours'])}" for row in order[:3]]
    answer = (
        f"training takes about {amount(total)} hours of one core ({amount(low)} to {amount(high)} "
        f"between the quartiles; {', '.join(largest)})"
    )
    if high - low > total:
        answer = (
            f"we cannot tell how long training takes: between {amount(low)} and {amount(high)} "
            "hours of one core"
        )
    return (
        f"One step at the size of the paper's synthetic scenes ({GOAL_SIDE}×{GOAL_SIDE} pixels, "
        f"{GOAL_ANCHORS:,} anchors) has counted work, and its time follows from the times per unit "
        f"at the largest sizes measured, {max(row['anchors'] for row in rows):,} anchors and "
        f"{max(row['side'] for row in rows)} pixels a side: {'; '.join(rates)}. In "
        f"{PAPER_SYNTHETIC.iterations:,} iterations {answer}. That is a plan for a port, not a "
        f"promise. The parts of a step hold {sum(row['gb'] for row in by_part):.1f} GB."
    )


def amount(value):
    """Hours for a sentence: whole ones, two digits below ten."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
