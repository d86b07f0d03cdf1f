"""The paper's Table 3 on a tiny scene, and what is lost when one part is left out.

Every step is trained, written to a file, read back and measured. The steps from D3DGS to ours:

    D3DGS                         explicit Gaussians, the authors' deformation network; float32
    + spatial prediction          anchors and their networks instead of Gaussians; float32
    + compact deformation MLP     our deformation network, in float16
    + quantisation and entropy coding        the whole method and its file

Up to the third step there is no noise, rate or masking in training, and no context.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...codec.file import decode, encode
from ...effects import MOTION
from ...report.evaluate import evaluate
from ...report.figures import write_csv
from ...report.inspect import components
from ...report.jobs import in_processes
from ...training.initial import design_of
from ...training.trainer import Trainer
from .. import baselines
from . import methods, plain_file
from .methods import OURS, Task, spread

TINIEST_STEP = 2.0**-40  # noise of this size changes nothing
OF_THE_AUTHORS = ("deformation", "time_net", "skip", "L_x", "L_t")
# Rate in MB, savings in percent and PSNR in dB of the paper's Table 3, on T-Rex.
PAPER = {
    "D3DGS": (56.7, None, 38.04),
    "+ spatial prediction": (7.27, -87.1, 38.36),
    "+ compact deformation MLP": (5.39, -25.8, 38.34),
    "+ quantisation and entropy coding": (0.85, -84.1, 38.24),
}
LEFT_OUT = ("fixed step", "global prior", "no masking", "no deformation")


class Step(NamedTuple):
    """One training of the ablation."""

    name: str
    task: Task


def preset_of(step):
    """The preset of a step with anchors."""
    preset = methods.preset_of(step.task)
    ends = preset.stage_ends
    if step.name in LEFT_OUT:
        return preset._replace(
            **{
                "fixed step": {"lr_q": (0.0, 0.0)},
                "global prior": {"grid_3d": (1,), "grid_2d": ()},  # one node: the same everywhere
                "no masking": {"mask_from": ends[3]},
                "no deformation": {},
            }[step.name]
        )
    if step.name == "+ quantisation and entropy coding":
        return preset
    unrated = preset._replace(
        stage_ends=(*ends[:2], ends[3], ends[3]),
        mask_from=ends[3],
        Q_f=TINIEST_STEP,
        Q_s=TINIEST_STEP,
        Q_l=TINIEST_STEP,
        Q_O=TINIEST_STEP,
    )
    if step.name == "+ compact deformation MLP":
        return unrated
    return unrated._replace(lr_d=baselines.choose("d3dgs").lr_d)


def design_of_the_authors(preset, effects):
    """The design of a preset with the deformation network of D3DGS."""
    theirs = baselines.choose("d3dgs")
    changes = {name: getattr(theirs, name) for name in OF_THE_AUTHORS}
    return design_of(preset, effects)._replace(**changes)


def fit(step):
    """The trained model of a step with anchors."""
    scene = step.task.scene
    if step.name == "no deformation":
        scene = replace(scene, effects=[name for name in scene.effects if name not in MOTION])
    preset, design = preset_of(step), None
    if step.name == "+ spatial prediction":
        design = design_of_the_authors(preset, scene.effects)
    trainer = Trainer(scene, preset, step.task.seed, design=design)
    if step.name == "fixed step":  # tanh(0) = 0, so every step is its base step
        last = len(trainer.design.context)
        for kind in "Wb":
            trainer.parameters[f"psi_q.{kind}{last}"][...] = 0
    with np.errstate(all="ignore"):
        return trainer.run()


def make(step):
    """Train a step, write its file, read it back and measure it."""
    name, task = step
    path = Path(task.folder) / f"{name.replace(' ', '_').replace('+_', '')}_seed{task.seed}"
    if name == "D3DGS":
        path = path.with_suffix(".ply")
        sizes = methods.fit(task).save(path)
        model = baselines.load(path)
    elif name in ("+ spatial prediction", "+ compact deformation MLP"):
        half = ("psi_d", "psi_t") if "compact" in name else ()
        sizes = plain_file.save(fit(step), path, half)
        model = plain_file.load(path)
    else:
        path = path.with_suffix(".p4dgs")
        path.write_bytes(encode(fit(step)))
        sizes, model = methods.kinds(components(path.read_bytes())), decode(path.read_bytes())
    metrics, _, _ = evaluate(model, task.scene)
    return {
        "step": name,
        "seed": task.seed,
        "file": path.name,
        "bytes": sum(sizes.values()),
        **{f"{kind}_bytes": size for kind, size in sizes.items()},
        "psnr_db": metrics["psnr_db"],
        "ssim": metrics["ssim"],
    }


def ablate(scene, folder, seeds=3, iterations=None, progress=lambda line: None, jobs=1):
    """Make all steps and parts left out; files and ablate.csv go into a folder. Returns their rows.

    Raises StudyError for a scene without test views.
    """
    methods.require_test_views(scene)
    steps = []
    for name in (*PAPER, *LEFT_OUT):
        method = "d3dgs" if name == "D3DGS" else OURS
        length = methods.preset_of(Task(scene, OURS, 0, folder, iterations)).iterations
        tasks = [Task(scene, method, seed, folder, length) for seed in range(seeds)]
        steps += [Step(name, task) for task in tasks]
    rows = []
    for row in in_processes(make, steps, jobs):
        rows.append(row)
        progress(f"{len(rows)} of {len(steps)} trainings")
    write_csv(folder / "ablate.csv", rows)
    return {"scene": scene.name, "rows": rows, "steps": summaries(rows)}


def summaries(rows):
    """Means over the seeds, each step of Table 3 beside the step before, the others beside ours."""
    found, before = [], None
    for name in dict.fromkeys(row["step"] for row in rows):
        own = [row for row in rows if row["step"] == name]
        kinds = [key for key in own[0] if key.endswith("bytes")]
        psnr, half = spread([row["psnr_db"] for row in own])
        means = {key: float(np.mean([row[key] for row in own])) for key in (*kinds, "ssim")}
        step = {"step": name, **means, "psnr_db": psnr, "psnr_db_spread": half}
        step["saved_percent"] = before and 100 * (step["bytes"] / before["bytes"] - 1)
        step["psnr_gain"] = before and psnr - before["psnr_db"]
        found.append(step)
        before = before if name in LEFT_OUT else step
    return found


def describe(result):
    """Table 3 in form with the paper's numbers beside it, then the parts left out."""
    heading = "step|bytes|network|Gaussians|change %|PSNR dB|dB|the paper's MB, %, dB (T-Rex)"
    table = [heading.split("|")]
    for step in result["steps"]:
        name = step["step"]
        sizes = [f"{step[k]:,.0f}" for k in ("bytes", "network_bytes", "gaussians_bytes")]
        first = step["saved_percent"] is None
        changes = (
            ["-", "-"]
            if first
            else [
                f"{step['saved_percent']:+.1f}",
                f"{step['psnr_gain']:+.2f}",
            ]
        )
        quality = f"{step['psnr_db']:.2f} ±{step['psnr_db_spread']:.2f}"
        paper = "{} {} {}".format(*("-" if n is None else n for n in PAPER.get(name, (None,) * 3)))
        label = f"ours, {name}" if name in LEFT_OUT else name
        table.append([label, *sizes, changes[0], quality, changes[1], paper])
    seeds = len({row["seed"] for row in result["rows"]})
    return "\n".join(
        [
            f"{result['scene']}: {seeds} seed{'s' * (seeds > 1)}, ± half their range. Changes are "
            "against the step before; those of parts left out are against the whole method.",
            *methods.aligned(table),
            "fixed step: psi_q is all zeros, but its bytes stay in the file; global prior: one "
            "grid node, so that all anchors have the same prior and step.",
        ]
    )
