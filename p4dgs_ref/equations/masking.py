r"""Section 3.2, after Eq. (4): only Gaussians that are opaque enough go on to be rendered.

.. math:: \text{keep } (a, j) \text{ where } \alpha_{a,j} \ge \tau_\alpha
"""

from typing import NamedTuple

import numpy as np

from .equation import Case, declare


class Out(NamedTuple):
    alpha: np.ndarray  # (N,)
    x: np.ndarray  # (N, 3)
    color: np.ndarray  # (N, 3)
    s: np.ndarray  # (N, 3)
    r: np.ndarray  # (N, 4)
    index: np.ndarray  # (N,) int64, ascending: a k + j of what is kept


class Res(NamedTuple):
    index: np.ndarray  # (N,)
    shape: tuple  # (A, k)
    dtype: np.dtype  # of the zeros that fill up the gradients


def forward(alpha, mask, tau_alpha, x, color, s, r):
    """Gather the Gaussians worth rendering, from children of anchors to one flat list.

    Shapes     alpha, mask (A, k), tau_alpha scalar, x, color, s (A, k, 3), r (A, k, 4)
               -> alpha (N,), x, color, s (N, 3), r (N, 4), index (N,)
    Units      alpha, tau_alpha: opacity; the attributes pass unchanged; index: a k + j
    Domain     all reals; mask bool, False for children masked for good; N may be zero
    Raises     nothing
    Gradient   alpha, x, color, s, r: scattered back, zero where dropped; what is kept is a step, with gradient 0
    Choice     the paper drops alpha < tau_alpha, so equality is kept (Scaffold-GS drops it); Q15: mask
    Reference  P-4DGS section 3.2, the paragraph after Eq. (4)
    """
    index = np.flatnonzero(mask & (alpha >= tau_alpha))
    kept = [a.reshape(alpha.size, a.shape[2])[index] for a in (x, color, s, r)]
    return Out(alpha.reshape(-1)[index], *kept, index), Res(index, alpha.shape, alpha.dtype)


def backward(res, alpha_bar=None, x_bar=None, color_bar=None, s_bar=None, r_bar=None):
    def scatter(kept_bar, *width):
        full_bar = np.zeros((res.shape[0] * res.shape[1], *width), dtype=res.dtype)
        if kept_bar is not None:
            full_bar[res.index] = kept_bar  # no index occurs twice, so nothing needs adding up
        return full_bar.reshape(*res.shape, *width)

    return {
        "alpha": scatter(alpha_bar),
        "x": scatter(x_bar, 3),
        "color": scatter(color_bar, 3),
        "s": scatter(s_bar, 3),
        "r": scatter(r_bar, 4),
    }


def cases():
    rng = np.random.default_rng(5)
    A, k = 6, 5
    alpha = rng.uniform(0.1, 0.9, size=(A, k)) * rng.choice([-1, 1], size=(A, k))
    inputs = dict(
        alpha=alpha,
        mask=rng.random((A, k)) < 0.8,
        tau_alpha=0.0,
        x=rng.normal(size=(A, k, 3)),
        color=rng.random((A, k, 3)),
        s=rng.random((A, k, 3)),
        r=rng.normal(size=(A, k, 4)),
    )
    yield Case("ordinary", inputs)
    yield Case("all_masked", {**inputs, "mask": np.zeros((A, k), bool)}, ("masked", "empty"))
    yield Case(
        "all_kept",
        {**inputs, "mask": np.ones((A, k), bool), "tau_alpha": -1.0},
        ("negative",),
        expected={
            "index": np.arange(A * k),
            "alpha": alpha.ravel(),
            "r": inputs["r"].reshape(-1, 4),
        },
    )
    yield Case(
        "no_anchor", {n: a if n == "tau_alpha" else a[:0] for n, a in inputs.items()}, ("empty",)
    )
    # by hand: the 2nd child is exactly on the threshold, the 3rd below, the 4th masked
    child = np.arange(4.0).reshape(1, 4, 1)
    yield Case(
        "at_the_threshold",
        dict(
            alpha=np.array([[0.5, 0.25, 0.125, 0.75]]),
            mask=np.array([[True, True, True, False]]),
            tau_alpha=0.25,
            x=child + np.zeros(3),
            color=child + np.ones(3),
            s=child + np.ones(3),
            r=child + np.ones(4),
        ),
        ("kink", "masked"),
        smooth=False,
        cotangents={
            "alpha_bar": np.array([2.0, -3.0]),
            "x_bar": np.array([[1.0, 2, 3], [-4, 5, 6]]),
        },
        expected={
            "alpha": np.array([0.5, 0.25]),
            "x": np.array([[0.0, 0, 0], [1, 1, 1]]),
            "index": np.array([0, 1]),
            "alpha_bar": np.array([[2.0, -3, 0, 0]]),
            "x_bar": np.array([[[1.0, 2, 3], [-4, 5, 6], [0, 0, 0], [0, 0, 0]]]),
            "color_bar": np.zeros((1, 4, 3)),
            "s_bar": np.zeros((1, 4, 3)),
            "r_bar": np.zeros((1, 4, 4)),
        },
    )


masking = declare(
    "masking",
    "",
    "keep where mask and alpha >= tau_alpha",
    {
        "alpha": "A k -> N",
        "mask": "A k",
        "tau_alpha": "",
        "x": "A k 3 -> N 3",
        "color": "A k 3 -> N 3",
        "s": "A k 3 -> N 3",
        "r": "A k 4 -> N 4",
        "index": "N",
    },
    ("alpha", "x", "color", "s", "r"),
    forward,
    backward,
    cases,
)
