"""SSIM and Eq. (16): the window, and the images where careless formulas fail."""

import numpy as np
import pytest

from p4dgs_ref.equations import ssim, window

# Smaller and larger than the window, and across one, two and three blocks of `blur`.
SHAPES = [(9, 7, 2), (1, 1, 1), (1, 12, 3), (4, 33, 1), (50, 37, 1)]


def pair(shape, dtype=np.float64, seed=0):
    """A noisy image and its truth."""
    rng = np.random.default_rng(seed)
    truth = rng.random(shape)
    return (truth + 0.3 * rng.normal(size=shape)).astype(dtype), truth.astype(dtype)


@pytest.mark.parametrize("shape", SHAPES)
def test_blur_is_its_own_adjoint(shape):
    a, b = (p.transpose(0, 2, 1) for p in pair(shape))
    terms = window.blur(a) * b
    assert abs(terms.sum() - (a * window.blur(b)).sum()) <= 1e-14 * np.abs(terms).sum()


def test_float32_on_flat_bright_images():
    """E[x**2] - mu**2 in float32 is off by more than the variance here; SSIM must not be."""
    rng = np.random.default_rng(3)
    y = (0.9 + 1e-5 * rng.normal(size=(20, 17, 1))).astype(np.float32)
    x = (y + np.float32(1e-4) * rng.normal(size=y.shape)).astype(np.float32)
    naive, variance = (x * x).mean() - x.mean() ** 2, x.astype(float).var()
    assert abs(naive - variance) > variance
    single, saved_single = ssim.forward(x, y)
    double, saved_double = ssim.forward(x.astype(float), y.astype(float))
    assert abs(single - double) <= 1e-7
    got = ssim.backward(saved_single, np.float32(1))["image"]
    want = ssim.backward(saved_double, 1.0)["image"]
    assert got.dtype == np.float32 and np.abs(got - want).max() <= 1e-6 * np.abs(want).max()
