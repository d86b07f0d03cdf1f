"""Known mistakes in compositing: order, transmittance, background, and where pixels are."""

import numpy as np

from p4dgs_ref.splatting.compositing import depth_order
from tests.golden.mistakes.kit import bars_of, known, no_gradient, port, surgery


# --- the reference on other inputs --------------------------------------------------------------
def given_as(**changes):
    """Other inputs or settings that receive no gradient: name -> f(inputs)."""
    return dict(inputs=lambda given: {**given, **{name: f(given) for name, f in changes.items()}})


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


def opaque_background(given, cotangents):
    """C + background: the transmittance does not weaken it."""
    black = {**given, "background": 0 * given["background"]}
    out, bars = port("compositing")(black, cotangents)
    image_bar = cotangents["image_bar"]
    return {**out, "image": out["image"] + given["background"]}, {
        **bars,
        "background": image_bar.sum(axis=(0, 1)),
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
    surgery(
        "compositing",
        "compositing-opaque-background",
        "the background is added unattenuated, without T_N",
        opaque_background,
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
def composed(cut=lambda A: A, own_alpha=False, clamp_passes=False, through_T=True):
    """`run` of a whole compositing, in which one thing can differ.

    cut(A)              alphas (M, P) of which some are set to zero
    own_alpha           a splat's own alpha already weakens it
    clamp_passes        the clamp at 0.99 lets the gradient through
    through_T           False: no gradient of alpha through the transmittances of what lies behind
    """

    def run(given, cotangents):
        order, shape = (
            depth_order(given["depth"], given["visible"], True),
            (given["height"], given["width"]),
        )
        mean, conic, alpha, color = (
            given[name][order] for name in ("mean2d", "conic", "alpha", "color")
        )
        y, x = np.indices(shape).astype(mean.dtype).reshape(2, 1, -1)
        e_x, e_y, (a, b, c) = x - mean[:, :1], y - mean[:, 1:], conic.T[:, :, None]
        falloff = np.exp(-0.5 * (a * e_x**2 + 2 * b * e_x * e_y + c * e_y**2))
        raw = alpha[:, None] * falloff
        occlusion, alpha_max = given.get("occlusion", True), given.get("alpha_max", 0.99)
        clamped = np.minimum(raw, alpha_max)
        A = (
            cut(clamped) if occlusion or cut is not stopped else clamped
        )  # without occlusion no pixel fills up
        own = own_alpha and occlusion
        after = np.cumprod(1 - A, axis=0) if occlusion else np.ones_like(A)
        start = np.ones((1, x.size), mean.dtype)
        before, T = (
            np.concatenate([start, after[:-1]])[: len(A)],
            (after[-1] if len(A) else start[0]),
        )
        weight = A * before * (1 - A if own else 1)
        out = {
            "image": (weight.T @ color + T[:, None] * given["background"]).reshape(*shape, 3),
            "transmittance": T.reshape(shape),
        }
        bars = bars_of(cotangents)
        g, h = bars["image"].reshape(-1, 3), bars["transmittance"].reshape(-1)
        value = color @ g.T
        A_bar, T_bar = value * before * (1 - 2 * A if own else 1), g @ given["background"] + h
        if occlusion and through_T:
            for i in reversed(range(len(A))):
                A_bar[i] -= before[i] * T_bar
                T_bar = T_bar * (1 - A[i]) + value[i] * A[i] * (1 - A[i] if own else 1)
        if not clamp_passes:
            A_bar = A_bar * (raw <= alpha_max)
        A_bar = A_bar * (A == clamped)  # what was cut has no slope
        rows = {"alpha": (A_bar * falloff).sum(axis=1), "color": weight @ g}
        log_bar = A_bar * raw
        rows["mean2d"] = np.stack(
            [
                (log_bar * (a * e_x + b * e_y)).sum(axis=1),
                (log_bar * (b * e_x + c * e_y)).sum(axis=1),
            ],
            axis=1,
        )
        rows["conic"] = -np.stack(
            [
                (log_bar * e_x**2).sum(axis=1) / 2,
                (log_bar * e_x * e_y).sum(axis=1),
                (log_bar * e_y**2).sum(axis=1) / 2,
            ],
            axis=1,
        )
        in_bar = {name: np.zeros_like(given[name]) for name in rows}
        for name, bar in rows.items():
            in_bar[name][order] = bar
        return out, {**in_bar, "background": T @ g}

    return run


def faint(A):
    return np.where(A < 1 / 255, 0, A)


def stopped(A):
    return np.where(np.cumprod(1 - A, axis=0) < 1e-4, 0, A)


SUM = [
    surgery(
        "compositing",
        "compositing-own-alpha",
        "a splat's transmittance already contains its own alpha",
        composed(own_alpha=True),
    ),
    surgery(
        "compositing",
        "compositing-faint-skipped",
        "alphas below 1/255 are skipped, as in the published kernel",
        composed(faint),
    ),
    surgery(
        "compositing",
        "compositing-early-stop",
        "a pixel is finished where T would pass 1e-4, as in the published kernel",
        composed(stopped),
    ),
    surgery(
        "compositing",
        "compositing-clamp-gradient",
        "the clamp of alpha at 0.99 lets the gradient through",
        composed(clamp_passes=True),
    ),
    surgery(
        "compositing",
        "compositing-no-gradient-through-transmittance",
        "alpha receives no gradient through what lies behind it",
        composed(through_T=False),
    ),
]

MISTAKES = [*OTHER_INPUTS, *SUM]
