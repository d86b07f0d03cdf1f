"""The training objective of one view, forward and backward.

    attributes, noise -> Gaussians at time t -> image -> L_render    Eqs. (7), (1) to (6), (16)
    positions -> hash grid -> q, mu, sigma -> bits -> L_rate         Eqs. (8), (9), (11) to (14)
    L_total = lambda_rate * L_rate + L_render                        Eqs. (15), (17)

All equations of the paper meet here. `forward` runs them in the order of the paper's figures.
`backward` runs their backwards in the opposite order and adds gradients where a quantity was used
twice.
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
from ..model import (
    Anchors,
    beside,
    context,
    context_backward,
    groups,
    predict,
    predict_backward,
    split,
)
from ..splatting import render
from . import coded_networks

ATTRIBUTES = ("f_a", "log_s", "log_l", "O_a")  # the parameters of the groups f, s, l, O


class Fixed(NamedTuple):
    """The inputs of an iteration that are not parameters."""

    mask: np.ndarray  # [A, k]  children that are kept (Q15)
    located: object  # `hash_grid.locate` of the frozen positions; None before stage 4
    background: np.ndarray  # [3]
    noisy: bool  # from stage 2 on
    moving: bool  # from stage 3 on
    lambda_rate: float
    lambda_ssim: float
    lambda_volume: float  # weight of Scaffold-GS's volume term (Q25)
    settings: object  # of the renderer
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


def forward(p, design, networks, grids, fixed, view, u, truth_moments=None):
    """Return the Losses of one view, what density control has Seen, and what `backward` needs.

    `networks` and `grids` are views into the Parameters p. u [A, n] is the noise in [-1/2, 1/2);
    rendering and rate share it (Q23), and stage 1 does not use it. `truth_moments` are the
    `ssim.moments` of the view's image, if they are at hand.
    """
    R_networks, saved_networks = 0.0, None
    if fixed.coded is not None:
        networks, R_networks, saved_networks = coded_networks.forward(p, fixed.coded)
    values = linear_values(p)
    steps, ctx, saved_context = None, None, None
    if fixed.located is not None:
        ctx, saved_context = context(design, networks, grids, fixed.located)
        steps = ctx.q
    elif fixed.noisy:
        steps = np.tile(np.array(design.Q_0, values.dtype), (len(values), 1))
    noisy, saved_noise = values, []
    if steps is not None:
        noisy, saved_noise = noise_forward(values, u, steps, design)

    f, s, l, O = split(noisy, design)
    anchors = Anchors(p["x_a"], f, s, l, O, fixed.mask)
    x_c = view.camera.center.astype(values.dtype)
    t = view.time if fixed.moving else None
    g, saved_predict = predict(design, networks, anchors, x_c, t)
    (image, _, visible), saved_render = render.forward(
        *g[:5], view.camera, fixed.background, fixed.settings, "occlusion" in design.effects
    )
    (L_render, L1, D_SSIM), saved_loss = render_loss.forward(
        image, view.image.astype(image.dtype), fixed.lambda_ssim, truth_moments
    )
    bits, L_rate, saved_rate = 0.0, 0.0, None
    if ctx is not None:
        R_networks *= fixed.network_price
        (bits, L_rate), saved_rate = rate_forward(noisy, ctx, grids, fixed.mask, design, R_networks)
    L_total, saved_total = total_loss.forward(
        np.float64(L_render), np.float64(L_rate), fixed.lambda_rate
    )
    L_volume, volume_s_bar = volume(g.s, fixed.lambda_volume)
    losses = [
        float(L_total) + L_volume,
        *(float(loss) for loss in (L_render, L1, D_SSIM, L_rate, bits)),
    ]
    saved_parts = saved_noise, saved_context, saved_predict, saved_render, saved_loss, saved_rate
    saved = p, design, fixed, values, volume_s_bar, saved_parts, saved_networks, saved_total
    return Losses(*losses), Seen(saved_predict.alpha, g.index, visible, image), saved


def backward(saved):
    """Gradients of L_total as Parameters of the same layout, and of the splats' mean2d [N, 2]."""
    p, design, fixed, values, volume_s_bar, saved_parts, saved_networks, saved_total = saved
    saved_noise, saved_context, saved_predict, saved_render, saved_loss, saved_rate = saved_parts
    gradients = p.zeros()
    losses_bar = total_loss.backward(saved_total, 1.0)
    image_bar = render_loss.backward(saved_loss, losses_bar["L_render"])["image"]
    bars = render.backward(saved_render, image_bar)
    bars["s"] = bars["s"] + volume_s_bar
    gaussians_bar = [
        bars[name].astype(p.vector.dtype) for name in ("x", "s", "r", "alpha", "color")
    ]
    anchors, networks = predict_backward(saved_predict, *gaussians_bar)
    noisy_bar = beside(*(anchors[name] for name in ("f_a", "s_a", "l_a", "O_a")))
    if saved_rate is not None:
        rate_bar, mu_bar, sigma_bar, rate_q_bar, rate_grids = rate_backward(
            saved_rate, losses_bar["L_rate"], design
        )
        noisy_bar = noisy_bar + rate_bar  # one noisy value is rendered and coded (Q23)
    values_bar = noisy_bar
    if saved_noise:
        values_bar, q_bar = noise_backward(saved_noise, noisy_bar, design)
    if saved_rate is not None:
        context_grids, context_networks = context_backward(
            saved_context, q_bar + rate_q_bar, mu_bar, sigma_bar
        )
        networks.update(context_networks)
        for i, (read, counted) in enumerate(zip(context_grids, rate_grids)):
            gradients[f"grid.{i}"][...] = read + counted
    lengths = slice(design.d, design.d + 6)  # the columns of s and l, trained as logarithms (Q5)
    values_bar[:, lengths] *= values[:, lengths]
    for name, bar in zip(ATTRIBUTES, groups(values_bar, design)):
        gradients[name][...] = bar.reshape(gradients[name].shape)
    gradients["x_a"][...] = anchors["x_a"]
    for name, network_gradients in networks.items():
        gradients.fill(name, network_gradients)
    if saved_networks is not None:
        R_networks_bar = fixed.network_price * losses_bar["L_rate"] / values.size
        coded_networks.backward(saved_networks, gradients, R_networks_bar)
    return gradients, bars["mean2d"]


def noise_forward(values, u, steps, design):
    """Add noise to each group with its own step (Eq. 7): [A, n] and what `noise_backward` needs."""
    pairs = zip(groups(values, design), groups(u, design))
    parts = [noise.forward(f, u_f, steps[:, i : i + 1]) for i, (f, u_f) in enumerate(pairs)]
    noisy = [f_noisy for f_noisy, _ in parts]
    return np.concatenate(noisy, axis=1), [saved for _, saved in parts]


def noise_backward(saved, noisy_bar, design):
    """Gradients of the values [A, n] and of the steps [A, 4]."""
    parts = [noise.backward(*pair) for pair in zip(saved, groups(noisy_bar, design))]
    values_bar = np.concatenate([part["f"] for part in parts], axis=1)
    return values_bar, np.concatenate([part["q"] for part in parts], axis=1)


def rate_forward(noisy, ctx, grids, mask, design, R_networks=0.0):
    """Return (bits, L_rate) of the noisy attributes and the grids, and what `rate_backward` needs.

    Eqs. (11), (13), (14) and (17), with the bits of coded networks as one more term of the last
    (B1). The rate is per coded number of the anchors (Q12).
    """
    q = np.repeat(ctx.q, design.widths, axis=1)  # all numbers of a group share its step
    bits, saved_bits = likelihood.forward(noisy, ctx.mu, ctx.sigma, q)
    R_anchor, saved_anchors = anchor_rate.forward(*split(bits, design), mask)
    (R_hash, _, _), saved_grids = hash_rate.forward(grids)
    R_rest = R_hash + in_precision_of(R_hash, R_networks)
    rates, saved_rates = rate_loss.forward(R_anchor, R_rest, noisy.size)
    return rates, (saved_bits, saved_anchors, saved_grids, saved_rates)


def rate_backward(saved, L_rate_bar, design):
    """Gradients of noisy attributes, mu and sigma [A, n], of steps [A, 4] and of the grids."""
    saved_bits, saved_anchors, saved_grids, saved_rates = saved
    rates_bar = rate_loss.backward(saved_rates, L_rate_bar=L_rate_bar)
    grids_bar = hash_rate.backward(saved_grids, rates_bar["R_hash"])["grids"]
    parts = anchor_rate.backward(saved_anchors, rates_bar["R_anchor"])
    bits_bar = beside(parts["bits_f"], parts["bits_s"], parts["bits_l"], parts["bits_O"])
    bars = likelihood.backward(saved_bits, bits_bar)
    group_starts = np.cumsum((0, *design.widths[:3]))
    q_bar = np.add.reduceat(bars["q"], group_starts, axis=1)
    return bars["f_noisy"], bars["mu"], bars["sigma"], q_bar, grids_bar


def volume(s, weight):
    """Scaffold-GS's volume term, weight times the mean product of the three scales (Q25).

    Return it and its gradient by s [N, 3]; both are 0 without a weight.
    """
    if not weight or not len(s):  # 0 times an overflow would be NaN
        return 0.0, 0.0
    wide = s.astype(float)
    s_bar = weight / len(s) * wide[:, [1, 2, 0]] * wide[:, [2, 0, 1]]
    return weight * float(np.prod(s, axis=1).mean()), s_bar
