"""Adam by hand, with numbers that a person can check.

The corrected moments of Kingma and Ba are weighted means of all gradients so far, and of their
squares. A step back weighs 0.9 times as much in the first mean, and 0.999 times in the second.
"""

import numpy as np
import pytest

from p4dgs_ref.training.parameters import Adam, Parameters

RATE = 0.1


def moves(*steps):
    """The moves of two arrays of one number in each step (gradients of both, rate of the second).

    The learning rate of the first array is RATE.
    """
    p, g = (Parameters({"first": np.zeros(1), "late": np.zeros(1)}, np.float64) for _ in "pg")
    adam, seen = Adam(p), []
    for *gradients, rate in steps:
        before = p.vector.copy()
        g.vector[...] = gradients
        adam.step(p, g, {"first": RATE, "late": rate}.get)
        seen.append(p.vector - before)
    return np.transpose(seen)


def test_the_first_step_moves_by_the_learning_rate():
    """The means of one gradient are 2 and 4, and 2 / sqrt(4) = 1: both moments are corrected."""
    (move,), _ = moves((2.0, 0.0, 0.0))
    assert move == pytest.approx(-RATE, rel=1e-6), "bias correction of Adam's first step"


def test_beta_1_is_a_tenth_below_one():
    """From 2 and -2: the means are (0.9 * 2 - 2) / 1.9 = -0.2 / 1.9 and 4, whatever BETA_2 is."""
    (_, second), _ = moves((2.0, 0.0, 0.0), (-2.0, 0.0, 0.0))
    assert second == pytest.approx(RATE * 0.1 / 1.9, rel=1e-6), "BETA_1 of Adam: expected 0.9"


def test_beta_2_is_a_thousandth_below_one():
    """From 2 and -1: the means are (0.9 * 2 - 1) / 1.9 = 0.8 / 1.9 and (0.999 * 4 + 1) / 1.999."""
    (_, second), _ = moves((2.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    expected = -RATE * (0.8 / 1.9) / (4.996 / 1.999) ** 0.5
    assert second == pytest.approx(expected, rel=1e-6), "BETA_2 of Adam: expected 0.999"


def test_epsilon_halves_the_step_of_a_gradient_that_is_as_small():
    """The second moment is 0.001 * 1e-27; its root is 1e-15, as much as is added to it."""
    (move,), _ = moves((1e-27**0.5, 0.0, 0.0))
    assert move == pytest.approx(-RATE / 2, rel=1e-12), "EPSILON of Adam: expected 1e-15"


def test_an_array_that_joins_later_counts_its_own_steps():
    """In the second step of the others it makes its first, which moves by its learning rate."""
    _, late = moves((2.0, 0.0, 0.0), (-1.0, 5.0, 0.01))
    assert late == pytest.approx([0, -0.01], rel=1e-12), "the array joins in the second step"
