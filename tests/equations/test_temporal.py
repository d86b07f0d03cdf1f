"""Eqs. (5) and (6): what no vector shows: effects that are off, the highest frequencies."""

import numpy as np

from p4dgs_ref.equations import deformed, positional_encoding


def test_deformed_passes_what_is_off_through_untouched():
    x, s, r = np.ones((5, 3)), np.ones((5, 3)), np.full((5, 4), 2.0)
    off = np.zeros((5, 0))
    (x_t, s_t, r_t), _ = deformed.forward(x, s, r, np.ones((5, 3)), off, off)
    assert s_t is s and r_t is r
    assert np.array_equal(x_t, np.full((5, 3), 2.0))


def test_the_highest_frequency_that_a_file_may_ask_for_has_its_sign():
    E, _ = positional_encoding.forward(np.ones((1, 1)), 64)
    assert E[0, -2] == np.sin(2.0**63) > 0
