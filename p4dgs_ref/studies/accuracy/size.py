"""Study 8, cost against size: time and memory of every part of a step over anchors, pixels and frames, and what follows.

The paper's architecture (its `paper_synthetic` preset) with fewer anchors, at the start of stage 4.
"""

import time
import tracemalloc
from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from ...scenes import load_scene
from ...scenes.scene import Scene
from ...splatting import fast
from ...training.presets import PAPER_SYNTHETIC
from ...training.trainer import Trainer
from ..bench import PARTS, memory_of
from .diagram import Axes, Finding, figure, finish, lines, table
from .fits import multiply_adds
from .timing import alternate, exponents, replaced

GOAL = dict(anchors=21_000, side=800)  # the paper's synthetic scenes
SMALL = 32  # pixels along a side of the scene that others are blown up from
LIVE = 4  # children of an anchor that are rendered: the paper speaks of three to four of its ten
STAGE_OF = {"deformation": 3, "rate": 4}  # parts that begin in a later stage


def blown_up(scene, factor, frames=None):
    """The scene with every pixel repeated factor x factor times, the cameras to match, and some of its views."""

    def view(v):
        c = v.camera
        camera = replace(
            c,
            f_x=factor * c.f_x,
            f_y=factor * c.f_y,
            c_x=factor * (c.c_x + 0.5) - 0.5,
            c_y=factor * (c.c_y + 0.5) - 0.5,
            width=factor * c.width,
            height=factor * c.height,
        )
        return replace(
            v, image=v.image.repeat(factor, 0).repeat(factor, 1), alpha=None, camera=camera
        )

    return Scene(
        scene.name,
        [view(v) for v in scene.train[:frames]],
        effects=scene.effects,
        background=scene.background,
    )


def at_stage_4(scene, anchors):
    """A trainer that has just taken its first step of stage 4, LIVE children an anchor with opacities from 0.1 to 0.9.

    Untrained networks would give every anchor the same opacities, of random signs: Gaussians would come and go by chance.
    """
    trainer = Trainer(scene, PAPER_SYNTHETIC._replace(anchors=anchors))
    trainer.mask[:, LIVE:] = False
    weights, biases = trainer.networks["psi_alpha"]
    weights[-1][...], biases[-1][...] = (
        0,
        np.arctanh(np.resize(np.linspace(0.1, 0.9, LIVE), trainer.design.k)),
    )
    trainer.iteration = trainer.preset.stage_ends[2]
    trainer.step()
    return trainer


class Clock:
    """Milliseconds a part takes in all its calls of one step."""

    begin = staticmethod(time.perf_counter)

    @staticmethod
    def end(total, start):
        return total + 1e3 * (time.perf_counter() - start)


class Scale:
    """Megabytes that a part holds at the worst moment of any of its calls."""

    @staticmethod
    def begin():
        tracemalloc.reset_peak()
        return tracemalloc.get_traced_memory()[0]

    @staticmethod
    def end(most, before):
        return max(most, (tracemalloc.get_traced_memory()[1] - before) / 1e6)


def part_by_part(trainer, gauge):
    """One step, every function of every part wrapped by a gauge: {part: value}."""
    values = dict.fromkeys(PARTS, 0.0)

    def watched(part, function):
        def run(*args, **kwargs):
            start = gauge.begin()
            result = function(*args, **kwargs)
            values[part] = gauge.end(values[part], start)
            return result

        return run

    with ExitStack() as stack:
        for part, places in PARTS.items():
            for owner, name in places:
                stack.enter_context(replaced(owner, **{name: watched(part, getattr(owner, name))}))
        start = time.perf_counter()
        trainer.step()
        whole = 1e3 * (time.perf_counter() - start)
    return {**values, "whole step": whole}


def part_memory(trainer):
    """Megabytes that each part of a step and the whole step hold at their worst moment: {part: MB}."""
    whole = memory_of(trainer.step)
    tracemalloc.start()
    try:
        return {**part_by_part(trainer, Scale), "whole step": whole}
    finally:
        tracemalloc.stop()


def counted(trainer):
    """Work of one step: Gaussians, Gaussian-pixel pairs evaluated, multiply-adds of the deformation network."""
    found, forward = {}, fast.forward

    def run(*args, **kwargs):
        out, res = forward(*args, **kwargs)
        found.update(gaussians=res.inputs["n"], pairs=sum(chunk.A.size for chunk in res.chunks))
        return out, res

    with replaced(fast, forward=run):
        trainer.step()
    return {**found, "multiply_adds": multiply_adds(trainer.design, ("psi_d",), found["gaussians"])}


def measure(points, rounds, progress):
    """Rows of every part at every (anchors, side): median milliseconds over rounds that visit all sizes, megabytes, work."""
    small = load_scene("bouncing", downscale=64 // SMALL)
    scenes = {
        side: blown_up(small, side // SMALL, 8) for side in sorted({side for _, side in points})
    }
    times, rows = {point: [] for point in points}, []
    with np.errstate(all="ignore"):
        progress("size: trainers")
        trainers = {(anchors, side): at_stage_4(scenes[side], anchors) for anchors, side in points}
        for i in range(rounds):
            progress(f"size: times, round {i + 1} of {rounds}")
            for point, trainer in trainers.items():
                times[point].append(part_by_part(trainer, Clock))
        progress("size: memory")
        for (anchors, side), trainer in trainers.items():
            memory, work = part_memory(trainer), counted(trainer)
            rows += [
                {
                    "part": part,
                    "anchors": anchors,
                    "side": side,
                    "pixels": side**2,
                    "ms": float(np.median([measured[part] for measured in times[anchors, side]])),
                    "mb": mb,
                    **work,
                }
                for part, mb in memory.items()
            ]
    return rows


def frame_rows(counts, repeats, progress):
    """One pass of stage 4 over all frames of a scene: milliseconds, megabytes, and bytes of the pictures themselves."""
    small = load_scene("bouncing", downscale=64 // SMALL)
    progress("size: frames")
    trainers = {frames: at_stage_4(blown_up(small, 2, frames), 100) for frames in counts}
    passes = {
        frames: lambda trainer=trainer: [trainer.step() for _ in trainer.scene.train]
        for frames, trainer in trainers.items()
    }
    ms, rows = alternate(passes, repeats), []
    for frames, trainer in trainers.items():
        trainer.moments.clear()  # so that the pass is seen to fill them
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


def fits(rows, what):
    """{part: [a, exponent of anchors, exponent of pixels]} of what = e^a anchors^b pixels^c."""
    found = {}
    for part in dict.fromkeys(row["part"] for row in rows):
        own = [row for row in rows if row["part"] == part and row[what] > 0]
        found[part] = exponents(
            [(row["anchors"], row["pixels"]) for row in own], [row[what] for row in own]
        )
    return found


def extrapolate(fit, anchors, pixels):
    return float(np.exp(fit @ [1, np.log(anchors), np.log(pixels)]))


def hours(rows):
    """Hours of the paper's schedule at its size, part by part, each over the iterations in which it takes part."""
    ends = PAPER_SYNTHETIC.stage_ends
    found = {}
    for part, fit in fits(rows, "ms").items():
        begin = {3: ends[1], 4: ends[2]}.get(STAGE_OF.get(part), 0)
        ms = extrapolate(fit, GOAL["anchors"], GOAL["side"] ** 2)
        found[part] = ms * (ends[3] - begin) / 3.6e6
    del found["whole step"]
    return found


def run(folder, quick, progress):
    middle, side = (100, 64) if quick else (1000, 64)
    anchors = (50, 200) if quick else (250, 500, 2000, 4000)
    sides = (32, 128) if quick else (32, 128, 256)
    points = [(middle, side), *((A, side) for A in anchors), *((middle, s) for s in sides)]
    rounds = 3 if quick else 5
    rows = measure(points, rounds, progress)
    frames = frame_rows((3, 6, 12) if quick else (4, 8, 16, 32), 3, progress)
    extrapolated = [{"part": part, "hours": value} for part, value in hours(rows).items()]
    files = [
        table(folder, "size", rows),
        table(folder, "size_frames", frames),
        table(folder, "size_hours", extrapolated),
    ]
    draw_parts(folder / "size.png", rows, middle, side, "ms", "time of a step (ms)")
    draw_parts(
        folder / "size_memory.png", rows, middle, side, "mb", "memory at its worst moment (MB)"
    )
    draw_frames(folder / "size_frames.png", frames)
    figures = [
        (
            "size.png",
            "Time of every part of a training step over anchors and pixels, exponents in the legend.",
        ),
        ("size_memory.png", "Memory, the same."),
        ("size_frames.png", "A pass over all frames."),
    ]
    return Finding(
        "size",
        "Cost against size",
        "none: these are costs; the paper's architecture with fewer anchors",
        figures,
        files,
        read(rows, frames),
        f"median over {rounds} rounds through all sizes, a step each",
    )


def draw_parts(path, rows, middle, side, what, label):
    """Two panels: over anchors at one picture size, over pixels at one number of anchors."""
    fig, panels = figure(2, (8, 6.2), sharey=True)
    fit = fits(rows, what)
    shown = [
        {
            **row,
            "method": f"{row['part']} ({power(fit[row['part']][1])}, {power(fit[row['part']][2])})",
        }
        for row in rows
    ]
    for ax, x, fixed_, unit in (
        (panels[0], "anchors", ("side", side), f"anchors, {side}×{side} pixels"),
        (panels[1], "pixels", ("anchors", middle), f"pixels, {middle} anchors"),
    ):
        own = sorted((row for row in shown if row[fixed_[0]] == fixed_[1]), key=lambda row: row[x])
        lines(
            ax,
            own,
            Axes(x, what, unit, label if ax is panels[0] else ""),
            label=False,
            order=list(dict.fromkeys(row["method"] for row in shown)),
        )
    fig.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=2,
        fontsize=10,
        frameon=False,
        title="fitted exponents in brackets: of anchors, of pixels",
        title_fontsize=10,
    )
    finish(fig, path, "the paper's architecture with fewer anchors, a step of stage 4")


def power(b):
    """An exponent with one decimal, zero without a sign."""
    return f"{round(b, 1) + 0.0:.1f}"


def draw_frames(path, rows):
    fig, panels = figure(2, (8, 5))
    for ax, what, label in zip(panels, ("ms", "mb"), ("time (ms)", "memory (MB)")):
        b = exponents([(row["frames"],) for row in rows], [row[what] for row in rows])[1]
        lines(ax, rows, Axes("frames", what, "frames", label))
        ax.set_title(f"exponent {b:.2f}")
    finish(fig, path, "one pass over all frames, 64×64 pixels, 100 anchors")


def hours_by_work(rows):
    """Compositing's hours again, from its counted pairs alone: their fitted growth, times what a pair took at the most."""
    own = [row for row in rows if row["part"] == "compositing"]
    fit = fits(own, "pairs")["compositing"]
    largest = max(own, key=lambda row: row["pairs"])
    pairs = extrapolate(fit, GOAL["anchors"], GOAL["side"] ** 2)
    return pairs * largest["ms"] / largest["pairs"] * PAPER_SYNTHETIC.iterations / 3.6e6, fit[1:]


def read(rows, frames):
    """What the numbers say."""
    fit, per_part, memory = fits(rows, "ms"), hours(rows), fits(rows, "mb")["whole step"]
    order = sorted(per_part, key=per_part.get, reverse=True)
    b = exponents([(row["frames"],) for row in frames], [row["ms"] for row in frames])[1]
    again, (pairs_A, pairs_P) = hours_by_work(rows)
    grown = {part: fit[part][1:] for part in ("deformation", "compositing", "loss")}
    return (
        "The time of a step grows with the power of anchors and pixels: "
        + ", ".join(f"{part} {A:.2f} and {P:.2f}" for part, (A, P) in grown.items())
        + f"; the Gaussian–pixel pairs, counted, with {pairs_A:.2f} and {pairs_P:.2f}; a pass over the frames with the power "
        f"{b:.2f} of their number. Carried on to the paper's synthetic scenes ({GOAL['side']}×{GOAL['side']} pixels, "
        f"{GOAL['anchors']:,} anchors, {PAPER_SYNTHETIC.iterations:,} iterations) this is {amount(sum(per_part.values()))} "
        f"hours on one core, of which {order[0]} takes {amount(per_part[order[0]])}, {order[1]} "
        f"{amount(per_part[order[1]])} and {order[2]} {amount(per_part[order[2]])}, and "
        f"{extrapolate(memory, GOAL['anchors'], GOAL['side'] ** 2) / 1e3:.1f} GB: as a plan for a port, not a promise. From "
        f"its counted pairs alone compositing would take {amount(again)} hours; the fits reach "
        f"{max(row['anchors'] for row in rows):,} anchors and {max(row['side'] for row in rows)} pixels a side, so the "
        "distance between the two says how far to trust them."
    )


def amount(value):
    """Hours for a sentence: whole ones, two digits below ten."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
