"""Known mistakes in compositing: order, transmittance, background, and where pixels are."""

import numpy as np

from tests.workshop.mistakes.kit import edited, given_as, known, no_gradient


# --- the reference on other inputs --------------------------------------------------------------
def both_axes(change, change_bar):
    """Another mean2d and conic: the same function of both."""
    return dict(
        inputs={"mean2d": change, "conic": change},
        inputs_bar={name: lambda bar, _: change_bar(bar) for name in ("mean2d", "conic")},
    )


def reversed_axes(a):
    return a[:, ::-1]


PER_SPLAT = ("mean2d", "conic", "alpha", "color", "depth", "visible")


def last_first(tree, *_):
    """All splats in reverse order of their index: equal depths are taken the other way round."""
    return {name: a[::-1] if name in PER_SPLAT else a for name, a in tree.items()}


def conic_times(*factors):
    def scale(a, *_):
        return a * np.array(factors, a.dtype)

    return dict(inputs={"conic": scale}, inputs_bar={"conic": scale})


def flipped(name, f):
    return dict(outputs={n: f for n in name}, outputs_bar={n: lambda bar, _: f(bar) for n in name})


def premultiplied(given):
    return {**given, "color": given["color"] * given["alpha"][:, None]}


def premultiplied_bar(bars, given):
    return {
        **bars,
        "color": bars["color"] * given["alpha"][:, None],
        "alpha": bars["alpha"] + (bars["color"] * given["color"]).sum(axis=1),
    }


OTHER_INPUTS = [
    known(
        "compositing",
        "compositing-back-to-front",
        "the depth sort is reversed: the farthest Gaussian lies on top",
        **given_as(depth=lambda given: -given["depth"]),
    ),
    known(
        "compositing",
        "compositing-not-sorted",
        "the Gaussians are not sorted by depth",
        **given_as(depth=lambda given: 0 * given["depth"]),
    ),
    known(
        "compositing",
        "compositing-ties-reversed",
        "equal depths are taken in descending order of index",
        inputs=last_first,
        inputs_bar=last_first,
    ),
    known(
        "compositing",
        "compositing-culled-drawn",
        "culled rows are drawn: `visible` is ignored",
        **given_as(visible=lambda given: np.ones_like(given["visible"])),
    ),
    known(
        "compositing",
        "compositing-always-occludes",
        "the setting `occlusion` is ignored",
        **given_as(occlusion=lambda given: True),
    ),
    known(
        "compositing",
        "compositing-no-background",
        "the background is left out",
        inputs={"background": np.zeros_like},
        inputs_bar={"background": no_gradient},
    ),
    known(
        "compositing",
        "compositing-background-twice",
        "the background is added once too often",
        inputs={"background": lambda b: 2 * b},
        inputs_bar={"background": lambda bar, _: 2 * bar},
    ),
    edited(
        "compositing",
        "compositing-opaque-background",
        "the background is added unattenuated, without T_N",
        {
            "T_N[:, None] * background": "background",
            "T_N @ g[pixels]": "g[pixels].sum(axis=0)",
            "g[pixels] @ background + T_N_bar[pixels]": "T_N_bar[pixels]",
        },
    ),
    known(
        "compositing",
        "compositing-premultiplied",
        "colours are multiplied by alpha once too often",
        inputs=premultiplied,
        inputs_bar=premultiplied_bar,
    ),
    known(
        "compositing",
        "compositing-bgr",
        "the channels of the splats are blue, green, red",
        inputs={"color": reversed_axes},
        inputs_bar={"color": lambda bar, _: bar[:, ::-1]},
    ),
    known(
        "compositing",
        "compositing-axes-exchanged",
        "x and y are exchanged: pixels are read as (row, column)",
        **both_axes(reversed_axes, reversed_axes),
    ),
    known(
        "compositing",
        "compositing-half-pixel",
        "pixel centres are at half integers",
        inputs={"mean2d": lambda mean: mean - mean.dtype.type(0.5)},
    ),
    known(
        "compositing",
        "compositing-flipped",
        "the image's rows run from bottom to top",
        **flipped(("image", "transmittance"), lambda a: a[::-1]),
    ),
    known(
        "compositing",
        "compositing-mirrored",
        "the image's columns run from right to left",
        **flipped(("image", "transmittance"), lambda a: a[:, ::-1]),
    ),
    known(
        "compositing",
        "compositing-opacity-for-transmittance",
        "the transmittance is shown as 1 - T_N, the opacity",
        outputs={"transmittance": lambda T: 1 - T},
        outputs_bar={"transmittance": lambda bar, _: -bar},
    ),
    known(
        "compositing", "compositing-no-half", "the exponent lacks its 1/2", **conic_times(2, 2, 2)
    ),
    known(
        "compositing",
        "compositing-off-diagonal-once",
        "the exponent counts the conic's off-diagonal entry once",
        **conic_times(1, 0.5, 1),
    ),
    known(
        "compositing",
        "compositing-off-diagonal-gradient",
        "the gradient of the conic's off-diagonal entry has the factor -1/2 instead of -1",
        inputs_bar={"conic": lambda bar, _: bar * np.array([1, 0.5, 1], bar.dtype)},
    ),
    known(
        "compositing",
        "compositing-no-alpha-clamp",
        "alpha is not clamped at 0.99",
        **given_as(alpha_max=lambda given: np.inf),
    ),
    known(
        "compositing",
        "compositing-other-alpha-clamp",
        "alpha is clamped at 0.999 instead of 0.99",
        **given_as(alpha_max=lambda given: 0.999),
    ),
]


# --- the sum itself -----------------------------------------------------------------------------


SUM = [
    edited(
        "compositing",
        "compositing-own-alpha",
        "a splat's transmittance already contains its own alpha",
        {
            "before[i] = T": "before[i] = T * (1 - alpha)",
            "V[i] -= behind": (
                "V[i], behind = ((1 - 2 * A[i]) * V[i] - behind) / (1 - A[i]), (1 - A[i]) * "
                "(A[i] * V[i] + behind)"
            ),
            "behind += A[i] * V[i]": "pass",
        },
    ),
    edited(
        "compositing",
        "compositing-faint-skipped",
        "alphas below 1/255 are skipped, as in the published kernel",
        {
            "falloff = np.exp(np.minimum(power, 0))": (
                "falloff = np.exp(power) * ((alpha[:, None] * np.exp(power) >= 1 / 255) | "
                "(alpha[:, None] == 0))"
            )
        },
    ),
    edited(
        "compositing",
        "compositing-exponent-not-clamped",
        "the exponent is not clamped at 0: far along a needle rounding makes it positive",
        {"np.exp(np.minimum(power, 0))": "np.exp(power)"},
    ),
    edited(
        "compositing",
        "compositing-positive-skipped",
        "a splat whose exponent is above 0 is skipped, as in the published kernel",
        {"np.exp(np.minimum(power, 0))": "np.exp(power) * (power <= 0)"},
    ),
    edited(
        "compositing",
        "compositing-early-stop",
        "a pixel is finished where T would pass 1e-4, as in the published kernel",
        {
            "enumerate(A)": "enumerate(np.multiply(A, np.cumprod(1 - A, axis=0) >= 1e-4, out=A))",
            "alpha[:, None] * falloff <= alpha_max": (
                "(alpha[:, None] * falloff <= alpha_max) & ((A > 0) | (alpha[:, None] == 0))"
            ),
        },
    ),
    edited(
        "compositing",
        "compositing-clamp-gradient",
        "the clamp of alpha at 0.99 lets the gradient through",
        {"alpha[:, None] * falloff <= alpha_max": "1"},
    ),
    edited(
        "compositing",
        "compositing-background-detached",
        "alpha receives no gradient through the background's T_N",
        {"g[pixels] @ background + T_N_bar[pixels]": "T_N_bar[pixels]"},
    ),
    edited(
        "compositing",
        "compositing-opacity-clamp",
        "the opacity itself is clamped at 0.99, not its product with the falloff",
        {
            "return np.minimum(alpha[:, None] * falloff, alpha_max), falloff": (
                "return np.minimum(alpha, alpha_max)[:, None] * falloff, falloff"
            ),
            "V *= alpha[:, None] * falloff <= alpha_max": "pass",
            "V.sum(axis=1)\n": "V.sum(axis=1) * (alpha <= alpha_max)\n",
            "V *= alpha[:, None]  #": "V *= np.minimum(alpha, alpha_max)[:, None]  #",
        },
    ),
    edited(
        "compositing",
        "compositing-no-gradient-through-transmittance",
        "alpha receives no gradient through what lies behind it",
        {"V[i] -= behind": "pass"},
    ),
]

MISTAKES = [*OTHER_INPUTS, *SUM]
