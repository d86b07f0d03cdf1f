"""The formulas of Eq. (11) that the study compares, where they are known to fail."""

import numpy as np
import pytest

from p4dgs_ref.equations import likelihood
from p4dgs_ref.lab.accuracy import formulas


def test_the_floor_of_hac_limits_the_bits_and_stops_the_gradient():
    one = np.ones((1, 3))
    bits, saved = formulas.hac(np.array([[4.0, 5.5, 9.0]]), 0 * one, one, one)
    assert bits[0] == pytest.approx([12.0909, 19.9316, 19.9316], abs=1e-4)
    slopes = likelihood.backward(saved, one)
    assert slopes["f_noisy"][0, 0] > 5
    # Values in the tail are never pulled back.
    assert not any(slope[0, 1:].any() for slope in slopes.values())
