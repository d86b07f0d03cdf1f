"""The ledger of effects: what each effect of the closed list costs a scene, and what it is worth.

Trainings with the scene's own list are compared with others in which one effect alone is switched,
at the same seeds. A gain counts as one where it is larger than twice its standard error. Work and
bytes are those that go where this effect alone is switched off: hidden layers that it shares with
another one stay. Steps are timed in turn, so that whatever disturbs the machine disturbs all.
"""

from collections import Counter
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .. import effects as fx
from ..codec.file import decode
from ..model import declared_numbers
from ..report.figures import BLUE, save_figure, styled, subplots, write_csv
from ..scenes.scene import MODEL_EFFECTS
from ..splatting import render
from ..splatting.settings import FAST
from ..training.watch import equation_codes, watching
from .accuracy.harness import step_at
from .clock import alternate
from .tables import methods
from .tables.methods import OURS
from .writer import text_table, twice_standard_error

TURNS = 15  # of the steps that are timed
AS_LISTED = "as listed"
VIEW_EFFECTS = {  # the effect for which an equation of the anchor networks reads the view
    **dict.fromkeys(("opacity", "rotation", "scale"), "view_geometry"),
    "color": "view_color",
}
COLUMNS = {
    "effect": "{effect}",
    "listed": "{listed}",
    "ms on": "{ms_on:.2f}",
    "ms off": "{ms_off:.2f}",
    "bytes on": "{bytes_on:,.0f}",
    "bytes off": "{bytes_off:,.0f}",
    "work on": "{work_on:,.0f}",
    "work off": "{work_off:,.0f}",
    "worth dB": "{worth}",
}
UNITS = (
    "ms per training step; bytes of weights; multiply-adds of a frame; PSNR with it minus without "
    "it, test views, ± twice the standard error, and none if it is smaller"
)


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


def costs(data, views):
    """Columns of each effect that is on in a file: bytes, and multiply-adds of the mean frame."""
    model, sizes = decode(data), effect_bytes(data)
    occlusion = "occlusion" in model.design.effects
    with counted() as work:
        for view in views:
            *looks, _ = model.gaussians(view.time, view.camera)
            render.forward(*looks, view.camera, model.background, FAST, occlusion)
    return {
        f"{kind}_{effect}": amount
        for effect in model.design.effects
        for kind, amount in (
            ("bytes", sizes[effect]),
            ("work", round(work.multiply_adds[effect] / len(views))),
        )
    }


# --- the ledger -----------------------------------------------------------------------------------
def switched(scene, effect):
    """The scene with one effect more, or less, on its list."""
    return replace(scene, effects=set(scene.effects) ^ {effect})


def plan(scene, folder, seeds=3, **changes):
    """The Tasks of the scene as it is listed and with each effect alone switched, for each seed.

    `changes` are those of the preset.
    """
    builds = {None: scene}
    for effect in MODEL_EFFECTS:
        name = f"without {effect}" if effect in scene.effects else f"with {effect}"
        builds[name] = switched(scene, effect)
    whole = methods.plan({OURS: [changes]}, [OURS], [scene], folder, seeds, study="effects")
    return [
        task._replace(step=name, scene=build) for task in whole for name, build in builds.items()
    ]


def made(tasks):
    """The rows of Tasks that are there, with the `costs` of their files."""
    return [
        {**row, **costs(task.path.read_bytes(), task.scene.test)}
        for task in tasks
        for row in methods.made([task])
    ]


def summaries(rows):
    """What every effect costs and is worth, one row per effect in the order of the closed list.

    `rows` are those that `made` returns. A row has the fields effect, called_for, bytes_on,
    bytes_off, work_on and work_off, which are means over seeds, worth_db, and its
    twice_standard_error, which is None for one seed.
    """
    builds = {AS_LISTED: {}}  # {build: {seed: row}}
    for row in rows:
        build = row["label"] if row["label"].startswith("with") else AS_LISTED
        builds.setdefault(build, {})[row["seed"]] = row
    found = []
    for effect in MODEL_EFFECTS:
        called_for = f"without {effect}" in builds
        on, off = (builds[name] for name in build_names(effect, called_for))
        gains = [one["psnr_db"] - off[seed]["psnr_db"] for seed, one in on.items()]
        found.append(
            {
                "effect": effect,
                "called_for": called_for,
                **{
                    f"{kind}_{name}": float(np.mean([one.get(f"{kind}_{effect}", 0) for one in of]))
                    for kind in ("bytes", "work")
                    for name, of in (("on", on.values()), ("off", off.values()))
                },
                "worth_db": float(np.mean(gains)),
                "twice_standard_error": twice_standard_error(gains) if len(gains) > 1 else None,
            }
        )
    return found


def build_names(effect, called_for):
    """The names of the two builds that differ in an effect: the one with it, then without it."""
    return (AS_LISTED, f"without {effect}") if called_for else (f"with {effect}", AS_LISTED)


def collect(tasks, folder):
    """Write effects.csv, the rows that are made, and effects.png; returns the ledger.

    These are the `summaries` with ms_on and ms_off, the times of a step of stage 4, when every
    effect takes part, in the two builds that differ in an effect.
    """
    trained = made(tasks)
    write_csv(folder / "effects.csv", trained)
    rows = summaries(trained)
    draw_ledger(folder / "effects.png", rows)
    builds = {task.step or AS_LISTED: task for task in tasks}
    steps = {name: step_at(task.scene, methods.preset_of(task), 4) for name, task in builds.items()}
    with np.errstate(all="ignore"):
        times = alternate(steps, TURNS)
    for row in rows:
        on, off = build_names(row["effect"], row["called_for"])
        row |= {"ms_on": times[on].median, "ms_off": times[off].median}
    return rows


def is_none(row):
    """Whether a gain cannot be told from none: it is within twice its standard error."""
    error = row["twice_standard_error"]
    return error is not None and abs(row["worth_db"]) <= error


def said(row):
    """The gain of a row with twice its standard error, as text."""
    gain, error = f"{row['worth_db']:+.2f}", row["twice_standard_error"]
    if error is not None:
        gain += f" ±{error:.2f}"
    return f"none ({gain})" if is_none(row) else gain


def to_text(rows):
    """The ledger as text, a line per effect."""
    cells = [
        {**row, "listed": "yes" if row["called_for"] else "no", "worth": said(row)} for row in rows
    ]
    return "\n".join([*text_table(COLUMNS, cells), "", UNITS])


@styled({"font.size": 10.5, "axes.titlesize": 10.5, "figure.dpi": 200})
def draw_ledger(path, rows):
    """Work, bytes and gain of every effect; those that the scene does not list are at zero.

    A gain that is smaller than twice its standard error is drawn as none. In brackets is what an
    effect that is not listed would cost and gain.
    """
    from matplotlib.ticker import EngFormatter

    form = EngFormatter(places=1, sep=" ")
    panels = {
        "Work: multiplications of a frame": [
            (row["work_on"], form(row["work_on"])) for row in rows
        ],
        "Bytes of its weights (float16)": [
            (row["bytes_on"], f"{row['bytes_on']:,.0f}") for row in rows
        ],
        "Gain: dB with it, minus without": [
            (0 if is_none(row) else row["worth_db"], said(row)) for row in rows
        ],
    }
    figure, axes = subplots(3, figsize=(4.2, 6.6))
    for ax, (title, bars) in zip(axes, panels.items()):
        for row, (value, text) in zip(rows, bars):
            if not row["called_for"]:
                value, text = 0, f"0 (if on: {text.partition(' (')[0]})"
            ax.barh(row["effect"], value, color=BLUE)
            ax.annotate(
                text,
                (max(value, 0), row["effect"]),
                (3, 0),
                textcoords="offset points",
                va="center",
                color="black" if row["called_for"] else "#606060",
            )
        ax.set_title(title, loc="left", fontweight="bold")
        ax.set(xticks=[], xmargin=0.8)
        ax.invert_yaxis()
        ax.spines[["top", "right", "bottom"]].set_visible(False)
    note = "An effect that the scene does not list is at 0.\n± is twice the standard error."
    figure.suptitle(note, fontsize=10.5)
    save_figure(figure, path)
