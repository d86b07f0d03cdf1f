"""The training objective of one view, forward and backward.

    attributes, noise -> Gaussians at time t -> image -> L_render    Eqs. (7), (1) to (6), (16)
    positions -> hash grid -> q, mu, sigma -> bits -> L_rate         Eqs. (8), (9), (11) to (14)
    L_total = lambda_rate * L_rate + L_render                        Eqs. (15), (17)

All equations of the paper meet here. `loss` calls them in the order of the paper's figures. It
returns the losses and `back`, which calls their backwards in the opposite order and adds gradients
where a quantity was used twice.
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
from ..equations.numerics import in_precision_of
from ..model import GROUPS, Anchors, beside, context, groups, predict, pull, split
from ..splatting import render
from ..splatting.settings import Settings
from . import coded_networks

ATTRIBUTES = ("f_a", "log_s", "log_l", "O_a")  # the parameters of the groups f, s, l, O


class Fixed(NamedTuple):
    """The inputs of an iteration that are not parameters."""

    mask: np.ndarray  # [A, k]  children that are kept (Q15)
    located: object  # `hash_grid.locate` of the frozen positions; None before stage 4
    background: np.ndarray  # [3]
    stage: int  # 1 to 4: noise from stage 2 on, time from 3 on, context and rate in 4
    lambda_rate: float
    lambda_ssim: float
    settings: Settings  # of the renderer
    weight: np.ndarray | float = 1.0  # of a pixel in L1, [H, W, 1] or one for all (B3)
    # Only of the coded design, in stage 4 (B1):
    coded: coded_networks.Layout | None = None
    network_price: float = 1.0  # of a bit of a network, in bits of an anchor


class Losses(NamedTuple):
    """The losses of one view; rate and bits are 0 before stage 4."""

    L_total: float
    L_render: float
    L1: float
    D_SSIM: float
    L_rate: float  # bits per coded number
    bits: float


class Seen(NamedTuple):
    """What growing and pruning look at."""

    alpha: np.ndarray  # [A, k]  opacities before masking
    index: np.ndarray  # [N]  a k + i of the rendered Gaussians
    visible: np.ndarray  # [N]  bool
    image: np.ndarray  # [H, W, 3]


def linear_values(p):
    """The coded attributes side by side [A, n], as in `model.join`: logarithms undone (Q5)."""
    return beside(p["f_a"], np.exp(p["log_s"]), np.exp(p["log_l"]), p["O_a"])


def loss(p, design, networks, grids, fixed, view, u, truth_moments=None):
    """The Losses of one view, what density control has Seen, and `back`.

    `networks` and `grids` are views into the Parameters p. u [A, n] is the noise in [-1/2, 1/2);
    rendering and rate share it (Q23), and stage 1 does not use it. `truth_moments` are the
    `ssim.moments` of the view's image, if they are at hand. back() returns the gradients of L_total
    as Parameters of the same layout, and those of the splats' mean2d [N, 2].
    """
    stage, values = fixed.stage, linear_values(p)
    bits, L_rate, R_networks = 0.0, 0.0, 0.0
    if fixed.coded is not None:
        networks, R_networks, back_networks = coded_networks.coded(p, fixed.coded)
    noisy, q = values, np.array([design.Q_0], values.dtype)
    if stage == 4:
        ctx, back_context = context(design, networks, grids, fixed.located)
        q = ctx.q
    if stage > 1:
        noisy, back_noise = add_noise(values, u, q, design)
    anchors = Anchors(p["x_a"], *split(noisy, design), fixed.mask)
    g, alpha, back_predict = predict(
        design,
        networks,
        anchors,
        view.camera.center.astype(values.dtype),
        view.time if stage > 2 else None,
    )
    (image, _, visible), back_render = pull(
        render,
        *g[:5],
        view.camera,
        fixed.background,
        fixed.settings,
        "occlusion" in design.effects,
    )
    truth = view.image.astype(image.dtype)
    (L_render, L1, D_SSIM), back_image = pull(
        render_loss, image, truth, fixed.lambda_ssim, truth_moments, fixed.weight
    )
    if stage == 4:
        (bits, L_rate), back_rate = rate(
            noisy, ctx, grids, fixed.mask, design, fixed.network_price * R_networks
        )
    L_total, back_total = pull(
        total_loss, np.float64(L_render), np.float64(L_rate), fixed.lambda_rate
    )

    def back():
        gradients, losses_bar = p.zeros(), back_total(1.0)
        splats = back_render(back_image(losses_bar["L_render"])["image"])
        g_bar = [splats[name].astype(p.vector.dtype) for name in ("x", "s", "r", "alpha", "color")]
        anchors_bar, networks_bar = back_predict(*g_bar)
        noisy_bar = beside(*(anchors_bar[name] for name in ("f_a", "s_a", "l_a", "O_a")))
        if stage == 4:
            coded_bar, mu_bar, sigma_bar, q_bar, counted = back_rate(losses_bar["L_rate"])
            # one noisy value is rendered and coded (Q23)
            values_bar, noise_q_bar = back_noise(noisy_bar + coded_bar)
            read, context_bar = back_context(noise_q_bar + q_bar, mu_bar, sigma_bar)
            networks_bar |= context_bar
            for i, (read_bar, counted_bar) in enumerate(zip(read, counted)):
                gradients[f"grid.{i}"][...] = read_bar + counted_bar
        else:
            values_bar = back_noise(noisy_bar)[0] if stage > 1 else noisy_bar
        lengths = slice(design.d, design.d + 6)  # of s and l, trained as logarithms (Q5)
        values_bar[:, lengths] *= values[:, lengths]
        gradients["x_a"][...] = anchors_bar["x_a"]
        for name, bar in zip(ATTRIBUTES, groups(values_bar, design)):
            gradients[name][...] = bar.reshape(gradients[name].shape)
        for name, network_bar in networks_bar.items():
            gradients.fill(name, network_bar)
        if fixed.coded is not None:
            back_networks(gradients, fixed.network_price * losses_bar["L_rate"] / values.size)
        return gradients, splats["mean2d"]

    losses = Losses(*map(float, (L_total, L_render, L1, D_SSIM, L_rate, bits)))
    return losses, Seen(alpha, g.index, visible, image), back


def add_noise(values, u, steps, design):
    """Add noise to each group with its own step (Eq. 7): [A, n] and `back`.

    back(noisy_bar) returns the gradients of the values [A, n] and of the steps [A, 4].
    """
    columns = zip(groups(values, design), groups(u, design), np.split(steps, 4, axis=1))
    noisy, backs = zip(*(pull(noise, f, u_f, q_f) for f, u_f, q_f in columns))

    def back(noisy_bar):
        bars = [back_f(bar) for back_f, bar in zip(backs, groups(noisy_bar, design))]
        return [np.concatenate([bar[name] for bar in bars], axis=1) for name in ("f", "q")]

    return np.concatenate(noisy, axis=1), back


def rate(noisy, ctx, grids, mask, design, R_networks=0.0):
    """Return (bits, L_rate) of the noisy attributes and the grids, and `back`.

    Eqs. (11), (13), (14) and (17), with the bits of coded networks as one more term of the last
    (B1). The rate is per coded number of the anchors (Q12). back(L_rate_bar) returns the gradients
    of noisy attributes, mu and sigma [A, n], of the steps [A, 4] and of the grids.
    """
    q = np.repeat(ctx.q, design.widths, axis=1)  # all numbers of a group share its step
    bits_a, back_bits = pull(likelihood, noisy, ctx.mu, ctx.sigma, q)
    R_anchor, back_anchor = pull(anchor_rate, *split(bits_a, design), mask)
    (R_hash, _, _), back_hash = pull(hash_rate, grids)
    R_rest = R_hash + in_precision_of(R_hash, R_networks)
    rates, back_rates = pull(rate_loss, R_anchor, R_rest, noisy.size)

    def back(L_rate_bar):
        rates_bar = back_rates(L_rate_bar=L_rate_bar)
        grids_bar = back_hash(rates_bar["R_hash"])["grids"]
        parts = back_anchor(rates_bar["R_anchor"])
        bars = back_bits(beside(*(parts[f"bits_{group}"] for group in GROUPS)))
        group_starts = np.cumsum((0, *design.widths[:3]))
        q_bar = np.add.reduceat(bars["q"], group_starts, axis=1)
        return bars["f_noisy"], bars["mu"], bars["sigma"], q_bar, grids_bar

    return rates, back
