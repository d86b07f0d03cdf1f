"""Study 4, quantisation: the scale of Q_0, adaptive and fixed steps, against PSNR and bytes."""

from dataclasses import replace

import numpy as np

from ...scenes import load_scene
from .diagram import Axes, Finding, at, figure, finish, legend, lines, table
from .fits import judge, reduced, train

STEPS = ("Q_f", "Q_s", "Q_l", "Q_O")


def without_adaptation(arrays):
    """Make psi_q's last layer zero in place, so that every step is Q_0 (Eq. 8 with psi_q = 0)."""
    for array in arrays:
        array[...] = 0


def fix_steps(trainer):
    """Before training: psi_q gives zero; with its learning rate at 0 it stays so."""
    weights, biases = trainer.networks["psi_q"]
    without_adaptation((weights[-1], biases[-1]))


def fixed(model):
    """A trained model with every step at Q_0."""
    weights, biases = model.networks["psi_q"]
    last = [np.zeros_like(weights[-1])], [np.zeros_like(biases[-1])]
    return replace(
        model, networks={**model.networks, "psi_q": (weights[:-1] + last[0], biases[:-1] + last[1])}
    )


def scaled(model, scale):
    """A trained model with Q_0 another one: networks, grid and attributes as they were trained."""
    return replace(
        model, design=model.design._replace(Q_0=tuple(scale * Q for Q in model.design.Q_0))
    )


def preset_at(scale, adaptive, iterations):
    base = reduced(iterations)
    changes = {name: scale * getattr(base, name) for name in STEPS}
    return base._replace(**changes, **({} if adaptive else {"lr_q": (0.0, 0.0)}))


def measure(iterations, trained_scales, scales, progress):
    """Rows of models trained at each scale, and of those trained at 1 that were only rounded to other steps."""
    scene, rows = load_scene("bouncing"), []
    for adaptive in (True, False):
        kind = "adaptive" if adaptive else "fixed"
        for scale in trained_scales:
            progress(f"quantisation: {kind} steps, trained at {scale:g} Q_0")
            fit = train(
                scene,
                preset_at(scale, adaptive, iterations),
                prepare=None if adaptive else fix_steps,
            )
            rows.append(row_of(f"{kind}, trained with it", scale, fit, judge(fit.model, scene)))
            if scale == 1:
                rows += [
                    row_of(
                        f"{kind}, rounded to it later",
                        other,
                        fit,
                        judge(scaled(fit.model, other), scene),
                    )
                    for other in scales
                ]
                if adaptive:
                    rows += [
                        row_of(
                            "trained adaptive, made fixed",
                            other,
                            fit,
                            judge(fixed(scaled(fit.model, other)), scene),
                        )
                        for other in scales
                    ]
    return rows


def row_of(method, scale, fit, judged):
    return {"method": method, "knob": scale, **judged, "train_seconds": fit.seconds, **fit.work}


def run(folder, quick, progress):
    iterations = 120 if quick else 950
    trained = (1.0, 4.0) if quick else (0.25, 0.5, 1.0, 2.0, 4.0)
    rows = measure(iterations, trained, (0.25, 0.5, 1.0, 2.0, 4.0, 8.0), progress)
    files = [table(folder, "quantisation", rows)]
    shown = [
        {**row, "knob": f"{row['knob']:g}", "coded": row["attribute_bytes"] + row["grid_bytes"]}
        for row in rows
    ]
    fig, (ax,) = figure()
    lines(
        ax,
        shown,
        Axes(
            "coded",
            "psnr_db",
            "coded attributes and hash grid (bytes)",
            "PSNR of the test views (dB)",
            "log",
            "linear",
        ),
    )
    legend(ax)
    finish(
        fig,
        folder / "quantisation.png",
        f"steps in multiples of `tiny`'s Q_0 (labelled), `bouncing`, {iterations} "
        f"iterations\nreference: the test views; the networks' {rows[0]['network_bytes']:,} bytes are the same in all",
    )
    reading = read(rows, iterations)
    return Finding(
        "quantisation",
        "Quantisation",
        "the test views of `bouncing`, from the decoded file",
        [("quantisation.png", "PSNR against the bytes that steps change, steps labelled.")],
        files,
        reading,
        f"one training of {iterations} iterations a point of `trained with it`; the others round such a model again",
    )


def read(rows, iterations):
    """What the numbers say."""
    own, fixed_, later, drop = (
        sorted((row for row in rows if row["method"] == method), key=lambda row: row["knob"])
        for method in (
            "adaptive, trained with it",
            "fixed, trained with it",
            "adaptive, rounded to it later",
            "trained adaptive, made fixed",
        )
    )
    one, flat, coarse = at(own, knob=1), at(fixed_, knob=1), own[-1]
    rounded, forced = at(later, knob=coarse["knob"]), at(drop, knob=1)
    return (
        f"Trained for {iterations} iterations at Q_0, adaptive steps end at {one['psnr_db']:.2f} dB and "
        f"{one['bytes']:,} bytes, fixed ones at {flat['psnr_db']:.2f} dB and {flat['bytes']:,} bytes. From "
        f"{own[0]['knob']:g} to {coarse['knob']:g} Q_0 the adaptive files go from {own[0]['bytes']:,} to "
        f"{coarse['bytes']:,} bytes and PSNR changes by {coarse['psnr_db'] - own[0]['psnr_db']:+.2f} dB. A model "
        f"trained at 1 and only rounded to {coarse['knob']:g} Q_0 has {rounded['psnr_db']:.2f} dB where one trained "
        f"at {coarse['knob']:g} has {coarse['psnr_db']:.2f} dB ({coarse['psnr_db'] - rounded['psnr_db']:+.2f} dB for "
        "training with the final noise). Taking the adaptation away from the trained model moves it by "
        f"{forced['psnr_db'] - one['psnr_db']:+.2f} dB and {forced['bytes'] - one['bytes']:+,} bytes."
    )
