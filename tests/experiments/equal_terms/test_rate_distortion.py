"""BD-rate in closed form, and the reasons where there is none."""

import numpy as np
import pytest

from p4dgs_ref.lab.writer import bd_rate, bytes_at, front

SIZES, PSNR = np.array([100.0, 200.0, 400.0, 800.0]), np.array([30.0, 32.0, 33.0, 33.5])


def points(sizes, psnr):
    return list(zip(sizes, psnr))


def test_a_constant_factor_is_the_bd_rate():
    curve = points(SIZES, PSNR)
    assert bd_rate(curve, curve) == (pytest.approx(0, abs=1e-9), None)
    assert bd_rate(points(2 * SIZES, PSNR), curve) == (pytest.approx(100), None)
    assert bd_rate(curve, points(2 * SIZES, PSNR)) == (pytest.approx(-50), None)


def test_straight_lines_over_a_part_of_the_range():
    # log bytes a + b PSNR; the mean difference is that in the middle of the common range
    one, other = np.linspace(30, 34, 5), np.linspace(31, 36, 6)
    rate, reason = bd_rate(points(np.exp(0.5 * one), one), points(np.exp(0.4 * other), other))
    assert reason is None
    assert rate == pytest.approx(100 * (np.exp(0.1 * 32.5) - 1))


def test_reasons():
    curve = points(SIZES, PSNR)
    rate, reason = bd_rate(curve, curve[:2])
    assert rate is None and "4 and 2 points" in reason
    rate, reason = bd_rate(curve, points(SIZES, PSNR + 3))
    assert rate is None and "30.00 to 33.50 dB and 33.00 to 36.50 dB" in reason
    worse = [*curve, (500.0, 31.0), (900.0, 33.5)]
    assert np.array_equal(front(worse), curve)


def test_bytes_between_two_points():
    curve = points(SIZES, PSNR)
    assert bytes_at(curve, 32.5) == pytest.approx(np.sqrt(200 * 400))
    assert bytes_at(curve, 30.0) == pytest.approx(100)
    assert np.isnan(bytes_at(curve, 34.0))
