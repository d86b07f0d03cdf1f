"""Known mistakes written into the encoding and Eqs. (5) and (6): {file: {id: [(old text, new text), ...]}}."""

ANGLES, POWERS = "powers = (1 << np.arange(L))", "powers = (1 << np.arange(res.L))"
WAVES, BOTH = "E[D:].reshape(L, 2, D, N)", "a.T[D:].reshape(res.L, 2, D, N)"
SLOPES = "waves[:, 1] * waves_bar[:, 0] - waves[:, 0] * waves_bar[:, 1]"


def frequencies(text):
    """Other powers in forward and backward."""
    return [
        (ANGLES, f"powers = ({text.format(L='L')})"),
        (POWERS, f"powers = ({text.format(L='res.L')})"),
    ]


def layout(shape, axes):
    """The waves stored as `shape` and seen as (L, 2, D, N)."""
    return [
        (WAVES, f"E[D:].reshape({shape.format(L='L')}).transpose{axes}"),
        (BOTH, f"a.T[D:].reshape({shape.format(L='res.L')}).transpose{axes}"),
    ]


ENCODING = {
    "encoding-pi": frequencies("np.pi * 2.0**np.arange({L})"),
    "encoding-degrees": frequencies("np.deg2rad(2.0**np.arange({L}))"),
    "encoding-from-one": frequencies("2 << np.arange({L})"),
    "encoding-linear": frequencies("np.arange(1, {L} + 1)"),
    "encoding-gradient-frequency": [(POWERS, "powers = np.ones(res.L)")],
    "encoding-gradient-sign": [(SLOPES, SLOPES.replace(" - ", " + "))],
    "encoding-no-raw": [
        ("return Out(E.T)", "return Out(E.T[:, D:])"),
        ("E_bar[:, :D] + np.tensordot", "np.tensordot"),
    ],
    "encoding-raw-last": [
        ("E[:D] = p.T", "E[2 * L * D:] = p.T"),
        (WAVES, "E[:2 * L * D].reshape(L, 2, D, N)"),
        (BOTH, "a.T[:2 * res.L * D].reshape(res.L, 2, D, N)"),
        ("E_bar[:, :D] + np.tensordot", "E_bar[:, 2 * res.L * D:] + np.tensordot"),
    ],
    "encoding-interleaved": layout("{L}, D, 2, N", (0, 2, 1, 3)),
    "encoding-by-coordinate": layout("D, {L}, 2, N", (1, 2, 0, 3)),
    "encoding-sines-first": layout("2, {L}, D, N", (1, 0, 2, 3)),
    "encoding-cosines-first": [
        ("out=waves[:, 0])", "out=waves[:, -1])"),
        ("out=waves[:, 1])", "out=waves[:, 0])"),
        (SLOPES, "waves[:, 0] * waves_bar[:, 1] - waves[:, 1] * waves_bar[:, 0]"),
    ],
}

SPLIT = "return Out(*np.split(y.y, np.cumsum(widths[:2]), axis=1))"
DEFORMATION = {
    "deformation-time-first": [
        (
            "[first[:columns], *rest], [bias + (E_t @ first[columns:])[0]",
            "[first[-columns:], *rest], [bias + (E_t @ first[:E_t.shape[1]])[0]",
        ),
        (
            "[weights_bar[0], np.outer(res.E_t, biases_bar[0])]",
            "[np.outer(res.E_t, biases_bar[0]), weights_bar[0]]",
        ),
    ],
    "deformation-heads-swapped": [
        (
            SPLIT,
            "delta_s, delta_x, delta_r = np.split(y.y, np.cumsum(widths[:2]), axis=1)\n"
            "    return Out(delta_x, delta_s, delta_r)",
        ),
        (
            "zip((delta_x_bar, delta_s_bar, delta_r_bar), res.widths)",
            "zip((delta_s_bar, delta_x_bar, delta_r_bar), res.widths)",
        ),
    ],
    "deformation-heads-relu": [
        (
            SPLIT,
            "positive = y.y > 0\n    return Out(*np.split(positive * y.y, np.cumsum(widths[:2]), axis=1))",
        ),
        ("Res(res_x, E_t, res, widths)", "Res(res_x, E_t, res, [*widths, positive])"),
        (
            "mlp.backward(res.mlp, np.concatenate(bars, axis=1), needs_x)",
            "mlp.backward(res.mlp, np.concatenate(bars, axis=1) * res.widths[3], needs_x)",
        ),
    ],
    "deformation-heads-no-bias": [
        ("np.concatenate(biases[-3:])", "np.zeros_like(np.concatenate(biases[-3:]))"),
        ("np.split(biases_bar[-1], cuts)", "np.split(np.zeros_like(biases_bar[-1]), cuts)"),
    ],
    "deformation-identity-added": [(SPLIT, "if widths[2]:\n        y.y[:, -4] += 1\n    " + SPLIT)],
    "deformation-no-gradient-of-x": [
        ('positional_encoding.backward(res.E_x, gradients["x"])["p"]', "np.zeros((N, 3), dtype)")
    ],
}

NORMALISE, BACK = (
    "r_t, norm = normalise(r_t)",
    "r_bar = normalise_backward(res.r_t, res.norm, r_bar)",
)
KEPT, UNPACK = "return Out(x_t, s_t, r_t), Res(r_t, norm, widths)", "n_x, n_s, n_r = res.widths\n"
HAMILTON = """

def hamilton(a, b):
    w, v, z, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return np.concatenate([w * z - (v * u).sum(axis=1, keepdims=True), w * u + z * v + np.cross(v, u)], axis=1)


def conjugate(a):
    return np.concatenate([a[:, :1], -a[:, 1:]], axis=1)


def forward("""


def keeping(values, forward, backward):
    """An edit of forward, `values` put aside for backward as `kept`, and an edit there."""
    return [
        (KEPT, f"widths.append({values})\n    {forward}\n    {KEPT}"),
        (UNPACK, f"n_x, n_s, n_r, kept = res.widths\n    {backward}\n"),
    ]


DEFORMED = {
    "deformed-not-normalised": [(NORMALISE, "pass")],
    "deformed-delta-normalised": [
        ("(r, delta_r)))", "(r, normalise(delta_r)[0] if delta_r.shape[1] else delta_r)))"),
        *keeping(
            "normalise(delta_r) if widths[2] else None",
            "pass",
            "delta_r_bar = normalise_backward(*kept, r_bar) if n_r else r_bar[:, :0]",
        ),
        ('"delta_r": r_bar[:, :n_r]', '"delta_r": delta_r_bar'),
    ],
    "deformed-product": [
        ("\n\ndef forward(", HAMILTON),
        (NORMALISE, "r_t, norm = normalise(hamilton(delta_r, r))"),
        *keeping(
            "(r, delta_r)",
            "pass",
            "r_bar, delta_r_bar = (hamilton(conjugate(kept[1]), r_bar), hamilton(r_bar, conjugate(kept[0]))) "
            "if n_r else (r_bar, r_bar[:, :0])",
        ),
        ('"delta_r": r_bar[:, :n_r]', '"delta_r": delta_r_bar'),
    ],
    "deformed-gradient-not-normalised": [(BACK, "pass")],
    "deformed-log-scale": [
        *keeping(
            "(s, np.exp(delta_s))",
            "s_t = s * np.exp(delta_s) if widths[1] else s",
            "delta_s_bar = s_bar * kept[0] * kept[1] if n_s else s_bar[:, :0]\n"
            "    s_bar = s_bar * kept[1] if n_s else s_bar",
        ),
        ('"delta_s": s_bar[:, :n_s]', '"delta_s": delta_s_bar'),
    ],
    "deformed-clamped-scale": keeping(
        "s_t > 0",
        "s_t = np.where(s_t > 0, s_t, 0) if widths[1] else s_t",
        "s_bar = np.where(kept, s_bar, 0) if n_s else s_bar",
    ),
    "deformed-position-scaled": [
        *keeping(
            "(s, delta_x)",
            "x_t = x + delta_x * s if widths[0] else x",
            "delta_x_bar = x_bar * kept[0] if n_x else x_bar[:, :0]\n"
            "    s_plus = s_bar + x_bar * kept[1] if n_x else s_bar",
        ),
        ('"s": s_bar,', '"s": s_plus,'),
        ('"delta_x": x_bar[:, :n_x]', '"delta_x": delta_x_bar'),
    ],
}

PATCHES = {
    "equations/positional_encoding.py": ENCODING,
    "equations/deformation.py": DEFORMATION,
    "equations/deformed.py": DEFORMED,
}
