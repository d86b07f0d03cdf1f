"""Known mistakes written into Eqs. (15) to (17) and SSIM: {file: {id: [(old text, new text), ...]}}."""

IMPORT, MEAN = (
    "from .window import blur, moments, to_rows",
    "np.mean(luminance + structure - luminance * structure)",
)
SHARE, BLURRED = (
    "share = ssim_bar / x.size",
    "blur(np.stack([mu_bar, square_e_bar, square_x_bar], axis=1))",
)
D_2, STRUCTURE = "square_x - mu_x * mu_x + var_y + C2", "(square_e - mu_e * mu_e) / D2"
E_BAR, X_BAR = (
    "square_e_bar = -share * (1 - luminance) / D2",
    "square_x_bar = -structure * square_e_bar",
)
CONSTANTS = "C1, C2 = 0.01**2, 0.03**2"
CUT = """from .window import blur as padded, to_rows


def blur(a):
    return padded(a) / padded(np.ones_like(a))


def moments(truth):
    y = to_rows(truth)
    return y, blur(y), blur(y * y) - blur(y) ** 2"""
INNER = """share = np.zeros(x.shape)
    inner = share[5:-5, :, 5:-5]
    inner[:] = ssim_bar / max(inner.size, 1)"""
GRAY = """    C = image.shape[2]
    image, truth = (a.mean(axis=2, keepdims=True) for a in (image, truth))
    y, mu_y, var_y = moments(truth)
"""

SSIM = {
    "ssim-valid": [
        (MEAN, "np.mean((luminance + structure - luminance * structure)[5:-5, :, 5:-5])"),
        (SHARE, INNER),
    ],
    "ssim-renormalised": [
        (IMPORT, CUT),
        (
            BLURRED,
            "padded(np.stack([mu_bar, square_e_bar, square_x_bar], axis=1) "
            "/ padded(np.ones_like(x))[:, None])",
        ),
    ],
    "ssim-sample-variance": [
        (D_2, "121 / 120 * (square_x - mu_x * mu_x + var_y) + C2"),
        (STRUCTURE, "121 / 120 * " + STRUCTURE),
        (E_BAR, E_BAR + " * 121 / 120"),
    ],
    "ssim-constants": [(CONSTANTS, "C1, C2 = 0.01, 0.03")],
    "ssim-range": [(CONSTANTS, "C1, C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2")],
    # 1 - (cov + C2) / D2 with cov half of what is 2 cov
    "ssim-covariance": [
        (STRUCTURE, "0.5 + 0.5 * (square_e - mu_e * mu_e - C2) / D2"),
        (E_BAR, E_BAR + " / 2"),
        (X_BAR, "square_x_bar = (1 - 2 * structure) * square_e_bar"),
        (
            "2 * square_e_bar * (structure * mu_x - mu_e)",
            "2 * square_e_bar * ((2 * structure - 1) * mu_x - mu_e)",
        ),
    ],
    "ssim-gray": [
        ("    y, mu_y, var_y = moments(truth) if truth_moments is None else truth_moments\n", GRAY),
        ("structure, D1, D2, image.dtype)", "structure, D1, D2, (image.dtype, C))"),
        (", dtype = res", ", (dtype, C) = res"),
        (
            'image_bar.transpose(0, 2, 1).astype(dtype, order="C")',
            "np.repeat(image_bar.transpose(0, 2, 1) / C, C, axis=2).astype(dtype)",
        ),
    ],
    "ssim-gradient-sum": [(SHARE, "share = ssim_bar")],
}
WINDOW = {
    "ssim-box": [
        ("np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)", "np.ones(2 * RADIUS + 1)")
    ]
}

L1, BLEND = (
    "np.abs(difference).mean(dtype=np.float64)",
    "(1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM",
)
DIS, SIGN = "D_SSIM = image.dtype.type(D_SSIM)", "np.sign(difference)"
L1_BAR = "(1 - res.lambda_ssim) * L_render_bar"
BACK, PER = "-D_SSIM_bar)", "L1_bar / res.sign.size * res.sign"
RENDER = {
    "render-loss-lambda-exchanged": [
        (BLEND, "lambda_ssim * L1 + (1 - lambda_ssim) * D_SSIM"),
        (L1_BAR, "res.lambda_ssim * L_render_bar"),
        (
            "float(D_SSIM_bar + res.lambda_ssim * L_render_bar)",
            "float(D_SSIM_bar + (1 - res.lambda_ssim) * L_render_bar)",
        ),
    ],
    "render-loss-l1-whole": [(BLEND, "L1 + lambda_ssim * D_SSIM"), (L1_BAR, "L_render_bar")],
    "render-loss-squares": [
        (L1, "np.square(difference).mean(dtype=np.float64)"),
        (SIGN, "2 * difference"),
    ],
    "render-loss-sum": [
        (L1, "np.abs(difference).sum(dtype=np.float64)"),
        (PER, "L1_bar * res.sign"),
    ],
    "render-loss-halved": [
        (DIS, "D_SSIM = image.dtype.type(D_SSIM / 2)"),
        (BACK, "-D_SSIM_bar / 2)"),
    ],
    "render-loss-similarity": [
        (DIS, "D_SSIM = image.dtype.type(1 - D_SSIM)"),
        (BACK, "D_SSIM_bar)"),
    ],
    "render-loss-sign-of-zero": [(SIGN, "np.copysign(1, difference)")],
}

SUM, SHARED = (
    "bits = np.asarray(R_anchor + R_hash)",
    "np.asarray(bits / n_parameters if n_parameters else 0 * bits)",
)
START, PARAMETER = (
    "    bar = 0.0 if bits_bar is None else bits_bar\n",
    "bar = bar + L_rate_bar / res.n_parameters",
)
ASKED, BARS = "if L_rate_bar is not None and res.n_parameters:", '"R_hash": np.asarray(bar)}'
RATE = {
    "rate-loss-exchanged": [
        (f"Out(bits, {SHARED})", f"Out({SHARED}, bits)"),
        (START, "    bits_bar, L_rate_bar = L_rate_bar, bits_bar\n" + START),
    ],
    "rate-loss-not-divided": [
        (SHARED, "bits"),
        (ASKED, "if L_rate_bar is not None:"),
        (PARAMETER, "bar = bar + L_rate_bar"),
    ],
    "rate-loss-no-hash": [
        (SUM, "bits = np.asarray(R_anchor)"),
        (BARS, '"R_hash": np.zeros_like(bar)}'),
    ],
    "rate-loss-hash-not-divided": [
        (
            SHARED,
            "np.asarray((R_anchor / n_parameters if n_parameters else 0 * R_anchor) + R_hash)",
        ),
        (
            BARS,
            '"R_hash": np.asarray(0.0 if bits_bar is None else bits_bar)\n'
            "            + (0.0 if L_rate_bar is None else L_rate_bar)}",
        ),
    ],
    "rate-loss-bytes": [
        (SUM, "bits = np.asarray(R_anchor + R_hash) / 8"),
        ("    return {", "    bar = bar / 8\n    return {"),
    ],
}

FORWARD, BACKWARD = (
    "np.asarray(lambda_rate * L_rate + L_render)",
    "np.asarray(res.lambda_rate * L_total_bar)",
)
OTHER = '"L_render": np.asarray(L_total_bar)'
TOTAL = {
    "total-loss-lambda-exchanged": [
        (FORWARD, "np.asarray(L_rate + lambda_rate * L_render)"),
        (OTHER, '"L_render": np.asarray(L_total_bar * res.lambda_rate)'),
        (BACKWARD, "np.asarray(1 * L_total_bar)"),
    ],
    "total-loss-convex": [
        (FORWARD, "np.asarray(lambda_rate * L_rate + (1 - lambda_rate) * L_render)"),
        (OTHER, '"L_render": np.asarray((1 - res.lambda_rate) * L_total_bar)'),
    ],
    "total-loss-lambda-on-both": [
        (FORWARD, "np.asarray(lambda_rate * (L_rate + L_render))"),
        (OTHER, '"L_render": np.asarray(L_total_bar * res.lambda_rate)'),
    ],
    "total-loss-no-lambda": [
        (FORWARD, "np.asarray(L_rate + L_render)"),
        (BACKWARD, "np.asarray(L_total_bar)"),
    ],
    "total-loss-gradient": [(BACKWARD, "np.asarray(L_total_bar)")],
}

PATCHES = {
    "equations/ssim.py": SSIM,
    "equations/window.py": WINDOW,
    "equations/render_loss.py": RENDER,
    "equations/rate_loss.py": RATE,
    "equations/total_loss.py": TOTAL,
}
