"""The ledger of effects: what each effect of the closed list costs a scene, and what it is worth to it.

One build has the scene's own list; for every effect there is a twin in which that effect alone is switched.  All
builds train side by side, a step of each in turn, so that whatever disturbs the machine disturbs all alike.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..codec.file import decode, encode
from ..scenes.scene import MODEL_EFFECTS
from ..training.presets import choose
from ..training.trainer import Trainer
from .effect_work import counted, effect_bytes
from .evaluate import evaluate
from .report import BLUE, pyplot, save_figure, write_csv
from .suggest import suggest

SCHEDULE = (
    "decay_from",
    "grow_from",
    "grow_until",
    "collect_from",
    "mask_from",
)  # iterations, as stage_ends
COUNTED = 4  # last steps, whose work is counted; counting takes time, so they are not timed
ORANGE = "#E69F00"  # Okabe and Ito, as in report.py


def shortened(preset, share):
    """The preset with a share of its iterations, every stage and every date shortened alike."""
    ends = tuple(max(round(share * end), i + 1) for i, end in enumerate(preset.stage_ends))
    return preset._replace(
        stage_ends=ends, **{name: round(share * getattr(preset, name)) for name in SCHEDULE}
    )


def switched(scene, effect):
    """The scene with one effect more, or less, on its list; pictures and background colour stay."""
    return replace(scene, effects=set(scene.effects) ^ {effect})


def train_together(scenes, preset, seed, progress=None):
    """Train builds of one scene side by side: {name: {model, data, ms, work, gaussians, trainer}}.

    Takes      scenes {name: Scene}; ms is the median of the timed steps from stage 3 on, when every effect takes part
    """
    trainers = {name: Trainer(scene, preset, seed) for name, scene in scenes.items()}
    ms, work, visible = ({name: [] for name in scenes} for _ in range(3))
    with np.errstate(all="ignore"):  # an overflow stops training with its own message
        for i in range(preset.iterations):
            for name, trainer in trainers.items():
                if i >= preset.iterations - COUNTED:
                    with counted() as found:
                        _, seen, _ = trainer.step()
                    work[name].append(found)
                    visible[name].append(len(seen.index))
                    continue
                stage, start = trainer.stage, time.perf_counter()
                trainer.step()
                if stage >= 3:
                    ms[name].append(1e3 * (time.perf_counter() - start))
            if progress and (i + 1) % max(preset.iterations // 20, 1) == 0:
                progress(f"{i + 1} of {preset.iterations} steps of {len(scenes)} builds")
    built = {}
    for name, trainer in trainers.items():
        data = encode(trainer.model())
        built[name] = {
            "model": decode(data),
            "data": data,
            "ms": float(np.median(ms[name])),
            "work": work[name],
            "gaussians": float(np.mean(visible[name])),
            "trainer": trainer,
        }
    return built


def ledger(scene, preset="tiny", seed=0, share=0.5, progress=None, **changes):
    """What every effect costs and is worth: one row an effect, in the order of the closed list.

    Takes      a Scene; a preset and fields of it to change; `share` of its iterations, 1 for all; `progress(text)`
    Returns    [{effect, called_for, evidence, ms_on, ms_off, bytes_on, bytes_off, work_on, work_off,
               psnr_lost_when_off, psnr_gained_when_forced}]: ms of a whole step in the two builds that differ in this
               effect; bytes of its weights in the file; multiply-adds of its equations per step; PSNR in dB on the
               test views, one of the two and None for the other
    Raises     ValueError for a scene without test views, an unknown preset or field
    """
    if not scene.test:
        raise ValueError(
            f"scene {scene.name}: split 'test': no views; expected at least one to measure on"
        )
    preset = shortened(choose(preset, changes), share)
    if progress:
        progress("looking at the pictures")
    evidence = {row["effect"]: row["evidence"] for row in suggest(scene)}
    built = train_together(
        {"as listed": scene, **{effect: switched(scene, effect) for effect in MODEL_EFFECTS}},
        preset,
        seed,
        progress,
    )
    psnr = {name: evaluate(build["model"], scene)[0]["psnr_db"] for name, build in built.items()}
    rows = []
    for effect in MODEL_EFFECTS:
        called = effect in scene.effects
        on, off = (
            built[name] for name in (("as listed", effect) if called else (effect, "as listed"))
        )
        rows.append(
            {
                "effect": effect,
                "called_for": called,
                "evidence": evidence[effect],
                **{
                    f"{what}_{state}": of(build, effect)
                    for what, of in MEASURES.items()
                    for state, build in (("on", on), ("off", off))
                },
                "psnr_lost_when_off": psnr["as listed"] - psnr[effect] if called else None,
                "psnr_gained_when_forced": None if called else psnr[effect] - psnr["as listed"],
            }
        )
    return rows


MEASURES = {
    "ms": lambda build, effect: build["ms"],
    "bytes": lambda build, effect: round(effect_bytes(build["data"])[effect]),
    "work": lambda build, effect: round(np.mean([work.of(effect) for work in build["work"]])),
}


def signed(value):
    """Decibels with a sign, or a dash where there is nothing to say."""
    return "-" if value is None else f"{value:+.2f}"


def describe(rows):
    """The ledger as text: a line of numbers an effect, then the evidence for each."""
    head = (
        "effect",
        "listed",
        "ms on",
        "ms off",
        "bytes on",
        "off",
        "work on",
        "off",
        "lost off",
        "gained on",
    )
    table = [head] + [
        (
            row["effect"],
            "yes" if row["called_for"] else "no",
            f"{row['ms_on']:.2f}",
            f"{row['ms_off']:.2f}",
            f"{row['bytes_on']:,}",
            f"{row['bytes_off']:,}",
            f"{row['work_on']:,}",
            f"{row['work_off']:,}",
            signed(row["psnr_lost_when_off"]),
            signed(row["psnr_gained_when_forced"]),
        )
        for row in rows
    ]
    widths = [max(map(len, column)) for column in zip(*table)]
    lines = [
        "  ".join(
            f"{cell:<{w}}" if i < 2 else f"{cell:>{w}}"
            for i, (cell, w) in enumerate(zip(line, widths))
        )
        for line in table
    ]
    return "\n".join(
        [
            *lines,
            "",
            "ms of a whole step; work in multiply-adds a step; PSNR in dB on the test views",
            "",
            *(f"{row['effect']}: {row['evidence']}" for row in rows),
        ]
    )


def draw_ledger(path, rows):
    """Three bar charts, blue what the scene lists, orange what it does not; the numbers as CSV beside."""
    plt, path = pyplot(), Path(path)
    worth = [
        row["psnr_lost_when_off"] if row["called_for"] else row["psnr_gained_when_forced"]
        for row in rows
    ]
    panels = (
        ("million multiply-adds a step", [row["work_on"] / 1e6 for row in rows], "{:.2f}"),
        ("bytes in the file", [row["bytes_on"] for row in rows], "{:,.0f}"),
        ("PSNR with it, less without (dB)", worth, "{:+.2f}"),
    )
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.6), sharey=True, layout="constrained")
    colors = [BLUE if row["called_for"] else ORANGE for row in rows]
    for ax, (label, values, form) in zip(axes, panels):
        bars = ax.barh([row["effect"] for row in rows], values, color=colors)
        ax.bar_label(bars, [form.format(value) for value in values], padding=3)
        low, high = min(0, *values), max(0, *values)
        ax.set(
            xlabel=label,
            xlim=(low - 0.3 * (high - low) * (low < 0), high + 0.3 * (high - low) + 1e-9),
        )
        ax.axvline(0, color="black", linewidth=0.8)
        ax.locator_params(axis="x", nbins=4)
    axes[0].invert_yaxis()
    figure.legend(
        [plt.Rectangle((0, 0), 1, 1, color=color) for color in (BLUE, ORANGE)],
        ["the scene calls for it", "forced on: the scene does not list it"],
        loc="outside upper center",
        ncols=2,
        frameon=False,
    )
    save_figure(figure, path)
    write_csv(path.with_suffix(".csv"), rows)
