"""SSIM and Eq. (16) against slow twins, and on the images where careless formulas fail."""

import math

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from p4dgs_ref.equations import render_loss, ssim, window

C1, C2 = 1e-4, 9e-4
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])
SHAPES = [
    (9, 7, 2),
    (1, 1, 1),
    (1, 12, 3),
    (4, 33, 1),
    (50, 37, 1),
]  # below, across and beyond a block


def pair(shape, dtype=np.float64, seed=0):
    rng = np.random.default_rng(seed)
    truth = rng.random(shape)
    return (truth + 0.3 * rng.normal(size=shape)).astype(dtype), truth.astype(dtype)


def taps():
    tap = [math.exp(-i * i / 4.5) for i in range(-5, 6)]
    return [t / math.fsum(tap) for t in tap]


def slow_ssim(x, y):
    """Pixel by pixel, window by window, with centred second moments where the window lies inside the image."""
    H, W, C = x.shape
    tap, total = taps(), []
    for c in range(C):
        for i in range(H):
            for j in range(W):
                near = [
                    (
                        tap[u] * tap[v],
                        float(x[i + u - 5, j + v - 5, c]),
                        float(y[i + u - 5, j + v - 5, c]),
                    )
                    for u in range(11)
                    for v in range(11)
                    if 0 <= i + u - 5 < H and 0 <= j + v - 5 < W
                ]
                mx, my = (math.fsum(t[0] * t[k] for t in near) for k in (1, 2))
                out = 1 - math.fsum(t[0] for t in near)  # weight of the zeros around the image
                xx, yy, xy = (
                    math.fsum(
                        [
                            *(
                                w * (a - ma) * (b - mb)
                                for w, a, b in ((t[0], t[k], t[m]) for t in near)
                            ),
                            out * ma * mb,
                        ]
                    )
                    for k, m, ma, mb in ((1, 1, mx, mx), (2, 2, my, my), (1, 2, mx, my))
                )
                total.append(
                    (2 * mx * my + C1) * (2 * xy + C2) / ((mx**2 + my**2 + C1) * (xx + yy + C2))
                )
    return math.fsum(total) / len(total)


def filtered_ssim(x, y):
    """The textbook formula on scipy's filters."""

    def blur(a):
        return correlate1d(
            correlate1d(a, taps(), axis=0, mode="constant"), taps(), axis=1, mode="constant"
        )

    x, y = x.astype(float), y.astype(float)
    mx, my = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return ((2 * mx * my + C1) * (2 * xy + C2) / ((mx**2 + my**2 + C1) * (xx + yy + C2))).mean()


@BOTH
@pytest.mark.parametrize("shape", SHAPES[:4])
def test_against_a_direct_double_loop(shape, dtype):
    x, y = pair(shape, dtype)
    assert ssim.forward(x, y)[0].ssim == pytest.approx(
        slow_ssim(x, y), rel=1e-13 if dtype == np.float64 else 1e-7
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_against_scipy_filters(shape):
    x, y = pair(shape)
    assert ssim.forward(x, y)[0].ssim == pytest.approx(filtered_ssim(x, y), rel=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_blur_is_its_own_adjoint(shape):
    a, b = (p.transpose(0, 2, 1) for p in pair(shape))
    terms = window.blur(a) * b
    assert abs(terms.sum() - (a * window.blur(b)).sum()) <= 1e-14 * np.abs(terms).sum()


@BOTH
@pytest.mark.parametrize(
    "make",
    [np.zeros_like, np.ones_like, lambda y: np.full_like(y, 0.9), lambda y: y],
    ids=["black", "white", "grey", "noise"],
)
@pytest.mark.parametrize("shape", SHAPES)
def test_identical_images(shape, make, dtype):
    y = make(pair(shape, dtype)[1])
    for truth_moments in (None, ssim.moments(y)):
        out, res = ssim.forward(y.copy(), y, truth_moments)
        assert abs(out.ssim - 1) <= 1e-12
        assert not ssim.backward(res, -0.7)["image"].any()


def test_moments_at_hand_change_nothing():
    x, y = pair((13, 6, 3))
    for module, extra in ((ssim, ()), (render_loss, (0.2,))):
        out, res = module.forward(x, y, *extra)
        again, res_again = module.forward(x, y, *extra, truth_moments=ssim.moments(y))
        assert out == again
        assert np.array_equal(
            module.backward(res, 1.3)["image"], module.backward(res_again, 1.3)["image"]
        )


def test_float32_on_flat_bright_images():
    """Where E[x^2] - mu^2 in float32 is off by more than the variance: value and gradient are the float64 ones."""
    rng = np.random.default_rng(3)
    y = (0.9 + 1e-5 * rng.normal(size=(20, 17, 1))).astype(np.float32)
    x = (y + np.float32(1e-4) * rng.normal(size=y.shape)).astype(np.float32)
    (single, res_single), (double, res_double) = (
        ssim.forward(x, y),
        ssim.forward(x.astype(float), y.astype(float)),
    )
    naive = (x * x).mean() - x.mean() ** 2
    assert abs(naive - x.astype(float).var()) > x.astype(float).var()
    assert abs(single.ssim - double.ssim) <= 1e-7
    got, want = (
        ssim.backward(res_single, np.float32(1))["image"],
        ssim.backward(res_double, 1.0)["image"],
    )
    assert got.dtype == np.float32 and np.abs(got - want).max() <= 1e-6 * np.abs(want).max()


def test_one_minus_ssim_of_nearly_equal_images():
    """1 - SSIM keeps its digits: with e = x - y it shrinks as e^2, far below the rounding of 1."""
    x, y = pair((12, 9, 2))
    losses = []
    for size in (1e-3, 1e-6):
        _, res = ssim.forward(y + size * (x - y), y)
        losses.append(np.mean(res.luminance + res.structure - res.luminance * res.structure))
    assert losses[1] / losses[0] == pytest.approx(1e-6, rel=1e-2) and losses[1] < 1e-10


def test_ssim_is_symmetric_in_its_images_and_falls_with_noise():
    x, y = pair((21, 18, 3))
    assert ssim.forward(x, y)[0].ssim == pytest.approx(ssim.forward(y, x)[0].ssim, rel=1e-13)
    values = [ssim.forward(y + size * (x - y), y)[0].ssim for size in (0, 0.1, 0.5, 1, 4)]
    assert values == sorted(values, reverse=True) and values[-1] < 0.3


@BOTH
def test_render_loss_against_its_parts(dtype):
    x, y = pair((9, 7, 2), dtype)
    out, res = render_loss.forward(x, y, 0.2)
    L1 = math.fsum(abs(float(a) - float(b)) for a, b in zip(x.ravel(), y.ravel())) / x.size
    want = (0.8 * L1 + 0.2 * (1 - slow_ssim(x, y)), L1, 1 - slow_ssim(x, y))
    assert out == pytest.approx(want, rel=1e-12 if dtype == np.float64 else 1e-6)
    assert all(value.dtype == dtype for value in out)
    gradient = render_loss.backward(res, L_render_bar=dtype(3))["image"]
    parts = render_loss.backward(res, L1_bar=dtype(2.4), D_SSIM_bar=dtype(0.6))["image"]
    assert gradient.dtype == dtype and gradient.flags.c_contiguous
    assert np.abs(gradient - parts).max() <= 4 * np.finfo(dtype).eps * np.abs(gradient).max()
