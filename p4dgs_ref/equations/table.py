"""The table of the paper's equations, in its order, then of their building blocks.

`p4dgs_ref.EQUATIONS` holds these rows and those of splatting as `splatting.table.Equation`.
"""

from . import (
    anchor_rate,
    color,
    deformation,
    deformed,
    hash_grid,
    hash_rate,
    likelihood,
    masking,
    mlp,
    noise,
    offsets,
    opacity,
    positional_encoding,
    prior,
    rate_loss,
    render_loss,
    rotation,
    rounding,
    scale,
    ssim,
    step,
    total_loss,
    view,
)

ANCHOR_NETWORK = "f_a delta_vc d_vc weights biases"

# Module, number as printed, formula, outputs, and the inputs that receive a gradient. The number is
# "3'" for what Eq. (3) says by analogy, and "" where the paper prints none.
ROWS = (
    (offsets, "1", "x = x_a + O_a * l_a", "x", "x_a O_a l_a"),
    (view, "2", "delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc", "delta_vc d_vc", "x_a"),
    (opacity, "3", "alpha = tanh(psi_alpha(f_a, delta_vc, d_vc))", "alpha", ANCHOR_NETWORK),
    (
        masking,
        "",
        "keep where mask and alpha >= tau_alpha",
        "alpha x color s r index",
        "x s r alpha color",
    ),
    (color, "3'", "color = sigmoid(psi_c(f_a, delta_vc, d_vc))", "color", ANCHOR_NETWORK),
    (
        rotation,
        "3'",
        "r = psi_r / |psi_r|, psi_r = psi_r(f_a, delta_vc, d_vc)",
        "r",
        ANCHOR_NETWORK,
    ),
    (scale, "4", "s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc))", "s", f"s_a {ANCHOR_NETWORK}"),
    (positional_encoding, "", "E(p) = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1", "E", "p"),
    (
        deformation,
        "5",
        "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t)))",
        "delta_x delta_s delta_r",
        "x weights biases",
    ),
    (
        deformed,
        "6",
        "x_t = x + delta_x, s_t = s + delta_s, r_t = (r + delta_r) / |r + delta_r|",
        "x_t s_t r_t",
        "x s r delta_x delta_s delta_r",
    ),
    (noise, "7", "f_noisy = f + u q", "f_noisy", "f q"),
    (step, "8", "q = Q_0 (1 + tanh(psi_q(h)))", "q", "h weights biases"),
    (hash_grid, "9", "h = H(x_a): multilinear reads of binary grids", "h", "grids"),
    (rounding, "10", "f_hat = round_half_even(f / q) q", "symbols f_hat", ""),
    (
        likelihood,
        "11",
        "bits = -log2(Phi((f_noisy + q/2 - mu) / sigma) - Phi((f_noisy - q/2 - mu) / sigma))",
        "bits",
        "f_noisy mu sigma q",
    ),
    (prior, "12", "(mu, sigma) = psi_p(h)", "mu sigma", "h weights biases"),
    (
        anchor_rate,
        "13",
        "R_anchor = sum of the bits of f, s, l, O over all anchors",
        "R_anchor",
        "bits_f bits_s bits_l bits_O",
    ),
    (hash_rate, "14", "R_hash = N+ (-log2 p+) + N- (-log2 p-)", "R_hash n_pos n_neg", "grids"),
    (total_loss, "15", "L_total = lambda_rate L_rate + L_render", "L_total", "L_render L_rate"),
    (
        render_loss,
        "16",
        "L_render = (1 - lambda_ssim) L1 + lambda_ssim (1 - SSIM)",
        "L_render L1 D_SSIM",
        "image",
    ),
    (
        rate_loss,
        "17",
        "bits = R_anchor + R_hash, L_rate = bits / n_parameters",
        "bits L_rate",
        "R_anchor R_hash",
    ),
    (mlp, "", "y = relu(... relu(x W_0 + b_0) ...) W_n + b_n", "y", "x weights biases"),
    (
        ssim,
        "",
        "mean (2 mu_x mu_y + C1)(2 sigma_xy + C2) "
        "/ ((mu_x^2 + mu_y^2 + C1)(sigma_x^2 + sigma_y^2 + C2))",
        "ssim",
        "image",
    ),
)
