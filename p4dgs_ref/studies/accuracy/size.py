"""Study 8, cost against size: time and memory of every part of a step over anchors and pixels.

The architecture is the paper's (its preset `paper_synthetic`) with fewer anchors, at the start of
stage 4. Fitted powers carry the costs on to the paper's size.
"""

import tracemalloc
from dataclasses import replace

import numpy as np

from ...scenes import load_scene
from ...scenes.scene import Scene
from ...splatting import fast
from ...training.presets import PAPER_SYNTHETIC
from ...training.trainer import Trainer
from ..bench import memory_of, part_by_part, step_times
from .diagram import Axes, Finding, draw_panels, finish, legend_below, select, table
from .fits import multiply_adds
from .rendering import evaluated_pairs
from .timing import alternate, exponents, replaced

GOAL_ANCHORS, GOAL_SIDE = 21_000, 800  # the paper's synthetic scenes
SMALL = 32  # pixels along a side of the scene that others are blown up from
LIVE = 4  # rendered children of an anchor: the paper speaks of three to four of its ten
FIRST_STAGE = {"deformation": 3, "rate": 4}  # of the parts that begin late


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


def at_stage_4(scene, anchors):
    """A trainer after its first step of stage 4, LIVE children per anchor, opacities 0.1 to 0.9.

    Untrained networks would give all anchors the same opacities of random signs, so that the number
    of Gaussians would be a matter of chance.
    """
    trainer = Trainer(scene, PAPER_SYNTHETIC._replace(anchors=anchors))
    trainer.mask[:, LIVE:] = False
    weights, biases = trainer.networks["psi_alpha"]
    opacities = np.resize(np.linspace(0.1, 0.9, LIVE), trainer.design.k)
    weights[-1][...], biases[-1][...] = 0, np.arctanh(opacities)
    trainer.iteration = trainer.preset.stage_ends[2]
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


def counted(trainer):
    """Work of one step: Gaussians, pairs, multiply-adds of the deformation network."""
    found, forward = {}, fast.forward

    def run(mean2d, *args, **kwargs):
        output, saved = forward(mean2d, *args, **kwargs)
        found.update(gaussians=len(mean2d), pairs=evaluated_pairs(saved))
        return output, saved

    with replaced(fast, forward=run):
        trainer.step()
    return {**found, "multiply_adds": multiply_adds(trainer.design, ("psi_d",), found["gaussians"])}


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
            memory, work = part_memory(trainer), counted(trainer)
            for part, mb in memory.items():
                ms = float(np.median([measured[part] for measured in times[anchors, side]]))
                rows.append({"part": part, **about, "ms": ms, "mb": mb, **work})
    return rows


def frame_rows(counts, repeats, progress):
    """One pass of stage 4 over all frames: milliseconds, megabytes, bytes of the pictures."""
    small = load_scene("bouncing", downscale=64 // SMALL)
    progress("size: frames")
    trainers = {frames: at_stage_4(blown_up(small, 2, frames), 100) for frames in counts}
    passes = {
        frames: lambda trainer=trainer: [trainer.step() for _ in trainer.scene.train]
        for frames, trainer in trainers.items()
    }
    ms, rows = alternate(passes, repeats), []
    for frames, trainer in trainers.items():
        trainer.moments.clear()  # so that the memory of the pass includes them
        rows.append(
            {
                "method": "one pass over the frames",
                "knob": frames,
                "frames": frames,
                "ms": ms[frames],
                "mb": memory_of(passes[frames]),
                "picture_mb": sum(v.image.nbytes for v in trainer.scene.train) / 1e6,
            }
        )
    return rows


# --- growth --------------------------------------------------------------------------------------
def growth(rows, what):
    """[a, b, c] of what = e^a anchors^b pixels^c."""
    positive = [row for row in rows if row[what] > 0]
    sizes = [(row["anchors"], row["pixels"]) for row in positive]
    return exponents(sizes, [row[what] for row in positive])


def fits(rows, what):
    """{part: [a, b, c]} of every part."""
    parts = dict.fromkeys(row["part"] for row in rows)
    return {part: growth(select(rows, part=part), what) for part in parts}


def frame_exponent(rows, what):
    """The power of the number of frames with which a pass grows."""
    return exponents([(row["frames"],) for row in rows], [row[what] for row in rows])[1]


def at_goal(fit):
    """A fit at the size of the paper's synthetic scenes."""
    return float(np.exp(fit @ [1, np.log(GOAL_ANCHORS), np.log(GOAL_SIDE**2)]))


def hours(rows):
    """Hours of the paper's schedule at its size, by part, over the part's iterations."""
    ends = (0, *PAPER_SYNTHETIC.stage_ends)
    return {
        part: at_goal(fit) * (ends[4] - ends[FIRST_STAGE.get(part, 1) - 1]) / 3.6e6
        for part, fit in fits(rows, "ms").items()
        if part != "whole step"
    }


def run(folder, quick, progress):
    middle, side = (100, 64) if quick else (1000, 64)
    anchors = (50, 200) if quick else (250, 500, 2000, 4000)
    sides = (32, 128) if quick else (32, 128, 256)
    points = [(middle, side), *((A, side) for A in anchors), *((middle, s) for s in sides)]
    rounds = 3 if quick else 5
    rows = measure(points, rounds, progress)
    frames = frame_rows((3, 6, 12) if quick else (4, 8, 16, 32), 3, progress)
    by_part = [{"part": part, "hours": value} for part, value in hours(rows).items()]
    for name, what, label in (
        ("size.png", "ms", "time of a step (ms)"),
        ("size_memory.png", "mb", "memory at its worst moment (MB)"),
    ):
        draw_parts(folder / name, rows, middle, side, what, label)
    draw_frames(folder / "size_frames.png", frames)
    return Finding(
        "size",
        "Cost against size",
        "none, as these are costs; the paper's architecture with fewer anchors",
        [
            (
                "size.png",
                "Time of every part of a training step over anchors and pixels, exponents in the "
                "legend.",
            ),
            ("size_memory.png", "Memory of every part of a training step."),
            ("size_frames.png", "A pass over all frames."),
        ],
        [
            table(folder, "size", rows),
            table(folder, "size_frames", frames),
            table(folder, "size_hours", by_part),
        ],
        read(rows, frames),
        f"median over {rounds} rounds through all sizes, one step each",
    )


def draw_parts(path, rows, middle, side, what, label):
    """Two panels: over anchors at one size of the picture, over pixels at one number of anchors."""
    names = {
        part: f"{part} ({one_decimal(b)}, {one_decimal(c)})"
        for part, (_, b, c) in fits(rows, what).items()
    }
    by_size = sorted(rows, key=lambda row: (row["anchors"], row["pixels"]))
    shown = [{**row, "method": names[row["part"]]} for row in by_size]
    over_anchors = Axes("anchors", what, f"anchors, {side}×{side} pixels", label)
    over_pixels = Axes("pixels", what, f"pixels, {middle} anchors", label)
    contents = [
        ("", select(shown, side=side), over_anchors),
        ("", select(shown, anchors=middle), over_pixels),
    ]
    fig, panels = draw_panels(contents, (8, 6.2), sharey=True, label=False, order=names.values())
    legend_below(
        fig,
        panels[0],
        2,
        title="fitted exponents in brackets: of anchors, of pixels",
        title_fontsize=10,
    )
    finish(fig, path, "the paper's architecture with fewer anchors, a step of stage 4")


def one_decimal(exponent):
    """An exponent for a legend, zero without a sign."""
    return f"{round(exponent, 1) + 0.0:.1f}"


def draw_frames(path, rows):
    contents = [
        (f"exponent {frame_exponent(rows, what):.2f}", rows, Axes("frames", what, "frames", label))
        for what, label in (("ms", "time (ms)"), ("mb", "memory (MB)"))
    ]
    fig, _ = draw_panels(contents, (8, 5))
    finish(fig, path, "one pass over all frames, 64×64 pixels, 100 anchors")


def hours_by_work(rows):
    """Hours of compositing from its counted pairs alone, and how the pairs grow.

    The fitted number of pairs is multiplied by the time of a pair at the largest measured size.
    """
    own = select(rows, part="compositing")
    fit = growth(own, "pairs")
    largest = max(own, key=lambda row: row["pairs"])
    per_pair = largest["ms"] / largest["pairs"]
    return at_goal(fit) * per_pair * PAPER_SYNTHETIC.iterations / 3.6e6, fit[1:]


def read(rows, frames):
    """What the numbers say."""
    fit, per_part = fits(rows, "ms"), hours(rows)
    gigabytes = at_goal(fits(rows, "mb")["whole step"]) / 1e3
    order = sorted(per_part, key=per_part.get, reverse=True)
    largest = [f"{part} {amount(per_part[part])}" for part in order[:3]]
    by_pairs, (pairs_A, pairs_P) = hours_by_work(rows)
    grown = [
        f"{part} {fit[part][1]:.2f} and {fit[part][2]:.2f}"
        for part in ("deformation", "compositing", "loss")
    ]
    return (
        f"The time of a step grows with these powers of anchors and pixels: {', '.join(grown)}; "
        f"the counted Gaussian–pixel pairs with {pairs_A:.2f} and {pairs_P:.2f}. A pass over the "
        f"frames grows with the power {frame_exponent(frames, 'ms'):.2f} of their number. "
        f"Extrapolated to the paper's synthetic scenes ({GOAL_SIDE}×{GOAL_SIDE} pixels, "
        f"{GOAL_ANCHORS:,} anchors, {PAPER_SYNTHETIC.iterations:,} iterations), training takes "
        f"{amount(sum(per_part.values()))} hours on one core ({', '.join(largest)}) and "
        f"{gigabytes:.1f} GB: a plan for a port, not a promise. Extrapolated from its counted "
        f"pairs alone, compositing would take {amount(by_pairs)} hours. The measurements reach "
        f"{max(row['anchors'] for row in rows):,} anchors and {max(row['side'] for row in rows)} "
        "pixels a side; the distance between the two estimates says how far to trust them."
    )


def amount(value):
    """Hours for a sentence: whole ones, two digits below ten."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
