"""Known mistakes written into Eqs. (1) to (4), masking and the networks: {file: {id: [(old text, new text), ...]}}."""

HAC_ROWS = """

def split_view(gradients, d):
    x_bar = gradients.pop("x")
    last = x_bar.shape[1] - (x_bar.shape[1] > d)
    return {"f_a": x_bar[:, :d], "d_vc": x_bar[:, d:last], "delta_vc": x_bar[:, last:], **gradients}
"""
HAC = [
    (
        "np.concatenate([f_a, delta_vc, d_vc], axis=1)",
        "np.concatenate([f_a, d_vc, delta_vc], axis=1)",
    )
]
HAC_ORDER = [
    *HAC,
    ("import split_view, view_inputs, without_view", "import view_inputs, without_view" + HAC_ROWS),
]

OFFSETS = {
    "offsets-not-scaled": [
        ("+ O_a * l_a[:, None, :])", "+ O_a)"),
        ("x_bar * res.l_a[:, None, :]", "x_bar.copy()"),
        ("(x_bar * res.O_a).sum(axis=1)", "0 * res.l_a"),
    ],
    "offsets-log-reach": [
        ("O_a * l_a[:, None, :]", "O_a * np.exp(l_a)[:, None, :]"),
        ("x_bar * res.l_a[:, None, :]", "x_bar * np.exp(res.l_a)[:, None, :]"),
        ("(x_bar * res.O_a).sum(axis=1)", "(x_bar * res.O_a).sum(axis=1) * np.exp(res.l_a)"),
    ],
    "offsets-one-reach": [
        ("O_a * l_a[:, None, :]", "O_a * l_a[:, None, :1]"),
        ("x_bar * res.l_a[:, None, :]", "x_bar * res.l_a[:, None, :1]"),
        (
            "(x_bar * res.O_a).sum(axis=1)",
            "np.einsum('aki,aki->a', x_bar, res.O_a)[:, None] * np.eye(3, dtype=x_bar.dtype)[0]",
        ),
    ],
    "offsets-coordinate-major": [
        (
            "    return Out(x_a",
            "    O_a = O_a.reshape(len(O_a), 3, O_a.shape[1]).transpose(0, 2, 1)\n    return Out(x_a",
        ),
        (
            "x_bar * res.l_a[:, None, :]",
            "(x_bar * res.l_a[:, None, :]).transpose(0, 2, 1).reshape(x_bar.shape)",
        ),
    ],
    "offsets-no-anchor": [
        ("x_a[:, None, :] + O_a", "O_a"),
        ("x_bar.sum(axis=1),  ", "0 * x_bar[:, 0],  "),
    ],
    "offsets-mean-gradient": [("x_bar.sum(axis=1),  ", "x_bar.mean(axis=1),  ")],
    "offsets-log-gradient": [
        ("(x_bar * res.O_a).sum(axis=1)", "(x_bar * res.O_a).sum(axis=1) * res.l_a")
    ],
}

VIEW = {
    "view-toward-camera": [
        ("return Out(delta_vc, d_vc)", "return Out(delta_vc, -d_vc)"),
        ("across(res.d_vc, d_vc_bar)", "across(res.d_vc, -d_vc_bar)"),
    ],
    "view-squared-distance": [
        ("return Out(delta_vc, d_vc)", "return Out(delta_vc * delta_vc, d_vc)"),
        (
            "x_a_bar += res.d_vc * delta_vc_bar",
            "x_a_bar += 2 * res.d_vc * res.delta_vc * delta_vc_bar",
        ),
    ],
    "view-epsilon": [
        ("return Out(delta_vc, d_vc)", "return Out(delta_vc, v / (delta_vc + 1e-6))"),
        (
            "aside = across(res.d_vc, d_vc_bar)",
            "soft = res.delta_vc + 1e-6\n"
            "        aside = across(res.d_vc, d_vc_bar) * res.delta_vc / soft\n"
            "        aside += res.d_vc * (res.d_vc * d_vc_bar).sum(axis=1, keepdims=True) * res.delta_vc / soft * 1e-6 / soft",
        ),
    ],
    "view-radial-gradient": [
        (
            "aside = across(res.d_vc, d_vc_bar)",
            "aside = d_vc_bar * (res.d_vc**2).sum(axis=1, keepdims=True)",
        )
    ],
}

OPACITY = {
    "opacity-sigmoid": [
        ("alpha = np.tanh(y.y)", "alpha = 1 / (1 + np.exp(-y.y))"),
        ("alpha_bar * res.slope", "alpha_bar * res.alpha * (1 - res.alpha)"),
    ],
    "opacity-linear": [
        ("alpha = np.tanh(y.y)", "alpha = y.y"),
        ("alpha_bar * res.slope", "alpha_bar.copy()"),
    ],
    "opacity-positive": [
        ("alpha = np.tanh(y.y)", "alpha = np.maximum(np.tanh(y.y), 0)"),
        ("alpha_bar * res.slope", "alpha_bar * (1 - res.alpha**2) * (res.alpha > 0)"),
    ],
    "opacity-slope": [("alpha_bar * res.slope", "alpha_bar * (1 - res.alpha)")],
    "opacity-hac-order": [
        *HAC,
        (
            '"delta_vc": x_bar[:, d:d + 1], "d_vc": x_bar[:, d + 1:]',
            '"delta_vc": x_bar[:, d + 3:], "d_vc": x_bar[:, d:d + 3]',
        ),
    ],
    "opacity-view-first": [
        (
            "np.concatenate([f_a, delta_vc, d_vc], axis=1)",
            "np.concatenate([delta_vc, d_vc, f_a], axis=1)",
        ),
        (
            '{"f_a": x_bar[:, :d], "delta_vc": x_bar[:, d:d + 1], "d_vc": x_bar[:, d + 1:]',
            '{"f_a": x_bar[:, -d:], "delta_vc": x_bar[:, :-d][:, :1], "d_vc": x_bar[:, :-d][:, 1:]',
        ),
    ],
}

# a port that keeps other rows than the cotangents are made for reads what there is
AS_MANY = (
    "full_bar[res.index] = kept_bar",
    "n = min(len(kept_bar), len(res.index))\n            full_bar[res.index[:n]] = kept_bar[:n]",
)
MASKING = {
    "masking-strict": [("mask & (alpha >= tau_alpha)", "mask & (alpha > tau_alpha)"), AS_MANY],
    "masking-mask-ignored": [("mask & (alpha >= tau_alpha)", "alpha >= tau_alpha"), AS_MANY],
    "masking-threshold-ignored": [("mask & (alpha >= tau_alpha)", "mask"), AS_MANY],
    "masking-child-major": [
        (
            "index = np.flatnonzero(mask & (alpha >= tau_alpha))",
            "child, anchor = np.nonzero((mask & (alpha >= tau_alpha)).T)\n    index = anchor * alpha.shape[1] + child",
        ),
        ("*kept, index), Res(", "*kept, child * len(alpha) + anchor), Res("),
    ],
    "masking-gradient-packed": [
        ("full_bar[res.index] = kept_bar", "full_bar[:len(kept_bar)] = kept_bar")
    ],
}

COLOR = {
    "color-tanh": [
        ("return Out(color)", "color = np.tanh(y.y).reshape(color.shape)\n    return Out(color)"),
        ("color * rest", "1 - color**2"),
    ],
    "color-linear": [
        ("return Out(color)", "color = y.y.reshape(color.shape)\n    return Out(color)"),
        ("color * rest", "np.ones_like(color)"),
    ],
    "color-slope": [("color * rest", "color")],
    "color-bgr": [
        ("return Out(color)", "return Out(color[:, :, ::-1])"),
        ("color_bar * res.slope", "color_bar[:, :, ::-1] * res.slope"),
    ],
    "color-eight-bits": [("return Out(color)", "return Out(np.round(255 * color) / 255)")],
    "color-channel-major": [
        (".reshape(A, width // 3, 3)", ".reshape(A, 3, width // 3).transpose(0, 2, 1)"),
        ("(color_bar * res.slope).reshape", "(color_bar * res.slope).transpose(0, 2, 1).reshape"),
    ],
    "color-hac-order": HAC_ORDER,
}

ROTATION = {
    "rotation-real-last": [
        ("return Out(r)", "return Out(np.roll(r, -1, axis=2))"),
        ("res.norm, r_bar)", "res.norm, np.roll(r_bar, 1, axis=2))"),
    ],
    "rotation-not-normalised": [
        (
            "r, norm = normalise(y.y.reshape(A, width // 4, 4))",
            "r, norm = y.y.reshape(A, width // 4, 4), None",
        ),
        ("normalise_backward(res.r, res.norm, r_bar)", "r_bar"),
    ],
    "rotation-gradient-not-normalised": [("normalise_backward(res.r, res.norm, r_bar)", "r_bar")],
    "rotation-gradient-constant-norm": [
        ("normalise_backward(res.r, res.norm, r_bar)", "r_bar / res.norm")
    ],
    "rotation-positive-real": [
        ("return Out(r)", "return Out(np.where(r[:, :, :1] < 0, -r, r))"),
        ("res.norm, r_bar)", "res.norm, np.where(res.r[:, :, :1] < 0, -r_bar, r_bar))"),
    ],
    "rotation-component-major": [
        ("y.y.reshape(A, width // 4, 4)", "y.y.reshape(A, 4, width // 4).transpose(0, 2, 1)"),
        ("y_bar.reshape(A, 4 * k)", "y_bar.transpose(0, 2, 1).reshape(A, 4 * k)"),
    ],
    "rotation-hac-order": HAC_ORDER,
}

SCALE = {
    "scale-exp": [
        (
            "return Out(s_a[:, None, :] * fraction)",
            "fraction, rest = np.exp(y.y).reshape(fraction.shape), 1\n    return Out(s_a[:, None, :] * fraction)",
        )
    ],
    "scale-tanh": [
        (
            "return Out(s_a[:, None, :] * fraction)",
            "fraction = np.tanh(y.y).reshape(fraction.shape)\n    return Out(s_a[:, None, :] * fraction)",
        ),
        ("fraction * rest,", "1 - fraction**2,"),
    ],
    "scale-added": [
        ("s_a[:, None, :] * fraction)", "s_a[:, None, :] + fraction)"),
        ("s_bar * res.s_a[:, None, :] * res.slope", "s_bar * res.slope"),
        ("(s_bar * res.fraction).sum(axis=1)", "s_bar.sum(axis=1)"),
    ],
    "scale-log": [
        ("s_a[:, None, :] * fraction)", "np.exp(s_a)[:, None, :] * fraction)"),
        ("res.s_a[:, None, :] * res.slope", "np.exp(res.s_a)[:, None, :] * res.slope"),
        (
            "(s_bar * res.fraction).sum(axis=1)",
            "np.exp(res.s_a) * (s_bar * res.fraction).sum(axis=1)",
        ),
    ],
    "scale-no-anchor": [
        ("Out(s_a[:, None, :] * fraction)", "Out(fraction)"),
        ("s_bar * res.s_a[:, None, :] * res.slope", "s_bar * res.slope"),
        ("(s_bar * res.fraction).sum(axis=1)", "np.zeros_like(res.s_a)"),
    ],
    "scale-log-gradient": [
        ("(s_bar * res.fraction).sum(axis=1)", "res.s_a * (s_bar * res.fraction).sum(axis=1)")
    ],
    "scale-axis-major": [
        (".reshape(A, width // 3, 3)", ".reshape(A, 3, width // 3).transpose(0, 2, 1)"),
        ("y_bar.reshape(A, 3 * k)", "y_bar.transpose(0, 2, 1).reshape(A, 3 * k)"),
    ],
    "scale-hac-order": HAC_ORDER,
}

RELU, LETS = "inputs.append(np.maximum(hidden, 0, out=hidden))", "y_bar *= res.inputs[i] > 0"
LAST = "return Out(inputs[-1] @ weights[-1] + biases[-1]), Res(inputs, weights)"
GRADIENTS = '{"weights": weights_bar, "biases": biases_bar}'
MLP = {
    "mlp-no-relu": [(RELU, "inputs.append(hidden)"), (LETS, "pass")],
    "mlp-last-relu": [
        (
            LAST,
            "inputs.append(np.maximum(inputs[-1] @ weights[-1] + biases[-1], 0))\n"
            "    return Out(inputs[-1]), Res(inputs, weights)",
        ),
        (
            "    weights_bar, biases_bar = [",
            "    y_bar = np.where(res.inputs[-1] > 0, y_bar, 0)\n    weights_bar, biases_bar = [",
        ),
    ],
    "mlp-leaky-relu": [
        (RELU, "inputs.append(np.maximum(hidden, 0.01 * hidden))"),
        (LETS, "y_bar *= np.where(res.inputs[i] > 0, 1, 0.01)"),
    ],
    "mlp-relu-gradient": [(LETS, "pass")],
    "mlp-kink": [
        (RELU, "inputs.append(np.where(hidden < 0, -0.0, hidden))"),
        (LETS, "y_bar *= ~np.signbit(res.inputs[i])"),
    ],
    "mlp-no-bias": [
        ("        hidden += b\n", ""),
        ("inputs[-1] @ weights[-1] + biases[-1]", "inputs[-1] @ weights[-1]"),
        ("y_bar.sum(axis=0)", "np.zeros_like(y_bar, shape=y_bar.shape[1])"),
    ],
    "mlp-column-major": [
        (
            "    inputs = [x]",
            "    weights = [W.ravel().reshape(W.shape, order='F') for W in weights]\n    inputs = [x]",
        ),
        (
            GRADIENTS,
            '{"weights": [W.ravel(order="F").reshape(W.shape) for W in weights_bar], "biases": biases_bar}',
        ),
    ],
    "mlp-mean-gradient": [
        ("res.inputs[i].T @ y_bar", "res.inputs[i].T @ y_bar / len(y_bar)"),
        ("y_bar.sum(axis=0)", "y_bar.mean(axis=0)"),
    ],
}

PATCHES = {
    "equations/offsets.py": OFFSETS,
    "equations/view.py": VIEW,
    "equations/opacity.py": OPACITY,
    "equations/masking.py": MASKING,
    "equations/color.py": COLOR,
    "equations/rotation.py": ROTATION,
    "equations/scale.py": SCALE,
    "equations/mlp.py": MLP,
}
