r"""Support: front-to-back alpha compositing, the exact twin: every Gaussian at every pixel, nothing skipped.

.. math:: C(p) = \sum_i c_i \alpha_i(p) T_i(p) + T_N(p)\,c_{bg}, \quad T_i = \prod_{j<i} (1 - \alpha_j), \quad
    \alpha_i(p) = \min\left(0.99,\ \alpha_i e^{-\frac12 (p-\mu_i)^T K_i (p-\mu_i)}\right)
"""

from typing import NamedTuple

import numpy as np

from ..equations.equation import Case, declare

BLOCK = 1 << 20  # Gaussian-pixel pairs held at once: bounds the memory of the exact twin


class Out(NamedTuple):
    image: np.ndarray  # (H, W, 3)
    transmittance: np.ndarray  # (H, W) what the background still shows through


class Res(NamedTuple):
    inputs: (
        dict  # the untouched inputs; the exact twin recomputes instead of remembering N H W numbers
    )
    order: np.ndarray  # visible rows front to back


def depth_order(depth, visible):
    """Visible rows sorted by depth; equal depths stay in order of index (N,) -> (M,)."""
    rows = np.flatnonzero(visible)
    return rows[np.argsort(depth[rows], kind="stable")]


def forward(
    mean2d,
    conic,
    alpha,
    color,
    depth,
    visible,
    background,
    height,
    width,
    occlusion=True,
    alpha_max=0.99,
):
    """Composite splats over a background.

    Shapes     mean2d (N, 2), conic (N, 3), alpha (N,), color (N, 3), depth (N,), visible (N,), background (3,)
               -> image (height, width, 3), transmittance (height, width)
    Units      mean2d: pixels, centres at integers; conic: 1/pixel^2; alpha, color: dimensionless
    Domain     finite, alpha in [0, 1], conic positive definite; depth decides the order only, ties by index
    Raises     nothing
    Gradient   mean2d, conic, alpha, color, background; 0 where alpha is clamped at alpha_max; none through the order
    Choice     Q21 `exact` keeps the 0.99 clamp; without `occlusion` splats add up and T = 1 everywhere
    Reference  Kerbl et al. 2023, Eq. (3); Porter and Duff 1984 for the front-to-back sum
    """
    inputs = dict(
        mean2d=mean2d,
        conic=conic,
        alpha=alpha,
        color=color,
        background=background,
        occlusion=occlusion,
        alpha_max=alpha_max,
        height=height,
        width=width,
    )
    order = depth_order(depth, visible)
    image = np.empty((height * width, 3), mean2d.dtype)
    T = np.ones(height * width, mean2d.dtype)
    for pixels, x, y in _blocks(height, width, len(order), mean2d.dtype):
        A = _alphas(inputs, order, x, y)[0]
        w = A * _transmittances(A, T[pixels]) if occlusion else A
        image[pixels] = w.T @ color[order] + T[pixels, None] * background
    return Out(image.reshape(height, width, 3), T.reshape(height, width)), Res(inputs, order)


def _blocks(height, width, n, dtype):
    """Runs of pixels, row by row, with their coordinates, small enough that n times a run fits BLOCK."""
    size = max(1, BLOCK // max(n, 1))
    for start in range(0, height * width, size):
        index = np.arange(start, min(start + size, height * width))
        yield (
            slice(index[0], index[-1] + 1),
            (index % width).astype(dtype),
            (index // width).astype(dtype),
        )


def _alphas(inputs, order, x, y):
    """Clamped opacities of the ordered Gaussians at some pixels (M, P), the falloff, and the offsets to the means."""
    e_x, e_y = x - inputs["mean2d"][order, :1], y - inputs["mean2d"][order, 1:]
    a, b, c = inputs["conic"][order].T[:, :, None]
    power = -0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y
    falloff = np.exp(
        np.minimum(power, 0, out=power)
    )  # above 0 only by rounding, far along a needle
    return (
        np.minimum(inputs["alpha"][order, None] * falloff, inputs["alpha_max"]),
        falloff,
        e_x,
        e_y,
    )


def _transmittances(A, T):
    """T before each Gaussian (M, P); T, all ones on entry, is left as what remains behind the last."""
    before = np.empty_like(A)
    for i, alpha in enumerate(A):
        before[i] = T
        T *= 1 - alpha
    return before


def backward(res, image_bar=None, transmittance_bar=None):
    inputs, order = res.inputs, res.order
    height, width, color = inputs["height"], inputs["width"], inputs["color"][order]
    dtype, M = inputs["mean2d"].dtype, len(order)
    g = np.zeros((height * width, 3), dtype) if image_bar is None else image_bar.reshape(-1, 3)
    h = (
        np.zeros(height * width, dtype)
        if transmittance_bar is None
        else transmittance_bar.reshape(-1)
    )
    color_bar, per = np.zeros((M, 3), dtype), np.zeros((M, 6), dtype)
    background_bar = np.zeros(3, dtype)
    for pixels, x, y in _blocks(height, width, M, dtype):
        A, falloff, e_x, e_y = _alphas(inputs, order, x, y)
        T = np.ones(len(x), dtype)
        before = _transmittances(A, T) if inputs["occlusion"] else np.ones_like(A)
        color_bar += (A * before) @ g[pixels]
        background_bar += T @ g[pixels]
        V = color @ g[pixels].T  # what pixel p gains per unit of weight of Gaussian i
        if inputs["occlusion"]:
            # behind = value seen through layer i; dL/dalpha_i = T_i (v_i - behind): no division by 1 - alpha
            behind = g[pixels] @ inputs["background"] + h[pixels]
            for i in reversed(range(M)):
                V[i] -= behind
                behind += A[i] * V[i]
        V *= before * falloff  # gradient of alpha_i times its falloff, where not clamped
        V *= inputs["alpha"][order, None] * falloff <= inputs["alpha_max"]
        per[:, 0] += V.sum(axis=1)
        V *= inputs["alpha"][order, None]  # from here the gradient of log alpha_i(p)
        a, b, c = inputs["conic"][order].T[:, :, None]
        terms = (
            V * (a * e_x + b * e_y),
            V * (b * e_x + c * e_y),
            V * e_x**2,
            V * e_x * e_y,
            V * e_y**2,
        )
        per[:, 1:] += np.stack([term.sum(axis=1) for term in terms], axis=1)
    rows = {
        "mean2d": per[:, 1:3],
        "conic": per[:, 3:] * np.array([-0.5, -1, -0.5], dtype),
        "alpha": per[:, 0],
        "color": color_bar,
    }
    gradients = {name: np.zeros_like(inputs[name]) for name in rows}
    for name, values in rows.items():
        gradients[name][order] = values
    return {**gradients, "background": background_bar}


def random_splats(rng, n, height, width, sigma=(1.5, 4.0), alpha=(0.05, 0.9)):
    """Splats of the given size in pixels, spread over an image: for cases, tests and the benchmark."""
    angle, radii = rng.uniform(0, np.pi, n), rng.uniform(*sigma, size=(2, n))
    c, s, (p, q) = np.cos(angle), np.sin(angle), radii**-2.0
    conic = np.stack([c * c * p + s * s * q, c * s * (p - q), s * s * p + c * c * q], axis=1)
    return dict(
        mean2d=rng.uniform(-0.5, 0.5, (n, 2)) * (width, height)
        + ((width - 1) / 2, (height - 1) / 2),
        conic=conic,
        alpha=rng.uniform(*alpha, size=n),
        color=rng.uniform(size=(n, 3)),
        depth=rng.uniform(1, 5, size=n),
        visible=np.ones(n, bool),
    )


def cases():
    rng = np.random.default_rng(33)
    view = dict(background=np.array([0.9, 0.5, 0.2]), height=5, width=6, occlusion=True)
    splats = random_splats(rng, 7, 5, 6)
    yield Case("ordinary", dict(**splats, **view))
    yield Case("no_occlusion", dict(**splats, **{**view, "occlusion": False}), ("off",))
    hidden = {**splats, "visible": np.arange(7) % 3 > 0}
    yield Case("culled_rows", dict(**hidden, **view), ("behind",))
    yield Case(
        "no_gaussians",
        dict(**{name: a[:0] for name, a in splats.items()}, **view),
        ("empty",),
        expected={
            "image": np.broadcast_to(view["background"], (5, 6, 3)),
            "transmittance": np.ones((5, 6)),
        },
    )
    one = {name: a[:1] for name, a in splats.items()}
    yield Case("one_pixel", dict(**one, **{**view, "height": 1, "width": 1}), ("single",))
    flat = dict(
        mean2d=np.zeros((2, 2)),
        conic=np.zeros((2, 3)),
        alpha=np.array([0.5, 0.25]),
        color=np.eye(3)[:2],
        depth=np.ones(2),
        visible=np.ones(2, bool),
        background=np.zeros(3),
        height=1,
        width=1,
    )
    yield Case("equal_depths", flat, ("order",), expected={"image": np.array([[[0.5, 0.125, 0]]])})
    limit = {
        **{name: a[:1] for name, a in flat.items() if name in splats},
        "alpha": np.array([0.75]),
        "color": np.array([[1.0, 0.5, 0.25]]),
    }  # on the end of the clamp the gradient is that of the inside
    yield Case(
        "on_the_clamp",
        dict(
            **limit,
            **{name: flat[name] for name in ("background", "height", "width")},
            alpha_max=0.75,
        ),
        ("kink", "clamped"),
        smooth=False,
        cotangents={"image_bar": np.array([[[1.0, 2.0, -4.0]]])},
        expected={
            "image": 0.75 * limit["color"][None],
            "alpha_bar": np.ones(1),
            "color_bar": 0.75 * np.array([[1.0, 2.0, -4.0]]),
        },
    )
    n = 200  # alpha 0.99 each: the second layer shows 1 %, the third 1e-4
    wall = dict(
        mean2d=np.zeros((n, 2)),
        conic=np.zeros((n, 3)),
        alpha=np.ones(n),
        color=np.ones((n, 3)),
        depth=np.arange(1.0, n + 1),
        visible=np.ones(n, bool),
        background=np.zeros(3),
        height=1,
        width=1,
    )
    yield Case(
        "opaque_wall",
        wall,
        ("opaque", "clamped"),
        smooth=False,
        cotangents={"image_bar": np.array([[[1.0, 2.0, -4.0]]])},
        expected={
            "image": np.ones((1, 1, 3)),
            "alpha_bar": np.zeros(n),
            "color_bar": 0.99 * 0.01 ** np.arange(n)[:, None] * np.array([1.0, 2.0, -4.0]),
        },
    )


compositing = declare(
    "compositing",
    "",
    "C = sum_i c_i alpha_i T_i + T_N background",
    {
        "mean2d": "N 2",
        "conic": "N 3",
        "alpha": "N",
        "color": "N 3",
        "depth": "N",
        "visible": "N",
        "background": "3",
        "height": "",
        "width": "",
        "occlusion": "",
        "image": "H W 3",
        "transmittance": "H W",
    },
    ("mean2d", "conic", "alpha", "color", "background"),
    forward,
    backward,
    cases,
)
