"""The ledger of effects: what each effect of the closed list costs a scene, and what it is worth.

One build has the scene's own list. For every effect there is another build in which that effect
alone is switched. Their steps are timed in turn, so that whatever disturbs the machine disturbs all
of them.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...codec.file import decode, encode
from ...report.evaluate import evaluate
from ...report.figures import BLUE, ORANGE, pyplot, save_figure, write_csv
from ...report.jobs import in_processes
from ...scenes.scene import MODEL_EFFECTS
from ...training.presets import choose
from ...training.trainer import Trainer
from ..accuracy.fits import step_at
from ..clock import alternate
from ..writer import table
from .work import counted, effect_bytes

# The iterations of a preset that are shortened together with its stages.
SCHEDULE = ("decay_from", "grow_from", "grow_until", "collect_from", "mask_from")
COUNTED = 4  # last steps, whose work is counted
TURNS = 15  # of the steps that are timed
AS_LISTED = "as listed"
COLUMNS = {
    "effect": "{effect}",
    "listed": "{listed}",
    "ms on": "{ms_on:.2f}",
    "ms off": "{ms_off:.2f}",
    "bytes on": "{bytes_on:,}",
    "bytes off": "{bytes_off:,}",
    "work on": "{work_on:,}",
    "work off": "{work_off:,}",
    "sorted on": "{sorted_on:,}",
    "sorted off": "{sorted_off:,}",
    "lost off": "{psnr_lost_when_off:+.2f}",
    "gained on": "{psnr_gained_when_forced:+.2f}",
}


def shortened(preset, share):
    """The preset with a share of its iterations: all stages and dates are shortened alike."""
    ends = tuple(max(round(share * end), i + 1) for i, end in enumerate(preset.stage_ends))
    dates = {name: round(share * getattr(preset, name)) for name in SCHEDULE}
    return preset._replace(stage_ends=ends, **dates)


def switched(scene, effect):
    """The scene with one effect more, or less, on its list."""
    return replace(scene, effects=set(scene.effects) ^ {effect})


def train_alone(task):
    """Train one build: its file, and the Work of its last steps."""
    trainer = Trainer(*task)
    with np.errstate(all="ignore"):  # an overflow stops training with its own message
        while trainer.iteration < trainer.preset.iterations - COUNTED:
            trainer.step()
        with counted() as work:
            model = trainer.run()
    return encode(model), work


def train_all(scenes, preset, seed, progress=lambda line: None, jobs=1):
    """Train builds of one scene, in `jobs` processes.

    From {name: Scene} to {name: {model, data, ms, work}}; the work is that of COUNTED steps. ms is
    that of a step of stage 4, when every effect takes part; steps of all builds are timed in turn,
    in this process.
    """
    built, tasks = {}, [(scene, preset, seed) for scene in scenes.values()]
    for name, (data, work) in zip(scenes, in_processes(train_alone, tasks, jobs)):
        built[name] = {"model": decode(data), "data": data, "work": work}
        progress(f"{len(built)} of {len(scenes)} builds trained")
    progress("times of steps")
    with np.errstate(all="ignore"):
        steps = {name: step_at(scene, preset, 4) for name, scene in scenes.items()}
        times = alternate(steps, TURNS)
    return {name: {**build, "ms": times[name].median} for name, build in built.items()}


def ledger(scene, preset="tiny", seed=0, share=0.5, progress=lambda line: None, jobs=1, **changes):
    """What every effect costs and is worth, one row per effect in the order of the closed list.

    `changes` are fields of the preset; `share` is that of its iterations, 1 for all. A row has the
    fields effect, called_for, evidence, ms_on, ms_off, bytes_on, bytes_off, work_on, work_off,
    sorted_on, sorted_off, psnr_lost_when_off and psnr_gained_when_forced: ms of a whole step in the
    two builds that differ in this effect, bytes of its weights in the file, per step the
    multiply-adds of its equations and the Gaussians that it sorts by depth, and PSNR in dB on the
    test views, of which one is None. Raises ValueError for a scene without test views and for an
    unknown preset or field.
    """
    if not scene.test:
        raise ValueError(
            f"scene {scene.name}: split 'test': no views; expected at least one to measure on"
        )
    preset = shortened(choose(preset, changes), share)
    builds = {AS_LISTED: scene, **{effect: switched(scene, effect) for effect in MODEL_EFFECTS}}
    built = train_all(builds, preset, seed, progress, jobs)
    psnr = {name: evaluate(build["model"], scene)[0]["psnr_db"] for name, build in built.items()}
    rows = []
    for effect in MODEL_EFFECTS:
        called = effect in scene.effects
        names = (AS_LISTED, effect) if called else (effect, AS_LISTED)
        worth = psnr[names[0]] - psnr[names[1]]
        costs = [costs_of(built[name], effect) for name in names]
        rows.append(
            {
                "effect": effect,
                "called_for": called,
                "evidence": f"{worth:+.2f} dB with it, mean of {len(scene.test)} test views",
                **{f"{k}_{s}": c[k] for k in costs[0] for s, c in zip(("on", "off"), costs)},
                "psnr_lost_when_off": worth if called else None,
                "psnr_gained_when_forced": None if called else worth,
            }
        )
    return rows


def costs_of(build, effect):
    """Time of a step, bytes, and work per step of an effect in a build."""
    return {
        "ms": build["ms"],
        "bytes": round(effect_bytes(build["data"])[effect]),
        "work": round(build["work"].of(effect) / COUNTED),
        "sorted": round(build["work"].sorted[effect] / COUNTED),
    }


def describe(rows):
    """The ledger as text: a line of numbers per effect, then the evidence for each."""
    lines = table(COLUMNS, [{**r, "listed": "yes" if r["called_for"] else "no"} for r in rows])
    units = "ms, multiply-adds, Gaussians sorted by depth per step; PSNR in dB on the test views"
    evidence = [f"{row['effect']}: {row['evidence']}" for row in rows]
    return "\n".join([*lines, "", units, "", *evidence])


def draw_ledger(path, rows):
    """Three bar charts, blue for listed effects and orange for the others; a CSV beside."""
    plt, path = pyplot(), Path(path)
    worth = [
        row["psnr_lost_when_off"] if row["called_for"] else row["psnr_gained_when_forced"]
        for row in rows
    ]
    panels = (
        ("million multiply-adds per step", [row["work_on"] / 1e6 for row in rows], "{:.2f}"),
        ("bytes in the file", [row["bytes_on"] for row in rows], "{:,.0f}"),
        ("PSNR with it minus without it (dB)", worth, "{:+.2f}"),
    )
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.6), sharey=True, layout="constrained")
    colors = [BLUE if row["called_for"] else ORANGE for row in rows]
    for ax, (label, values, form) in zip(axes, panels):
        bars = ax.barh([row["effect"] for row in rows], values, color=colors)
        ax.bar_label(bars, [form.format(value) for value in values], padding=3)
        ax.margins(x=0.3)  # room for the numbers
        ax.set(xlabel=label)
        ax.axvline(0, color="black", linewidth=0.8)
        ax.locator_params(axis="x", nbins=4)
    axes[0].invert_yaxis()
    figure.legend(
        [plt.Rectangle((0, 0), 1, 1, color=color) for color in (BLUE, ORANGE)],
        ["listed by the scene", "forced on: not listed by the scene"],
        loc="outside upper center",
        ncols=2,
        frameon=False,
    )
    save_figure(figure, path)
    write_csv(path.with_suffix(".csv"), rows)
