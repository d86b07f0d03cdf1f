"""The paper's Table 3 on a tiny scene, what goes beyond it, and what is lost without one part.

Every step is trained, written to a file, read back and measured. The steps from D3DGS to ours:

    D3DGS                         explicit Gaussians, the authors' deformation network; float32
    + spatial prediction          anchors and their networks instead of Gaussians; float32
    + compact deformation MLP     our deformation network, in float16
    + quantisation and entropy coding        the paper's whole method and its file
    + coded networks and positions           B1 to B3, the preset `tiny_coded`
    + more anchors                what the saved bytes pay for

Up to the third step there is no noise, rate or masking in training, and no context. One part at a
time is left out of the paper's whole method.
"""

from dataclasses import replace

from ...attributes import ATTRIBUTES
from ...effects import MOTION
from ...report.figures import write_csv
from ...training.presets import TINY
from .. import baselines
from ..writer import means, seeds_of, text_table
from . import methods
from .methods import CODED, OURS

PAPER_METHOD, WITHOUT_MOTION = "+ quantisation and entropy coding", "no deformation"
# The paper's Table 3, on T-Rex: MB, PSNR, and what a step changes of them, in percent and dB.
PAPER = {
    "D3DGS": {"mb": 56.7, "psnr_db": 38.04},
    "+ spatial prediction": {
        "mb": 7.27,
        "psnr_db": 38.36,
        "saved_percent": -87.1,
        "psnr_gain": 0.32,
    },
    "+ compact deformation MLP": {
        "mb": 5.39,
        "psnr_db": 38.34,
        "saved_percent": -25.8,
        "psnr_gain": -0.02,
    },
    PAPER_METHOD: {"mb": 0.85, "psnr_db": 38.24, "saved_percent": -84.1, "psnr_gain": -0.10},
}
UNITS = {"saved_percent": "% of bytes", "psnr_gain": "dB"}  # of what a step changes
AFTER_LAST = TINY.iterations  # later than every iteration
WITHOUT_RATE = {  # stage 3 goes on to the end, and the noise is too small to change anything
    "stage_ends": (*TINY.stage_ends[:2], AFTER_LAST, AFTER_LAST),
    "mask_from": AFTER_LAST,
    **dict.fromkeys((row.base_step for row in ATTRIBUTES), 2.0**-40),
}
AUTHORS = baselines.choose("d3dgs")
THEIR_NETWORK = ("deformation", "time_net", "skip", "L_x", "L_t")  # fields of the Design
# What each step changes of a Task of the paper's whole method.
STEPS = {
    "D3DGS": {"method": "d3dgs"},
    "+ spatial prediction": {
        "changes": {**WITHOUT_RATE, "lr_d": AUTHORS.lr_d},
        "network": {name: getattr(AUTHORS, name) for name in THEIR_NETWORK},
        "plain": (),
    },
    "+ compact deformation MLP": {"changes": WITHOUT_RATE, "plain": ("psi_d",)},
    PAPER_METHOD: {},
    "+ coded networks and positions": {"method": CODED},
    "+ more anchors": {"method": CODED, "changes": {"anchors": 800, "lambda_rate": 0.001}},
}
# What each part that is left out changes of it.
LEFT_OUT = {
    "fixed step": {  # tanh(0) = 0, so every step is its base step
        "changes": {"lr_q": (0.0, 0.0)},
        "zeros": tuple(f"psi_q.{kind}{len(TINY.context)}" for kind in "Wb"),
    },
    "global prior": {"changes": {"grid_3d": (1,), "grid_2d": ()}},  # one node: the same everywhere
    "no masking": {"changes": {"mask_from": AFTER_LAST}},
    WITHOUT_MOTION: {},
}
COLUMNS = {
    "step": "{label}",
    "bytes": "{bytes:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "change %": "{saved_percent:+.1f}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "dB": "{psnr_gain:+.2f}",
    "the paper's MB (T-Rex)": "{paper[mb]:.2f}",
    "its %": "{paper[saved_percent]:+.1f}",
    "its PSNR": "{paper[psnr_db]:.2f}",
    "its dB": "{paper[psnr_gain]:+.2f}",
}


def plan(scene, folder, seeds=3, iterations=None):
    """The Tasks of all steps and seeds."""
    still = [name for name in scene.effects if name not in MOTION]
    scenes = {WITHOUT_MOTION: replace(scene, effects=still)}
    whole = methods.plan({OURS: [{}]}, [OURS], [scene], folder, seeds, iterations, "ablate")
    return [
        task._replace(**{"step": step, "scene": scenes.get(step, scene), **changes})
        for step, changes in {**STEPS, **LEFT_OUT}.items()
        for task in whole
    ]


def collect(tasks, folder):
    """Write ablate.csv into a folder; returns the rows of all steps and parts left out."""
    rows = methods.made(tasks)
    write_csv(folder / "ablate.csv", rows)
    return {"scene": tasks[0].scene.name, "rows": rows, "steps": summaries(rows)}


def summaries(rows):
    """Means over seeds, each step beside the one before it, parts left out beside PAPER_METHOD."""
    steps = {step["label"]: step for step in means(rows, "label")}
    before = {**dict(zip([*STEPS][1:], STEPS)), **dict.fromkeys(LEFT_OUT, PAPER_METHOD)}
    for name in before.keys() & steps.keys():
        step, other = steps[name], steps[before[name]]
        step["saved_percent"] = 100 * (step["bytes"] / other["bytes"] - 1)
        step["psnr_gain"] = step["psnr_db"] - other["psnr_db"]
    return [{**step, "paper": PAPER.get(name, {})} for name, step in steps.items()]


def disagreements(steps):
    """A sentence for each change of a step whose sign is not that of the paper."""
    return [
        f"{step['label']}: {step[name]:+.2f} {unit} here, {step['paper'][name]:+.2f} in the paper "
        f"(seeds: {step['seeds']}, ±{step['psnr_db_spread']:.2f} dB)."
        for step in steps
        for name, unit in UNITS.items()
        if step.get(name, 0) * step["paper"].get(name, 0) < 0
    ]


def to_text(result):
    """Table 3 in form with the paper's numbers beside it, then the parts left out."""
    rows = [
        {**step, "label": f"ours, {name}" if name in LEFT_OUT else name}
        for step in result["steps"]
        for name in (step["label"],)
    ]
    return "\n".join(
        [
            f"{result['scene']}: {seeds_of(result['rows'])}. Changes are against the step before; "
            "those of parts left out are against the paper's whole method.",
            *text_table(COLUMNS, rows),
            *disagreements(result["steps"]),
            "fixed step: psi_q is all zeros, but its bytes stay in the file; global prior: one "
            "grid node, so that all anchors have the same prior and step.",
        ]
    )
