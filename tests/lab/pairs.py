"""One scene twice, with its own effects and with all of them: time, bytes, work and PSNR."""

from dataclasses import replace

import numpy as np

from p4dgs_ref.lab.effects.ledger import COUNTED, shortened, train_all
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.training.presets import PRESETS

LISTED, ALL = "as listed", "all effects"


def static_pair(seeds, preset="tiny", share=1):
    """Train `static` as listed and with everything on, seed by seed; one row per seed and build.

    The work is that of all effects, in multiply-adds per step.
    """
    scene, preset, rows = load_scene("static"), shortened(PRESETS[preset], share), []
    builds = {LISTED: scene, ALL: replace(scene, effects=MODEL_EFFECTS)}
    for seed in seeds:
        for name, build in train_all(builds, preset, seed).items():
            work = sum(map(build["work"].of, MODEL_EFFECTS))
            rows.append(
                {
                    "seed": seed,
                    "build": name,
                    "ms_per_step": build["ms"],
                    "bytes": len(build["data"]),
                    "work": work / COUNTED,
                    "psnr_db": evaluate(build["model"], scene)[0]["psnr_db"],
                }
            )
    return rows


def compare(rows):
    """Listed against all effects: {speedup, bytes_saved, work_ratio, psnr_lost, seed_spread}.

    Ratios are medians over the seeds. psnr_lost is the mean of the differences of each pair.
    seed_spread is the larger of the two builds' ranges over the seeds: another seed could have made
    a loss of this size.
    """
    listed, every = ([row for row in rows if row["build"] == name] for name in (LISTED, ALL))
    pairs = list(zip(listed, every))

    def ratio(key):
        return float(np.median([full[key] / few[key] for few, full in pairs]))

    ranges = [np.ptp([row["psnr_db"] for row in build]) for build in (listed, every)]
    return {
        "speedup": ratio("ms_per_step"),
        "bytes_saved": 1 - float(np.median([few["bytes"] / full["bytes"] for few, full in pairs])),
        "work_ratio": ratio("work"),
        "psnr_lost": float(np.mean([full["psnr_db"] - few["psnr_db"] for few, full in pairs])),
        "seed_spread": float(max(ranges)),
    }
