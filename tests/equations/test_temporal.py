"""Eqs. (5) and (6): what no vector shows: no gradient of x, effects that are off, as printed."""

import numpy as np

from p4dgs_ref.equations import deformed


def test_deformed_passes_what_is_off_through_untouched():
    x, s, r = np.ones((5, 3)), np.ones((5, 3)), np.full((5, 4), 2.0)
    off = np.zeros((5, 0))
    (x_t, s_t, r_t), _ = deformed.forward(x, s, r, np.ones((5, 3)), off, off)
    assert s_t is s and r_t is r
    assert np.array_equal(x_t, np.full((5, 3), 2.0))
