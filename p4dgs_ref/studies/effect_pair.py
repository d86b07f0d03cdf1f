"""One scene twice: with the effects that it lists, and with all effects forced on; time, bytes, work and PSNR."""

from dataclasses import replace

import numpy as np

from ..scenes import load_scene
from ..scenes.scene import MODEL_EFFECTS
from ..training.presets import choose
from .effect_ledger import shortened, train_together
from .evaluate import evaluate

LISTED, ALL = "as listed", "all effects"


def static_pair(seeds=(0, 1, 2), preset="tiny", share=1, scene=None, progress=None, **changes):
    """Train a scene (`static` unless one is given) as listed and with everything on, paired seed by seed.

    Returns    one row a seed and build: {seed, build, ms_per_step, bytes, work, gaussians, psnr_db}; work is that of
               all effects, in multiply-adds a step
    """
    scene = load_scene("static") if scene is None else scene
    preset, rows = shortened(choose(preset, changes), share), []
    for seed in seeds:
        built = train_together(
            {LISTED: scene, ALL: replace(scene, effects=MODEL_EFFECTS)},
            preset,
            seed,
            progress and (lambda text: progress(f"seed {seed}: {text}")),
        )
        for name, build in built.items():
            rows.append(
                {
                    "seed": seed,
                    "build": name,
                    "ms_per_step": build["ms"],
                    "bytes": len(build["data"]),
                    "work": float(
                        np.mean([sum(map(work.of, MODEL_EFFECTS)) for work in build["work"]])
                    ),
                    "gaussians": build["gaussians"],
                    "psnr_db": evaluate(build["model"], scene)[0]["psnr_db"],
                }
            )
    return rows


def compare_pair(rows):
    """Listed against all effects: {speedup, bytes_saved, work_ratio, psnr_lost, seed_spread}.

    Medians over the seeds; psnr_lost is the mean of the paired differences; seed_spread the larger of the two builds'
    ranges over the seeds: a loss within it is one that another seed would have made as well.
    """
    listed, every = ([row for row in rows if row["build"] == name] for name in (LISTED, ALL))

    def ratio(key, above=every, below=listed):
        return float(np.median([a[key] / b[key] for a, b in zip(above, below)]))

    return {
        "speedup": ratio("ms_per_step"),
        "bytes_saved": 1 - ratio("bytes", listed, every),
        "work_ratio": ratio("work"),
        "psnr_lost": float(np.mean([b["psnr_db"] - a["psnr_db"] for a, b in zip(listed, every)])),
        "seed_spread": float(
            max(np.ptp([row["psnr_db"] for row in build]) for build in (listed, every))
        ),
    }


def describe_pair(rows):
    """The pairs as text, and what they say together."""
    lines = ["seed  build        ms/step    bytes         work  Gaussians    PSNR"]
    lines += [
        f"{r['seed']:>4}  {r['build']:<11}  {r['ms_per_step']:7.2f}  {r['bytes']:7,}  "
        f"{r['work']:11,.0f}  {r['gaussians']:9.0f}  {r['psnr_db']:6.2f}"
        for r in rows
    ]
    c = compare_pair(rows)
    return "\n".join(
        [
            *lines,
            f"as listed: {c['speedup']:.2f} times as fast a step, {100 * c['bytes_saved']:.1f} % "
            f"fewer bytes, "
            f"PSNR {-c['psnr_lost']:+.2f} dB where seeds differ by {c['seed_spread']:.2f} dB",
        ]
    )
