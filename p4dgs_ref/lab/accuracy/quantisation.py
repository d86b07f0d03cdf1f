"""Study 4, quantisation: the scale of Q_0, adaptive and fixed steps, against PSNR and bytes."""

from dataclasses import replace
from itertools import product

import numpy as np

from ...report.jobs import in_processes
from ...scenes import load_scene
from .diagram import Axes, Finding, at, select, table, work_precision
from .fits import TEST_VIEWS, judge, reduced, train

STEPS = ("Q_f", "Q_s", "Q_l", "Q_O")


def fix_steps(trainer):
    """Before training: make the last layer of psi_q zero, so that every step is Q_0 (Eq. 8).

    With a learning rate of 0 it stays zero.
    """
    weights, biases = trainer.networks["psi_q"]
    weights[-1][...] = 0
    biases[-1][...] = 0


def fixed(model):
    """A trained model with every step at Q_0."""
    psi_q = tuple([*a[:-1], np.zeros_like(a[-1])] for a in model.networks["psi_q"])
    return replace(model, networks={**model.networks, "psi_q": psi_q})


def scaled(model, scale):
    """A trained model with another Q_0; everything else stays as it was trained."""
    Q_0 = tuple(scale * Q for Q in model.design.Q_0)
    return replace(model, design=model.design._replace(Q_0=Q_0))


def preset_at(scale, adaptive, iterations):
    base = reduced(iterations)
    changes = {name: scale * getattr(base, name) for name in STEPS}
    return base._replace(**changes, **({} if adaptive else {"lr_q": (0.0, 0.0)}))


def train_one(task):
    """Rows of a model trained at one scale; one trained at 1 is rounded to `later` scales too."""
    adaptive, scale, iterations, later = task
    scene, kind = load_scene("bouncing"), "adaptive" if adaptive else "fixed"
    preset = preset_at(scale, adaptive, iterations)
    fit = train(scene, preset, prepare=None if adaptive else fix_steps)
    models = {(f"{kind}, trained with it", scale): fit.model}
    for other in later if scale == 1 else ():
        models[f"{kind}, rounded to it later", other] = scaled(fit.model, other)
        if adaptive:
            models["trained adaptive, made fixed", other] = fixed(scaled(fit.model, other))
    return [
        {"method": method, "knob": knob, **judge(model, scene), **fit.work}
        for (method, knob), model in models.items()
    ]


def measure(iterations, trained_scales, scales, progress, jobs):
    """Rows of models trained at each scale, and of models trained at 1 and rounded otherwise."""
    tasks, rows = list(product((True, False), trained_scales, [iterations], [scales])), []
    for i, found in enumerate(in_processes(train_one, tasks, jobs), 1):
        progress(f"quantisation: {i} of {len(tasks)} trainings")
        rows += found
    return rows


def run(folder, quick, progress, jobs=1):
    iterations, trained = (120, (1.0, 4.0)) if quick else (950, (0.25, 0.5, 1.0, 2.0, 4.0))
    rows = measure(iterations, trained, (0.25, 0.5, 1.0, 2.0, 4.0, 8.0), progress, jobs)
    shown = [{**row, "knob": f"{row['knob']:g}", "coded": row["coded_bytes"]} for row in rows]
    work_precision(
        folder / "quantisation.png",
        shown,
        Axes(
            "coded",
            "psnr_db",
            "coded attributes and hash grid (bytes)",
            "PSNR of the test views (dB)",
            y_scale="linear",
        ),
        f"steps in multiples of `tiny`'s Q_0 (labelled), `bouncing`, {iterations} iterations\n"
        f"the networks' {rows[0]['network_bytes']:,} bytes are the same in all",
    )
    return Finding(
        "quantisation",
        "Quantisation",
        TEST_VIEWS,
        [("quantisation.png", "PSNR against the bytes that the steps change, steps labelled.")],
        [table(folder, "quantisation", rows)],
        read(rows, iterations),
        f"one training of {iterations} iterations per point of `trained with it`; the others round "
        "such a model again",
    )


def read(rows, iterations):
    """What the numbers say."""
    own = sorted(select(rows, method="adaptive, trained with it"), key=lambda row: row["knob"])
    one, coarse = at(own, knob=1), own[-1]
    flat = at(rows, method="fixed, trained with it", knob=1)
    rounded = at(rows, method="adaptive, rounded to it later", knob=coarse["knob"])
    forced = at(rows, method="trained adaptive, made fixed", knob=1)
    return (
        f"Trained for {iterations} iterations at Q_0, adaptive steps end at {one['psnr_db']:.2f} "
        f"dB and {one['bytes']:,} bytes, fixed ones at {flat['psnr_db']:.2f} dB and "
        f"{flat['bytes']:,} bytes. From {own[0]['knob']:g} to {coarse['knob']:g} Q_0 the files "
        f"with adaptive steps go from {own[0]['bytes']:,} to {coarse['bytes']:,} bytes, and PSNR "
        f"changes by {coarse['psnr_db'] - own[0]['psnr_db']:+.2f} dB. A model trained at 1 and "
        f"only rounded to {coarse['knob']:g} Q_0 has {rounded['psnr_db']:.2f} dB, a model trained "
        f"at {coarse['knob']:g} has {coarse['psnr_db']:.2f} dB: training with the final noise "
        f"changes it by {coarse['psnr_db'] - rounded['psnr_db']:+.2f} dB. Fixing the steps of the "
        f"trained adaptive model changes it by {forced['psnr_db'] - one['psnr_db']:+.2f} dB and "
        f"{forced['bytes'] - one['bytes']:+,} bytes. Each result is that of one seed; the study of "
        "training says how far seeds differ."
    )
