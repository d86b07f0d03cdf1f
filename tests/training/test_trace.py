"""The optimisation trace of level L4: the losses of its first step, computed independently."""

from types import SimpleNamespace

import numpy as np
from scipy.special import log_ndtr

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.published import flatten
from tests.golden import pipeline, stages, stages_coding
from tests.golden.independent import filtered_ssim


def test_first_losses_are_those_of_an_evaluation_by_stages():
    inputs = next(pipeline.trace_cases()).inputs
    i, v, (A, k, _) = SimpleNamespace(**inputs), inputs["views"][0], inputs["O_a"].shape
    d = i.f_a.shape[1]
    nets = {name: a for name, a in inputs.items() if name.startswith("psi")}
    coding = {name: a for name, a in nets.items() if name[:5] in ("psi_q", "psi_p")}
    ctx = SimpleNamespace(
        **stages_coding.context_vjp(
            i.x_a, i.lo, i.hi, i.grids, i.resolutions, i.Q_0, d, k, **coding
        )[0]
    )
    f, s, l = (
        a + i.u[0][:, at] * ctx.q[:, [g]]
        for a, at, g in (
            (i.f_a, slice(0, d), 0),
            (np.exp(i.log_s), slice(d, d + 3), 1),
            (np.exp(i.log_l), slice(d + 3, d + 6), 2),
        )
    )
    O = i.O_a + i.u[0][:, d + 6 :].reshape(A, k, 3) * ctx.q[:, 3].reshape(A, 1, 1)
    x_c = -i.W[v].T @ i.T[v]
    g = stages.spatial_vjp(i.x_a, f, s, l, O, i.mask, x_c, i.tau_alpha, i.effects, **nets)[0]
    at_t = stages.temporal_vjp(
        g["x"], g["s"], g["r"], i.times[v], i.L_x, i.L_t, i.psi_d_weights, i.psi_d_biases
    )[0]
    camera = i.W[v], i.T[v], i.focal[v], i.center[v], i.size
    image = stages.compositing_vjp(
        *at_t.values(), g["alpha"], g["color"], *camera, i.background, True
    )[0]["image"]
    L1, D_SSIM = np.abs(image - i.truth[v]).mean(), 1 - filtered_ssim(image, i.truth[v])
    noisy, q = (
        np.concatenate([f, s, l, O.reshape(A, -1)], axis=1),
        np.repeat(ctx.q, (d, 3, 3, 3 * k), axis=1),
    )
    high, low = (log_ndtr(-(np.abs(noisy - ctx.mu) + sign * q / 2) / ctx.sigma) for sign in (-1, 1))
    bits = -(high + np.log1p(-np.exp(low - high))) / np.log(2)
    bits[:, d + 6 :] *= np.repeat(i.mask, 3, axis=1)
    signs = np.concatenate([grid.ravel() >= 0 for grid in i.grids])
    p = signs.mean()
    total = bits.sum() - signs.size * (p * np.log2(p) + (1 - p) * np.log2(1 - p))
    rate = total / (A * (d + 6 + 3 * k))
    want = (
        L1,
        D_SSIM,
        0.8 * L1 + 0.2 * D_SSIM,
        rate,
        total,
        i.lambda_rate * rate + 0.8 * L1 + 0.2 * D_SSIM,
    )
    tensors = published.cases("trace")[0].tensors
    losses = [tensors[f"out.{name}"][0] for name in pipeline.LOSSES]
    assert np.allclose(losses, want, rtol=1e-11)


def test_the_arrays_of_every_step_have_the_published_checksums():
    """Those of a network are one vector here, and W and b of each layer by themselves there."""
    steps, trace = (published.cases(key)[0].tensors for key in ("trace_steps", "trace"))
    inputs = flatten(published.cases("trace")[0].inputs())
    names = next(pipeline.trace_cases()).inputs["arrays"]
    for stem in pipeline.ARRAYS:
        parts_of = [n for n in names if pipeline.parameter_name(n).split(".")[0] == stem]
        parts_of.sort(key=lambda name: pipeline.parameter_name(name)[::-1])  # W0, b0, W1, b1
        ends, at = np.cumsum([inputs[n].size for n in parts_of]), [names.index(n) for n in parts_of]
        for step in range(pipeline.STEPS):
            parts = np.split(steps[f"out.{stem}.{step}"].ravel(), ends[:-1])
            sums = [[part.sum(), pipeline.ramp(part)] for part in parts]
            want = np.stack([trace["out.total"][step, at], trace["out.ramp"][step, at]], axis=1)
            assert np.allclose(sums, want, rtol=1e-11, atol=1e-11), f"{stem} after step {step + 1}"
