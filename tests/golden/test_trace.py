"""The optimisation trace of level L4: computed independently, and how stable it is."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import correlate1d
from scipy.special import log_ndtr

from tests.golden import pipeline, stages, stages_coding


@pytest.fixture(scope="module")
def inputs():
    return next(pipeline.trace_cases()).inputs


@pytest.fixture(scope="module")
def trace(inputs):
    return traced(inputs)


def traced(inputs, **changes):
    """The outputs of the trace, with some inputs changed."""
    return SimpleNamespace(**pipeline.trace_vjp(**{**inputs, **changes})[0])


def flat(inputs):
    """The parameters as `final` has them, and the number of each array's elements."""
    arrays = [
        np.ravel(inputs[own][int(i)] if i else inputs[own])
        for own, _, i in (name.partition(".") for name in inputs["arrays"])
    ]
    return np.concatenate(arrays), [len(a) for a in arrays]


def unflat(inputs, final):
    """The inverse of `flat`: inputs {name: array or list} of parameters that `final` holds."""
    parts, changed = np.split(final, np.cumsum(flat(inputs)[1])[:-1]), {}
    for name, part in zip(inputs["arrays"], parts):
        own, _, i = name.partition(".")
        if i:
            changed.setdefault(own, []).append(part.reshape(inputs[own][int(i)].shape))
        else:
            changed[own] = part.reshape(inputs[own].shape)
    return changed


def first_step(inputs, **changes):
    return traced(inputs, views=inputs["views"][:1], u=inputs["u"][:1], **changes)


def textbook_ssim(a, b):
    """SSIM with the window, the padding and the constants of Q13, from the formula as printed."""
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window /= window.sum()

    def mean(x):
        return correlate1d(correlate1d(x, window, 0, mode="constant"), window, 1, mode="constant")

    m_a, m_b = mean(a), mean(b)
    v_a, v_b, c = mean(a * a) - m_a**2, mean(b * b) - m_b**2, mean(a * b) - m_a * m_b
    return np.mean(
        (2 * m_a * m_b + 1e-4) * (2 * c + 9e-4) / ((m_a**2 + m_b**2 + 1e-4) * (v_a + v_b + 9e-4))
    )


def test_first_losses_are_those_of_an_evaluation_by_stages(inputs, trace):
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
    L1, D_SSIM = np.abs(image - i.truth[v]).mean(), 1 - textbook_ssim(image, i.truth[v])
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
    found = [getattr(trace, name)[0] for name in pipeline.LOSSES]
    assert np.allclose(found, want, rtol=1e-11)


# From these no gradient is withheld: neither by Q10 nor by the sign of a grid.


def test_every_array_learns_in_every_step(inputs, trace):
    still = inputs["arrays"].index("x_a")
    assert (trace.gradient_norm > 1e-6).all() and trace.L_total[-1] < trace.L_total[0]
    assert (np.diff(trace.total[:, still]) == 0).all()
    assert (np.diff(np.delete(trace.total, still, axis=1), axis=0) != 0).all()
    assert len(trace.L1) == pipeline.STEPS and len(set(inputs["views"].tolist())) > 2
    assert np.ptp(inputs["truth"], axis=(1, 2)).min() > 0.2 and 0.5 < inputs["mask"].mean() < 1
    assert np.abs(inputs["u"]).max() <= 0.5


def test_checksums_are_those_of_the_final_parameters(inputs, trace):
    before, sizes = flat(inputs)
    assert len(before) == len(trace.final) and len(sizes) == len(inputs["learning_rates"])
    parts = np.split(trace.final, np.cumsum(sizes)[:-1])
    assert np.allclose(trace.total[-1], [a.sum() for a in parts], rtol=1e-12, atol=1e-12)
    ramps = [sum(x * np.cos(j) for j, x in enumerate(a)) for a in parts]
    assert np.allclose(trace.ramp[-1], ramps, rtol=1e-12, atol=1e-12)


def test_the_first_step_is_as_long_as_the_learning_rate(inputs):
    """Adam's first step is rate times the sign of the gradient, unless that is next to nothing."""
    before, sizes = flat(inputs)
    share = np.abs(first_step(inputs).final - before) / np.repeat(
        np.maximum(inputs["learning_rates"], 1e-9), sizes
    )
    assert share.max() < 1 + 1e-9 and np.mean(share > 0.999) > 0.7
    assert np.mean((share > 1e-9) & (share < 0.999)) < 0.01


def test_every_step_has_its_own_view_and_noise(inputs, trace):
    """A step's losses and norms are those of a first step from the parameters before it."""
    for n in (1, 4, 9):
        views, u = inputs["views"], inputs["u"]
        left = unflat(inputs, traced(inputs, views=views[:n], u=u[:n]).final)
        anew = traced(inputs, **left, views=views[n : n + 1], u=u[n : n + 1])
        for name in (*pipeline.LOSSES, "gradient_norm"):
            assert np.allclose(getattr(anew, name)[0], getattr(trace, name)[n], rtol=1e-13), name
