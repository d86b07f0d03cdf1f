"""Known mistakes written into covariance, projection and compositing: {file: {id: [(old text, new text), ...]}}."""

M, M_BAR = "M = R * s[:, None, :]", "M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ res.M"
SCALES, SIGMA = "s_bar = (M_bar * res.R).sum(axis=1)", "Out(M @ M.transpose(0, 2, 1))"
R_BAR, BARS = "R_bar = M_bar * res.s[:, None, :]", 'return {"s": s_bar, "r": r_bar}'
COVARIANCE = {
    "covariance-real-last": [
        ("    w, x, y, z = r.T", "    x, y, z, w = r.T"),
        ("w, x, y, z = res.r.T", "x, y, z, w = res.r.T"),
        (BARS, 'return {"s": s_bar, "r": np.roll(r_bar, -1, axis=1)}'),
    ],
    "covariance-transposed": [
        (M, "R = R.transpose(0, 2, 1)\n    " + M),
        ("R_bar.transpose(1, 2, 0)", "R_bar.transpose(2, 1, 0)"),
    ],
    "covariance-not-squared": [
        (SIGMA, "Out(M @ R.transpose(0, 2, 1))"),
        (M_BAR, "M_bar = Sigma_bar @ res.R"),
        (R_BAR, "R_bar = M_bar * res.s[:, None, :] + Sigma_bar.transpose(0, 2, 1) @ res.M"),
    ],
    "covariance-log-scale": [
        (M, "s = np.exp(s)\n    " + M),
        (SCALES, "s_bar = (M_bar * res.R).sum(axis=1) * res.s"),
    ],
    "covariance-log-gradient": [(SCALES, "s_bar = (M_bar * res.R).sum(axis=1) * res.s")],
    "covariance-one-factor": [(M_BAR, "M_bar = Sigma_bar @ res.M")],
    "covariance-not-symmetrised": [(M_BAR, "M_bar = 2 * Sigma_bar @ res.M")],
    "covariance-normalised-gradient": [
        (BARS, 'r_bar = r_bar - np.einsum("ni,ni,nj->nj", r_bar, res.r, res.r)\n    ' + BARS)
    ],
    "covariance-half-quaternion": [("r_bar = 2 * np.stack", "r_bar = np.stack")],
}

TO_CAMERA, SEEN = (
    "x_c = x @ W.T + np.asarray(T, inner)",
    "W, focal, Sigma = np.asarray(W, inner), np.asarray(focal, inner)",
)
ROWS, CLIP = "m = (W[None, :2] - uv[:, :, None] * W[2])", "uv = np.clip(ratio, -limit, limit)"
MEANS, CONIC = "ratio * focal + np.asarray(center, inner)", "np.stack([c, -b, a])"
PASSED, K_ENTRIES, K_BARS = (
    "ratio_bar = uv_bar * res.inside",
    "A, B, C = res.conic.T",
    "gA, gB, gC = conic_bar.T",
)
X_BAR = "x_bar = np.concatenate([ratio_bar / z, z_bar], axis=1) @ res.W"
START = "    keep = res.visible\n"


def turned(signs):
    """The camera's axes with other signs."""
    return [
        (
            "    " + SEEN,
            f"    turn = np.array({signs})\n    W, T = turn[:, None] * W, turn * T\n    " + SEEN,
        )
    ]


PROJECTION = {
    "projection-camera-to-world": [("    " + SEEN, "    W = W.T\n    " + SEEN)],
    "projection-camera-position": [(TO_CAMERA, "x_c = (x - T) @ W.T")],
    "projection-y-up": turned([1.0, -1.0, 1.0]),
    "projection-z-backward": turned([1.0, -1.0, -1.0]),
    "projection-one-focal": [
        ("np.asarray(focal, inner), Sigma", "np.full(2, focal[0], inner), Sigma")
    ],
    "projection-centre-of-image": [(MEANS, "ratio * focal + 0.5 * (np.asarray(size) - 1)")],
    "projection-half-pixel": [(MEANS, MEANS + " + 0.5")],
    "projection-half-pixel-back": [(MEANS, MEANS + " - 0.5")],
    "projection-row-column": [
        (
            "    outputs = [np.where",
            "    outputs[0] = outputs[0][:, [1, 0]]\n    outputs = [np.where",
        ),
        (
            "np.where(keep[:, None], mean2d_bar, 0)",
            "np.where(keep[:, None], mean2d_bar[:, [1, 0]], 0)",
        ),
    ],
    "projection-distance": [
        ("z[:, 0]]", "np.sqrt((x_c**2).sum(axis=1))]"),
        (
            "z_bar[:, 0] += np.where(keep, depth_bar, 0)",
            "far = np.sqrt((res.x_c**2).sum(axis=1))\n        along = res.x_c * (np.where(keep, depth_bar, 0) / far)[:, None]",
        ),
        (X_BAR, X_BAR + "\n    x_bar = x_bar if depth_bar is None else x_bar + along @ res.W"),
    ],
    "projection-near": [("near=0.2,", "near=0.01,")],
    "projection-near-inclusive": [("x_c[:, 2] > near", "x_c[:, 2] >= near")],
    "projection-no-blur": [("blur=0.3,", "blur=0.0,")],
    "projection-blur-third": [("blur=0.3,", "blur=0.33,")],
    "projection-blur-squared": [("blur=0.3,", "blur=0.09,")],
    "projection-no-clamp": [("tan_clamp=1.3)", "tan_clamp=np.inf)")],
    "projection-clamp-at-edge": [("tan_clamp=1.3)", "tan_clamp=1.0)")],
    "projection-covariance-transposed": [
        (ROWS, "m = (W.T[None, :2] - uv[:, :, None] * W[:, 2])"),
        ("(m_bar @ res.W[2])", "(m_bar @ res.W[:, 2])"),
    ],
    "projection-focal-over-x": [
        (
            ROWS,
            "m = (W[None, :2] / np.where(ratio == 0, 1, ratio)[:, :, None] - uv[:, :, None] * W[2])",
        ),
        (
            PASSED,
            "ratio = res.x_c[:, :2] / z\n    "
            + PASSED
            + "\n    ratio_bar -= np.where(ratio == 0, 0, "
            "(m_bar * res.W[:2]).sum(axis=2) * res.focal / z / np.where(ratio == 0, 1, ratio) ** 2)",
        ),
    ],
    "projection-clamp-times-x": [
        (CLIP, CLIP + " * ratio"),
        (
            PASSED,
            "ratio = res.x_c[:, :2] / z\n"
            "    clipped = np.divide(res.uv, ratio, out=np.zeros_like(ratio), where=ratio != 0)\n"
            "    ratio_bar = uv_bar * (clipped + ratio * res.inside)",
        ),
    ],
    "projection-clamp-gradient": [(PASSED, "ratio_bar = uv_bar")],
    "projection-clamp-gradient-of-z": [
        (
            PASSED,
            PASSED
            + "\n    z_bar -= (uv_bar * res.uv * ~res.inside).sum(axis=1, keepdims=True) / z",
        )
    ],
    "projection-mean-gradient-alone": [("m_bar = D @ m @ ", "m_bar = 0 * D @ m @ ")],
    "projection-conic-not-inverted": [
        (CONIC + " / det", "np.stack([a, b, c])"),
        (
            START,
            START
            + "    cov2d_bar, conic_bar = [b for b in (cov2d_bar, conic_bar) if b is not None], None\n"
            "    cov2d_bar = sum(cov2d_bar) if cov2d_bar else None\n",
        ),
    ],
    "projection-conic-sign": [
        (CONIC, "np.stack([c, b, a])"),
        (K_ENTRIES, K_ENTRIES + "\n        B = -B"),
        (K_BARS, K_BARS + "\n        gB = -gB"),
    ],
    "projection-conic-doubled": [
        (CONIC, "np.stack([c, -2 * b, a])"),
        (K_ENTRIES, K_ENTRIES + "\n        B = B / 2"),
        (K_BARS, K_BARS + "\n        gB = 2 * gB"),
    ],
    "projection-off-diagonal-gradient": [
        ("np.where(keep, db / 2, 0)", "np.where(keep, db / 4, 0)")
    ],
}

SORTED = 'np.argsort(depth[rows], kind="stable")'
IMAGE = "image[pixels] = w.T @ color[order] + T[pixels, None] * background"
BEHIND = 'g[pixels] @ inputs["background"] + h[pixels]'
SHOWN = "Out(image.reshape(height, width, 3), T.reshape(height, width))"
CENTRES = "(index % width).astype(dtype), (index // width).astype(dtype)"
GIVEN, GIVEN_T = "image_bar.reshape(-1, 3)", "transmittance_bar.reshape(-1)"
COLOR_BAR, BACKGROUND_BAR = (
    "color_bar += (A * before) @ g[pixels]",
    "background_bar += T @ g[pixels]",
)
COLORS, VALUES = 'inputs["color"][order]\n', 'rows = {"mean2d"'
CLAMPED = 'np.minimum(inputs["alpha"][order, None] * falloff, inputs["alpha_max"])'
UNCLAMPED = 'V *= inputs["alpha"][order, None] * falloff <= inputs["alpha_max"]'
LOG_BAR, FACTORS = 'V *= inputs["alpha"][order, None]  ', "np.array([-0.5, -1, -0.5], dtype)"
LAYERS = "V[i] -= behind\n                behind += A[i] * V[i]"
WEIGHTS = "w = A * _transmittances(A, T[pixels]) if occlusion else A"


def seen(view):
    """The picture read another way."""
    return [
        (SHOWN, SHOWN.replace("3)", f"3){view}").replace("width))", f"width){view})")),
        (GIVEN, f"image_bar{view}.reshape(-1, 3)"),
        (GIVEN_T, f"transmittance_bar{view}.reshape(-1)"),
    ]


def skipping(condition):
    """Alphas A set to zero under a condition; they have no slope either."""
    return [
        ("    return " + CLAMPED, f"    A = {CLAMPED}\n    return np.where({condition}, 0, A)"),
        (UNCLAMPED, UNCLAMPED + f"\n        V *= A == {CLAMPED}"),
    ]


COMPOSITING = {
    "compositing-back-to-front": [(SORTED, 'np.argsort(-depth[rows], kind="stable")')],
    "compositing-not-sorted": [(f"rows[{SORTED}]", "rows")],
    "compositing-ties-reversed": [
        ("rows = np.flatnonzero(visible)", "rows = np.flatnonzero(visible)[::-1]")
    ],
    "compositing-culled-drawn": [
        ("rows = np.flatnonzero(visible)", "rows = np.arange(len(visible))")
    ],
    "compositing-always-occludes": [
        ("    inputs = dict(", "    occlusion = True\n    inputs = dict(")
    ],
    "compositing-no-background": [
        (IMAGE, "image[pixels] = w.T @ color[order]"),
        (BEHIND, "h[pixels].copy()"),
        (BACKGROUND_BAR, "pass"),
    ],
    "compositing-background-twice": [
        (IMAGE, IMAGE + " + T[pixels, None] * background"),
        (BEHIND, "2 * " + BEHIND),
        (BACKGROUND_BAR, "background_bar += 2 * T @ g[pixels]"),
    ],
    "compositing-opaque-background": [
        (IMAGE, "image[pixels] = w.T @ color[order] + background"),
        (BEHIND, "h[pixels].copy()"),
        (BACKGROUND_BAR, "background_bar += g[pixels].sum(axis=0)"),
    ],
    "compositing-premultiplied": [
        (IMAGE, IMAGE.replace("color[order]", "(alpha[:, None] * color)[order]")),
        (COLORS, 'inputs["color"][order] * inputs["alpha"][order, None]\n'),
        (
            "    " + VALUES,
            '    per[:, 0] += (color_bar * inputs["color"][order]).sum(axis=1)\n'
            '    color_bar *= inputs["alpha"][order, None]\n    ' + VALUES,
        ),
    ],
    "compositing-bgr": [
        (IMAGE, IMAGE.replace("color[order]", "color[order, ::-1]")),
        (COLORS, 'inputs["color"][order, ::-1]\n'),
        ("    " + VALUES, "    color_bar = color_bar[:, ::-1]\n    " + VALUES),
    ],
    "compositing-axes-exchanged": [
        (CENTRES, "(index // width).astype(dtype), (index % width).astype(dtype)")
    ],
    "compositing-half-pixel": [
        (CENTRES, "(index % width + 0.5).astype(dtype), (index // width + 0.5).astype(dtype)")
    ],
    "compositing-flipped": seen("[::-1]"),
    "compositing-mirrored": seen("[:, ::-1]"),
    "compositing-opacity-for-transmittance": [
        (SHOWN, SHOWN.replace("T.reshape", "(1 - T).reshape")),
        (GIVEN_T, "-transmittance_bar.reshape(-1)"),
    ],
    "compositing-no-half": [
        (
            "power = -0.5 * (a * e_x**2 + c * e_y**2) - b",
            "power = -(a * e_x**2 + c * e_y**2) - 2 * b",
        ),
        (LOG_BAR, 'V *= 2 * inputs["alpha"][order, None]  '),
    ],
    "compositing-off-diagonal-once": [
        ("c * e_y**2) - b * e_x", "c * e_y**2) - 0.5 * b * e_x"),
        (
            "V * (a * e_x + b * e_y), V * (b * e_x + c * e_y)",
            "V * (a * e_x + b * e_y / 2), V * (b / 2 * e_x + c * e_y)",
        ),
        (FACTORS, "np.array([-0.5, -0.5, -0.5], dtype)"),
    ],
    "compositing-off-diagonal-gradient": [(FACTORS, "np.array([-0.5, -0.5, -0.5], dtype)")],
    "compositing-no-alpha-clamp": [("alpha_max=0.99):", "alpha_max=np.inf):")],
    "compositing-other-alpha-clamp": [("alpha_max=0.99):", "alpha_max=0.999):")],
    "compositing-own-alpha": [
        (WEIGHTS, "w = A * (1 - A) * _transmittances(A, T[pixels]) if occlusion else A"),
        (
            COLOR_BAR,
            'own = 1 - A if inputs["occlusion"] else 1\n        color_bar += (A * own * before) @ g[pixels]',
        ),
        (
            LAYERS,
            "value = V[i].copy()\n                V[i] = (1 - 2 * A[i]) * value - behind\n"
            "                behind = (1 - A[i]) * (A[i] * value + behind)",
        ),
    ],
    "compositing-faint-skipped": skipping("A < 1 / 255"),
    "compositing-early-stop": skipping('(np.cumprod(1 - A, axis=0) < 1e-4) & inputs["occlusion"]'),
    "compositing-clamp-gradient": [(UNCLAMPED, "pass")],
    "compositing-no-gradient-through-transmittance": [(LAYERS, "pass")],
}

PATCHES = {
    "splatting/covariance.py": COVARIANCE,
    "splatting/projection.py": PROJECTION,
    "splatting/compositing.py": COMPOSITING,
}
