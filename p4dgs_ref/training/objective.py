"""The training objective of one view, forward and backward: Eqs. (7), (11), (13) to (17) around the two pipelines.

Every equation of the paper meets here: `forward` runs them in the order of the paper's figures, `backward`
runs their backwards in the opposite order and adds up where a quantity was used twice.
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
    beside,
    context,
    context_backward,
    groups,
    predict,
    predict_backward,
    split,
)
from ..splatting import render

ATTRIBUTES = ("f_a", "log_s", "log_l", "O_a")  # the parameters behind the groups f, s, l, O


class Fixed(NamedTuple):
    """What an iteration takes as given."""

    mask: np.ndarray  # (A, k) children kept (Q15)
    located: object  # hash_grid.locate of the frozen positions; None before stage 4
    background: np.ndarray  # (3,)
    noisy: bool  # stage 2 on
    moving: bool  # stage 3 on
    lambda_rate: float
    lambda_ssim: float
    lambda_volume: float
    settings: object  # of the renderer


class Losses(NamedTuple):
    L_total: float
    L_render: float
    L1: float
    D_SSIM: float
    L_rate: float  # bits per coded number; 0 before stage 4
    bits: float


class Seen(NamedTuple):
    """What growing and pruning look at."""

    alpha: np.ndarray  # (A, k) opacities before masking
    index: np.ndarray  # (N,) a k + j of the rendered Gaussians
    visible: np.ndarray  # (N,) bool
    image: np.ndarray  # (H, W, 3)


def linear_values(p):
    """The coded attributes side by side (A, n), as `model.join`: logarithms undone (Q5)."""
    return beside(p["f_a"], np.exp(p["log_s"]), np.exp(p["log_l"]), p["O_a"])


def forward(p, design, networks, grids, fixed, view, u, truth_moments=None):
    """Losses of one view.

    Shapes     p: Parameters; networks, grids: views into p; u (A, n) noise in [-1/2, 1/2), unused in stage 1;
               truth_moments: `ssim.moments` of the view's image, if at hand
    Gradient   every array of p; positions through the render only; see each equation for kinks
    Choice     Q12 rate per number; Q23 one noise for render and rate; Q25 volume term; Q10 in `predict`
    Reference  P-4DGS Eqs. (15) to (17), Figs. 1 and 2
    """
    values = linear_values(p)
    q, ctx, res_c = None, None, None
    if fixed.located is not None:
        ctx, res_c = context(design, networks, grids, fixed.located)
        q = ctx.q
    elif fixed.noisy:
        q = np.tile(np.array(design.Q_0, values.dtype), (len(values), 1))
    res_n, noisy = [], values
    if q is not None:
        pairs = zip(groups(values, design), groups(u, design))
        moved = [noise.forward(f, part, q[:, i : i + 1]) for i, (f, part) in enumerate(pairs)]
        noisy = np.concatenate([f_noisy for f_noisy, _ in moved], axis=1)
        res_n = [saved for _, saved in moved]
    f, s, l, O = split(noisy, design)
    anchors = Anchors(p["x_a"], f, s, l, O, fixed.mask)
    g, res_p = predict(
        design,
        networks,
        anchors,
        view.camera.center.astype(values.dtype),
        view.time if fixed.moving else None,
    )
    (image, _, visible), res_r = render.forward(
        g.x,
        g.s,
        g.r,
        g.alpha,
        g.color,
        view.camera,
        fixed.background,
        fixed.settings,
        "occlusion" in design.effects,
    )
    (L_render, L1, D_SSIM), res_l = render_loss.forward(
        image, view.image.astype(image.dtype), fixed.lambda_ssim, truth_moments
    )
    volume = 0.0  # 0 times an overflow would not be 0
    if fixed.lambda_volume and len(g.s):
        volume = fixed.lambda_volume * float(np.prod(g.s, axis=1).mean())
    L_rate, bits, res_b = 0.0, 0.0, None
    if ctx is not None:
        (bits, L_rate), res_b = rate_forward(noisy, ctx, grids, fixed.mask, design)
    L_total, res_t = total_loss.forward(np.float64(L_render), np.float64(L_rate), fixed.lambda_rate)
    losses = Losses(
        float(L_total) + volume,
        float(L_render),
        float(L1),
        float(D_SSIM),
        float(L_rate),
        float(bits),
    )
    seen = Seen(res_p.alpha, g.index, visible, image)
    res = dict(
        p=p,
        design=design,
        values=values,
        noise=res_n,
        context=res_c,
        predict=res_p,
        render=res_r,
        g=g,
        loss=res_l,
        rate=res_b,
        total=res_t,
        fixed=fixed,
        n=len(g.s),
    )
    return losses, seen, res


def rate_forward(noisy, ctx, grids, mask, design):
    """Bits of the noisy attributes and of the grid (Eqs. 11, 13, 14, 17)."""
    columns = np.repeat(ctx.q, design.widths, axis=1)
    bits, saved_bits = likelihood.forward(noisy, ctx.mu, ctx.sigma, columns)
    R_anchor, saved_anchors = anchor_rate.forward(*split(bits, design), mask)
    (R_hash, _, _), saved_grid = hash_rate.forward(grids)
    out, saved = rate_loss.forward(R_anchor, R_hash, noisy.size)
    return out, (saved_bits, saved_anchors, saved_grid, saved)


def rate_backward(res, L_rate_bar, design):
    """Gradients of the noisy attributes, mu, sigma, q (A, 4) and the grids."""
    res_bits, res_a, res_h, res_l = res
    top = rate_loss.backward(res_l, L_rate_bar=L_rate_bar)
    grids = hash_rate.backward(res_h, top["R_hash"])["grids"]
    parts = anchor_rate.backward(res_a, top["R_anchor"])
    bits_bar = beside(parts["bits_f"], parts["bits_s"], parts["bits_l"], parts["bits_O"])
    bars = likelihood.backward(res_bits, bits_bar)
    starts = np.cumsum((0, *design.widths[:3]))
    return (
        bars["f_noisy"],
        bars["mu"],
        bars["sigma"],
        np.add.reduceat(bars["q"], starts, axis=1),
        grids,
    )


def backward(res):
    """Gradients of L_total as Parameters of the same layout, and the splats' mean2d gradient (N, 2)."""
    p, design, fixed, g = res["p"], res["design"], res["fixed"], res["g"]
    gradients, dtype = p.zeros(), p.vector.dtype
    top = total_loss.backward(res["total"], 1.0)
    image_bar = render_loss.backward(res["loss"], L_render_bar=top["L_render"])["image"]
    bars = render.backward(res["render"], image_bar)
    s_bar = bars["s"]
    if fixed.lambda_volume and res["n"]:  # the mean of s_0 s_1 s_2
        s = g.s.astype(float)
        s_bar = s_bar + fixed.lambda_volume / res["n"] * s[:, [1, 2, 0]] * s[:, [2, 0, 1]]
    anchors, networks = predict_backward(
        res["predict"],
        *(bar.astype(dtype) for bar in (bars["x"], s_bar, bars["r"], bars["alpha"], bars["color"])),
    )
    noisy_bar = beside(*(anchors[name] for name in ("f_a", "s_a", "l_a", "O_a")))
    grids_bar = mu_bar = sigma_bar = rate_q = None
    if res["rate"] is not None:
        rate_bar, mu_bar, sigma_bar, rate_q, grids_bar = rate_backward(
            res["rate"], top["L_rate"], design
        )
        noisy_bar = noisy_bar + rate_bar  # one noisy tensor was rendered and rated (Q23)
    values_bar = noisy_bar
    if res["noise"]:
        parts = [noise.backward(r, bar) for r, bar in zip(res["noise"], groups(noisy_bar, design))]
        values_bar = np.concatenate([part["f"] for part in parts], axis=1)
        if res["context"] is not None:
            q_bar = np.concatenate([part["q"] for part in parts], axis=1) + rate_q
            context_grids, context_nets = context_backward(res["context"], q_bar, mu_bar, sigma_bar)
            networks.update(context_nets)
            for i, (a, b) in enumerate(zip(context_grids, grids_bar)):
                gradients[f"grid.{i}"][...] = a + b
    values_bar[:, design.d : design.d + 6] *= res["values"][
        :, design.d : design.d + 6
    ]  # through exp: log_s, log_l
    for name, bar in zip(ATTRIBUTES, groups(values_bar, design)):
        gradients[name][...] = bar.reshape(gradients[name].shape)
    gradients["x_a"][...] = anchors["x_a"]
    for name, bars_of in networks.items():
        gradients.fill(name, bars_of)
    return gradients, bars["mean2d"]
