"""The ledger of effects: what each effect of the closed list costs a scene, and what it is worth.

One build has the scene's own list. For every effect there is another build in which that effect
alone is switched. Their steps are timed in turn, so that whatever disturbs the machine disturbs all
of them. Work and bytes are those that go where this effect alone is switched off: hidden layers
that it shares with another one stay.
"""

from collections import Counter
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .. import effects as fx
from ..designs import choose, decode, encode, trainer_of
from ..model import declared_numbers
from ..report.evaluate import evaluate
from ..report.figures import BLUE, ORANGE, save_figure, styled, subplots, write_csv
from ..report.jobs import in_processes
from ..scenes.scene import MODEL_EFFECTS
from ..training.watch import equation_codes, watching
from .accuracy.harness import shortened, step_at
from .clock import alternate
from .writer import text_table

TURNS = 15  # of the steps that are timed
AS_LISTED = "as listed"
VIEW_EFFECTS = {  # the effect for which an equation of the anchor networks reads the view
    **dict.fromkeys(("opacity", "rotation", "scale"), "view_geometry"),
    "color": "view_color",
}
COLUMNS = {
    "effect": "{effect}",
    "listed": "{called_for}",
    "ms on": "{ms_on:.2f}",
    "ms off": "{ms_off:.2f}",
    "bytes on": "{bytes_on:,}",
    "bytes off": "{bytes_off:,}",
    "work on": "{work_on:,}",
    "work off": "{work_off:,}",
    "worth dB": "{worth_db:+.2f}",
}
UNITS = "ms per step, multiply-adds of its forward; PSNR with it minus without it, test views"


# --- work and bytes -------------------------------------------------------------------------------
class Work(NamedTuple):
    """What equations did while they were watched."""

    calls: Counter  # {(equation, "forward" or "backward"): calls}
    multiply_adds: Counter  # {effect: multiply-adds of forwards}


@contextmanager
def counted():
    """A `with` block that gives the Work of the equations that are called in it."""
    work = Work(Counter(), Counter())

    def count(event, mark, frame, value):
        if event == "return":
            work.calls[mark] += 1
            if mark[1] == "forward":
                work.multiply_adds.update(multiply_adds(mark[0], value[1]))

    with watching(equation_codes(), count):
        yield work


def multiply_adds(key, saved):
    """{effect: multiply-adds} of a forward, from what it returns for its backward."""
    if key in VIEW_EFFECTS:
        (inputs, weights), d = saved[-1]
        return {VIEW_EFFECTS[key]: inputs[0][:, d:].size * weights[0].shape[1]}
    if key == "deformation":
        _, _, (inputs, (*trunk, last)), cuts = saved
        heads = dict(zip(fx.MOTION, np.split(last, cuts, axis=1)))
        on = {effect: head.size for effect, head in heads.items() if head.size}
        shared = sum(W.size for W in trunk) if len(on) == 1 else 0
        return {effect: len(inputs[0]) * (size + shared) for effect, size in on.items()}
    if key == "compositing, fast":
        chunks, T, background, occlusion, *_ = saved
        pairs = sum(A.size for _, _, A, *_ in chunks)
        return {"occlusion": 2 * pairs * occlusion, "background": 3 * T.size * background.any()}
    return {}


def effect_bytes(data):
    """{effect: bytes} of the weights in a file, two bytes each, that only this effect needs."""
    design = decode(data).design

    def size(effects):
        return 2 * declared_numbers(replace(design, effects=effects), 0)["networks"]

    without = {effect: [e for e in design.effects if e != effect] for effect in MODEL_EFFECTS}
    return {effect: size(design.effects) - size(others) for effect, others in without.items()}


# --- the ledger -----------------------------------------------------------------------------------
def switched(scene, effect):
    """The scene with one effect more, or less, on its list."""
    return replace(scene, effects=set(scene.effects) ^ {effect})


def train_alone(task):
    """Train one build: its file, PSNR, and of each effect the bytes and the work of a last step."""
    scene, preset, seed = task
    trainer = trainer_of(scene, preset, seed)
    with np.errstate(all="ignore"):  # an overflow stops training with its own message
        while trainer.iteration < preset.iterations - 1:
            trainer.step()
        with counted() as work:
            model = trainer.run()
    data = encode(model)
    return {
        "data": data,
        "psnr_db": evaluate(decode(data), scene)[0]["psnr_db"],
        "bytes": effect_bytes(data),
        "work": {effect: int(work.multiply_adds[effect]) for effect in MODEL_EFFECTS},
    }


def train_all(scenes, preset, seed, progress=lambda line: None, jobs=1):
    """Train builds of one scene in `jobs` processes, from {name: Scene} to {name: build}.

    A build has data, psnr_db, bytes and work as above, and ms, the time of a step of stage 4, when
    every effect takes part. Steps of all builds are timed in turn, in this process.
    """
    built, tasks = {}, [(scene, preset, seed) for scene in scenes.values()]
    for name, build in zip(scenes, in_processes(train_alone, tasks, jobs)):
        built[name] = build
        progress(f"{len(built)} of {len(scenes)} builds trained")
    with np.errstate(all="ignore"):
        steps = {name: step_at(scene, preset, 4) for name, scene in scenes.items()}
        times = alternate(steps, TURNS)
    return {name: {**build, "ms": times[name].median} for name, build in built.items()}


def ledger(scene, preset="tiny", seed=0, share=0.5, progress=lambda line: None, jobs=1, **changes):
    """What every effect costs and is worth, one row per effect in the order of the closed list.

    `changes` are fields of the preset; `share` is that of its iterations, 1 for all. A row has the
    fields effect, called_for, ms_on, ms_off, bytes_on, bytes_off, work_on, work_off and worth_db:
    ms of a whole step in the two builds that differ in this effect, bytes of its weights in the
    file, multiply-adds of its equations in the forward of a step, and the PSNR of the test views
    with it minus without it. Raises ValueError for an unknown preset or field.
    """
    preset = shortened(choose(preset, changes), share)
    builds = {AS_LISTED: scene, **{effect: switched(scene, effect) for effect in MODEL_EFFECTS}}
    built = train_all(builds, preset, seed, progress, jobs)
    listed = built[AS_LISTED]
    return [
        {
            "effect": effect,
            "called_for": effect in scene.effects,
            "ms_on": on["ms"],
            "ms_off": off["ms"],
            "bytes_on": on["bytes"][effect],
            "bytes_off": off["bytes"][effect],
            "work_on": on["work"][effect],
            "work_off": off["work"][effect],
            "worth_db": on["psnr_db"] - off["psnr_db"],
        }
        for effect in MODEL_EFFECTS
        for on, off in [
            (listed, built[effect]) if effect in scene.effects else (built[effect], listed)
        ]
    ]


def to_text(rows):
    """The ledger as text, a line per effect."""
    cells = [{**row, "called_for": "yes" if row["called_for"] else "no"} for row in rows]
    return "\n".join([*text_table(COLUMNS, cells), "", UNITS])


@styled()
def draw_ledger(path, rows):
    """Three bar charts, blue for listed effects and orange for the others; a CSV beside."""
    panels = {
        "work_on": ("multiply-adds in the forward of a step", "{:,.0f}"),
        "bytes_on": ("bytes in the file", "{:,.0f}"),
        "worth_db": ("PSNR with it minus without it (dB)", "{:+.2f}"),
    }
    figure, axes = subplots(1, 3, figsize=(13, 4.6), sharey=True)
    colors = [BLUE if row["called_for"] else ORANGE for row in rows]
    for ax, (name, (label, form)) in zip(axes, panels.items()):
        bars = ax.barh([row["effect"] for row in rows], [row[name] for row in rows], color=colors)
        ax.bar_label(bars, [form.format(row[name]) for row in rows], padding=3)
        ax.margins(x=0.3)  # room for the numbers
        ax.set(xlabel=label)
        ax.locator_params(axis="x", nbins=4)
    axes[0].invert_yaxis()
    figure.suptitle("blue: listed by the scene; orange: forced on")
    save_figure(figure, path)
    write_csv(path.with_suffix(".csv"), rows)
