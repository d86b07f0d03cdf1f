"""The training objective of one view, forward and backward.

    attributes, noise -> Gaussians at time t -> image -> L_render    Eqs. (7), (1) to (6), (16)
    positions -> hash grid -> q, mu, sigma -> bits -> L_rate         Eqs. (8), (9), (11) to (14)
    L_total = lambda_rate * L_rate + L_render                        Eqs. (15), (17)

All equations of the paper meet here. `loss` calls them in the order of the paper's figures. It
returns the losses and `back`, which calls their backwards in the opposite order and adds gradients
where a quantity was used twice. `psnr` is not part of the objective; the line of progress and the
paper's tables use it for the quality of an image.
"""

from typing import NamedTuple

import numpy as np

from ..equations import (
    anchor_rate,
    hash_rate,
    likelihood,
    noise,
    rate_loss,
    render_loss,
    total_loss,
)
from ..model import (
    Anchors,
    concatenate_groups,
    context,
    groups,
    predict,
    split,
    with_backward,
)
from ..splatting import render
from ..splatting.settings import Settings


class StepInputs(NamedTuple):
    """The inputs of an iteration that are not parameters."""

    mask: np.ndarray  # [A, k]  children that are kept (Q15)
    located: object  # `hash_grid.locate` of the frozen positions; None before stage 4
    background: np.ndarray  # [3]
    stage: int  # 1 to 4: noise from stage 2 on, time from 3 on, context and rate in 4
    lambda_rate: float
    lambda_ssim: float
    settings: Settings  # of the renderer


class Losses(NamedTuple):
    """The losses of one view; rate and bits are 0 before stage 4."""

    L_total: float
    L_render: float
    L1: float
    D_SSIM: float
    L_rate: float  # bits per coded number
    bits: float


class Rendered(NamedTuple):
    """What density control and the progress line need of a rendered view."""

    alpha: np.ndarray  # [A, k]  opacities before masking
    index: np.ndarray  # [N]  a k + j of the rendered Gaussians
    visible: np.ndarray  # [N]  bool
    image: np.ndarray  # [H, W, 3]


def psnr(image, truth):
    """Return the PSNR in dB of an image clipped to [0, 1]; infinite if it equals the truth."""
    error = np.mean((np.clip(image, 0, 1).astype(float) - truth) ** 2)
    return float(-10 * np.log10(error)) if error else np.inf


def linear_values(p):
    """Return the coded attributes [A, n] as `model.join` does, with logarithms undone (Q5)."""
    s_a, l_a = np.exp(p["log_s"]), np.exp(p["log_l"])
    return concatenate_groups(p["f_a"], s_a, l_a, p["O_a"])


def loss(p, design, networks, grids, inputs, view, u):
    """Return the Losses of one view, its Rendered, and `back`.

    `networks` and `grids` are views into the Parameters p, `inputs` are StepInputs. u [A, n] is the
    noise in [-1/2, 1/2); rendering and rate share it (Q23), and stage 1 does not use it.
    back() returns the gradients of L_total as Parameters of the same layout, and those of the
    splats' mean2d [N, 2].
    """
    stage, values = inputs.stage, linear_values(p)  # [A, n]
    bits = L_rate = 0.0
    noisy, q = values, np.array([design.Q_0], values.dtype)
    if stage == 4:
        ctx, back_context = context(design, networks, grids, inputs.located)
        q = ctx.q
    if stage > 1:
        noisy, back_noise = add_noise(values, u, q, design)
    anchors = Anchors(p["x_a"], *split(noisy, design), inputs.mask)
    g, alpha, back_predict = predict(
        design,
        networks,
        anchors,
        view.camera.center.astype(values.dtype),
        view.time if stage > 2 else None,
    )  # g: the N kept children of all A anchors, [N, ...]
    (image, _, visible), back_render = with_backward(
        render,
        *g[:5],
        view.camera,
        inputs.background,
        inputs.settings,
        "occlusion" in design.effects,
    )
    truth = view.image.astype(image.dtype)
    (L_render, L1, D_SSIM), back_image = with_backward(
        render_loss, image, truth, inputs.lambda_ssim
    )
    if stage == 4:
        (bits, L_rate), back_rate = rate(noisy, ctx, grids, inputs.mask, design)
    L_total, back_total = with_backward(
        total_loss, np.float64(L_render), np.float64(L_rate), inputs.lambda_rate
    )

    def back():
        gradients, losses_bar = p.zeros(), back_total(1.0)
        splats = back_render(back_image(losses_bar["L_render"])["image"])
        g_bar = [splats[name].astype(p.vector.dtype) for name in ("x", "s", "r", "alpha", "color")]
        anchors_bar, networks_bar = back_predict(*g_bar)
        noisy_bar = concatenate_groups(
            anchors_bar["f_a"], anchors_bar["s_a"], anchors_bar["l_a"], anchors_bar["O_a"]
        )  # [A, n]
        if stage == 4:
            coded_bar, mu_bar, sigma_bar, q_bar, hash_bars = back_rate(losses_bar["L_rate"])
            # one noisy value is rendered and coded (Q23)
            values_bar, noise_q_bar = back_noise(noisy_bar + coded_bar)
            grid_bars, context_bar = back_context(noise_q_bar + q_bar, mu_bar, sigma_bar)
            networks_bar |= context_bar
            for i, (grid_bar, hash_bar) in enumerate(zip(grid_bars, hash_bars)):
                gradients[f"grid.{i}"][...] = grid_bar + hash_bar
        else:
            values_bar = back_noise(noisy_bar)[0] if stage > 1 else noisy_bar
        _, s_a, l_a, _ = groups(values, design)
        f_a_bar, s_a_bar, l_a_bar, O_a_bar = split(values_bar, design)
        gradients["x_a"][...] = anchors_bar["x_a"]
        gradients["f_a"][...] = f_a_bar
        gradients["log_s"][...] = s_a_bar * s_a  # the slope of exp (Q5)
        gradients["log_l"][...] = l_a_bar * l_a
        gradients["O_a"][...] = O_a_bar
        for name, network_bar in networks_bar.items():
            gradients.fill(name, network_bar)
        return gradients, splats["mean2d"]

    losses = Losses(*map(float, (L_total, L_render, L1, D_SSIM, L_rate, bits)))
    return losses, Rendered(alpha, g.index, visible, image), back


def add_noise(values, u, steps, design):
    """Add noise to each group with its own step (Eq. 7); return [A, n] and `back`.

    back(noisy_bar) returns the gradients of the values [A, n] and of the steps [A, 4].
    """
    noisy, backs = [], []
    for i, (f, u_f) in enumerate(zip(groups(values, design), groups(u, design))):
        f_noisy, back_f = with_backward(noise, f, u_f, steps[:, i : i + 1])
        noisy.append(f_noisy)
        backs.append(back_f)

    def back(noisy_bar):
        bars = [back_f(bar) for back_f, bar in zip(backs, groups(noisy_bar, design))]
        return [np.concatenate([bar[name] for bar in bars], axis=1) for name in ("f", "q")]

    return np.concatenate(noisy, axis=1), back


def rate(noisy, ctx, grids, mask, design):
    """Return (bits, L_rate) of the noisy attributes and the grids, and `back`.

    Eqs. (11), (13), (14) and (17). The rate is per coded number of the anchors (Q12).
    back(L_rate_bar) returns the gradients of noisy attributes, mu and sigma [A, n], of the steps
    [A, 4] and of the grids.
    """
    q = np.repeat(ctx.q, design.widths, axis=1)  # all numbers of a group share its step
    bits_a, back_bits = with_backward(likelihood, noisy, ctx.mu, ctx.sigma, q)
    R_anchor, back_anchor = with_backward(anchor_rate, *split(bits_a, design), mask)
    (R_hash, _, _), back_hash = with_backward(hash_rate, grids)
    rates, back_rates = with_backward(rate_loss, R_anchor, R_hash, noisy.size)

    def back(L_rate_bar):
        rates_bar = back_rates(L_rate_bar=L_rate_bar)
        grids_bar = back_hash(rates_bar["R_hash"])["grids"]
        bits_bars = back_anchor(rates_bar["R_anchor"])  # bits of f, s, l and O
        bars = back_bits(concatenate_groups(*bits_bars.values()))
        group_starts = np.cumsum((0, *design.widths[:-1]))
        q_bar = np.add.reduceat(bars["q"], group_starts, axis=1)
        return bars["f_noisy"], bars["mu"], bars["sigma"], q_bar, grids_bar

    return rates, back
