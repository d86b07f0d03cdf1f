"""The paper's Table 3 on a tiny scene, and what is lost when one part is left out.

Every step is trained, written to a file, read back and measured. The steps from D3DGS to ours:

    D3DGS                         explicit Gaussians, the authors' deformation network; float32
    + spatial prediction          anchors and their networks instead of Gaussians; float32
    + compact deformation MLP     our deformation network, in float16
    + quantisation and entropy coding        the whole method and its file

Up to the third step there is no noise, rate or masking in training, and no context.
"""

from dataclasses import replace

from ...effects import MOTION
from ...report.figures import write_csv
from ...training.presets import TINY
from .. import baselines
from ..writer import means, seeds_of, table
from . import methods
from .methods import OURS

WHOLE, STILL = "+ quantisation and entropy coding", "no deformation"
# Rate in MB, savings in percent and PSNR in dB of the paper's Table 3, on T-Rex.
PAPER = {
    "D3DGS": "56.7 - 38.04",
    "+ spatial prediction": "7.27 -87.1 38.36",
    "+ compact deformation MLP": "5.39 -25.8 38.34",
    WHOLE: "0.85 -84.1 38.24",
}
ALWAYS = TINY.iterations  # later than every iteration
UNRATED = {  # stage 3 goes on to the end, and the noise is too small to change anything
    "stage_ends": (*TINY.stage_ends[:2], ALWAYS, ALWAYS),
    "mask_from": ALWAYS,
    **dict.fromkeys(("Q_f", "Q_s", "Q_l", "Q_O"), 2.0**-40),
}
AUTHORS = baselines.choose("d3dgs")
THEIR_NETWORK = ("deformation", "time_net", "skip", "L_x", "L_t")  # fields of the Design
# What each step and each part left out changes of a Task of our whole method.
STEPS = {
    "D3DGS": {"method": "d3dgs"},
    "+ spatial prediction": {
        "changes": {**UNRATED, "lr_d": AUTHORS.lr_d},
        "design": {name: getattr(AUTHORS, name) for name in THEIR_NETWORK},
        "plain": (),
    },
    "+ compact deformation MLP": {"changes": UNRATED, "plain": ("psi_d", "psi_t")},
    WHOLE: {},
    "fixed step": {  # tanh(0) = 0, so every step is its base step
        "changes": {"lr_q": (0.0, 0.0)},
        "zeros": tuple(f"psi_q.{kind}{len(TINY.context)}" for kind in "Wb"),
    },
    "global prior": {"changes": {"grid_3d": (1,), "grid_2d": ()}},  # one node: the same everywhere
    "no masking": {"changes": {"mask_from": ALWAYS}},
    STILL: {},
}
LEFT_OUT = tuple(STEPS)[len(PAPER) :]
COLUMNS = {
    "step": "{label}",
    "bytes": "{bytes:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "change %": "{saved_percent:+.1f}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "dB": "{psnr_gain:+.2f}",
    "the paper's MB, %, dB (T-Rex)": "{paper}",
}


def plan(scene, folder, seeds=3, iterations=None):
    """The Tasks of all steps and seeds."""
    still = replace(scene, effects=[name for name in scene.effects if name not in MOTION])
    whole = methods.plan({OURS: [{}]}, [OURS], [scene], folder, seeds, iterations)
    return [
        task._replace(step=step, scene=still if step == STILL else scene)._replace(**changes)
        for step, changes in STEPS.items()
        for task in whole
    ]


def collect(tasks, folder):
    """Write ablate.csv into a folder; returns the rows of all steps and parts left out."""
    rows = methods.made(tasks)
    write_csv(folder / "ablate.csv", rows)
    return {"scene": tasks[0].scene.name, "rows": rows, "steps": summaries(rows)}


def summaries(rows):
    """Means over the seeds, each step of Table 3 beside the step before, the others beside ours."""
    steps, before = means(rows, "label"), None
    for step in steps:
        if before:
            step["saved_percent"] = 100 * (step["bytes"] / before["bytes"] - 1)
            step["psnr_gain"] = step["psnr_db"] - before["psnr_db"]
        before = before if step["label"] in LEFT_OUT else step
    return steps


def describe(result):
    """Table 3 in form with the paper's numbers beside it, then the parts left out."""
    rows = [
        {
            **step,
            "label": f"ours, {name}" if name in LEFT_OUT else name,
            "paper": PAPER.get(name, "-"),
        }
        for step in result["steps"]
        for name in (step["label"],)
    ]
    return "\n".join(
        [
            f"{result['scene']}: {seeds_of(result['rows'])}. Changes are against the step before; "
            "those of parts left out are against the whole method.",
            *table(COLUMNS, rows),
            "fixed step: psi_q is all zeros, but its bytes stay in the file; global prior: one "
            "grid node, so that all anchors have the same prior and step.",
        ]
    )
