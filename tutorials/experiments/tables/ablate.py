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

The table compares files whose networks are all coded, so that a step does not look large because
the one before it has float32: what is not coded in training is quantised and coded after it
(`baselines.coded`), in the first three steps also Gaussians or anchors. All have the same LOSS.
"""

from dataclasses import replace

import numpy as np
from p4dgs_ref.writer import means, seeds_of, text_table, twice_standard_error

from p4dgs_ref.attributes import ATTRIBUTES
from p4dgs_ref.effects import MOTION
from p4dgs_ref.report.figures import write_csv
from p4dgs_ref.training.presets import TINY

from .. import baselines
from . import methods
from .methods import ALIKE, AS_STORED, CODED, OURS

# Of all files coded alike: of 2e-5, 5e-5, 1e-4 and 2e-4 the largest that costs at most 0.1 dB on
# held-back views in the mean of the first four steps: 0.10, 0.16, 0.01 and 0.07 dB on `bouncing`,
# seed 0 (the first two after 3,000 iterations). Twice as much costs 0.31, 0.17, 0.01 and 0.10 dB.
LOSS = 5e-5
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
    "step": "{step}",
    "as stored": "{stored_bytes:,.0f}",
    "coded": "{bytes:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "change %": "{said[saved_percent]}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "dB": "{said[psnr_gain]}",
    "the paper's MB (T-Rex)": "{paper[mb]:.2f}",
    "its %": "{paper[saved_percent]:+.1f}",
    "its PSNR": "{paper[psnr_db]:.2f}",
    "its dB": "{paper[psnr_gain]:+.2f}",
}


def plan(scene, folder, seeds=3, iterations=None, losses=(LOSS,)):
    """The Tasks of all steps and seeds, each as stored and coded alike.

    The networks of our own design are coded in training already.
    """
    still = [name for name in scene.effects if name not in MOTION]
    scenes = {WITHOUT_MOTION: replace(scene, effects=still)}
    whole = methods.plan({OURS: [{}]}, [OURS], [scene], folder, seeds, iterations, "ablate")
    return [
        task._replace(
            **{"step": step, "scene": scenes.get(step, scene), **changes},
            storage=ALIKE if loss else AS_STORED,
            loss=loss,
        )
        for step, changes in {**STEPS, **LEFT_OUT}.items()
        for task in whole
        for loss in (None, *(losses if changes.get("method") != CODED else ()))
    ]


def collect(tasks, folder):
    """Write ablate.csv into a folder; returns the rows of all steps and parts left out."""
    rows = methods.made(tasks)
    write_csv(folder / "ablate.csv", rows)
    held_back = {(row["label"], row["seed"]): row["held_back_db"] for row in rows}
    costs = [
        held_back[step_of(row), row["seed"]] - row["held_back_db"]
        for row in rows
        if row["storage"] == ALIKE
    ]
    return {
        "scene": tasks[0].scene.name,
        "rows": rows,
        "steps": summaries(rows),
        "cost_db": float(np.mean(costs)),
    }


def step_of(row):
    """The name of the step of a row, as stored or coded alike."""
    return row["label"].partition(" loss=")[0]


def summaries(rows):
    """Means over seeds, each step beside the one before it, parts left out beside PAPER_METHOD.

    Of a file that is also coded alike, the row coded alike counts. A change is the mean of those of
    each seed; it is `said` to be none where it is smaller than twice its standard error.
    """
    by_step, stored = {}, {}
    for row in rows:  # a row coded alike follows the same as stored
        step, seed = step_of(row), (row["scene"], row["seed"])
        by_step.setdefault(step, {})[seed] = row
        if row.get("storage", AS_STORED) == AS_STORED:
            stored.setdefault(step, []).append(row["bytes"])
    before = {**dict(zip([*STEPS][1:], STEPS)), **dict.fromkeys(LEFT_OUT, PAPER_METHOD)}
    steps = []
    for name, of_seed in by_step.items():
        (step,) = means(of_seed.values(), "label")
        others = by_step.get(before.get(name), {})
        pairs = [(row, others[seed]) for seed, row in of_seed.items() if seed in others]
        changes = {
            "saved_percent": [100 * (row["bytes"] / other["bytes"] - 1) for row, other in pairs],
            "psnr_gain": [row["psnr_db"] - other["psnr_db"] for row, other in pairs],
        }
        step |= {"step": name, "stored_bytes": float(np.mean(stored[name])), "said": {}}
        for quantity, each in changes.items() if pairs else ():
            step[quantity] = change = float(np.mean(each))
            is_some = abs(change) > twice_standard_error(each)
            step["said"][quantity] = f"{change:+.2f}" if is_some else f"none ({change:+.2f})"
        steps.append({**step, "paper": PAPER.get(name, {})})
    return steps


def disagreements(steps):
    """A sentence for each change of a step whose sign is not that of the paper."""
    return [
        f"{step['step']}: {step['said'][name]} {unit} here, {step['paper'][name]:+.2f} in the "
        f"paper (seeds: {step['seeds']}, ±{step['psnr_db_spread']:.2f} dB)."
        for step in steps
        for name, unit in UNITS.items()
        if step.get(name, 0) * step["paper"].get(name, 0) < 0
    ]


def to_text(result):
    """Table 3 in form with the paper's numbers beside it, then the parts left out."""
    rows = [
        {**step, "step": f"the paper's, {name}" if name in LEFT_OUT else name}
        for step in result["steps"]
        for name in (step["step"],)
    ]
    return "\n".join(
        [
            f"{result['scene']}: {seeds_of(result['rows'])}. Changes are against the step before; "
            "those of parts left out are against the paper's whole method.",
            "A change is called none where it is smaller than twice its standard error, of the "
            "differences of the same seeds; of one seed every change is.",
            "Bytes, dB and changes are those of files whose networks are coded: those that are not "
            f"coded in training with the loss {LOSS:g} after it, which costs "
            f"{result['cost_db']:.2f} dB on held-back views (mean of the steps and seeds).",
            *text_table(COLUMNS, rows),
            *disagreements(result["steps"]),
            "fixed step: psi_q is all zeros, but its bytes stay in the file; global prior: one "
            "grid node, so that all anchors have the same prior and step.",
        ]
    )
