"""What the tutorials share: checks of gradients, and exercises that check themselves."""

import numpy as np
import pytest

from p4dgs_ref.equations import offsets
from p4dgs_ref.school import lessons


@pytest.fixture(autouse=True)
def results(monkeypatch):
    monkeypatch.setattr(lessons, "RESULTS", {})


def right_backward(inputs, cotangents):
    _, saved = offsets.forward(**inputs)
    return offsets.backward(saved, **cotangents)


def test_moved_and_inner_follow_lists_and_dictionaries():
    rng = np.random.default_rng(1)
    values = {"x": np.ones((2, 3)), "weights": [np.zeros(4), np.ones((2, 2))], "L": 3}
    directions = lessons.random_like(rng, {name: values[name] for name in ("x", "weights")})
    moved = lessons.moved(values, directions, 2.0)
    assert moved["L"] == 3
    assert np.array_equal(moved["x"], 1 + 2 * directions["x"])
    assert np.array_equal(moved["weights"][0], 2 * directions["weights"][0])
    product = sum((np.asarray(a) ** 2).sum() for a in (directions["x"], *directions["weights"]))
    assert np.isclose(lessons.inner(directions, directions), product)


def test_close_is_relative_to_the_largest_number():
    assert lessons.close([1e6, 1e-9], [1e6, 0])
    assert not lessons.close([1.0, 1e-9], [1.0, 0])
    assert lessons.close([1.0, 1e-9], [1.0, 0], 1e-8)
    assert lessons.close([0.0], [0.0]) and not lessons.close([1e-300], [0.0])
    assert not lessons.close([np.nan], [1.0])


@pytest.mark.parametrize(
    "mine, said",
    [
        (..., "no answer yet"),
        (None, "no answer yet"),
        ([1, 2], "solved"),
        ([1, 2.00001], "not solved: off by 1e-05, expected 6 right digits"),
        (3, "not solved: shape (), expected (2,)"),
        ("two", "not solved: expected a number"),
    ],
)
def test_numbers(mine, said, capsys):
    assert lessons.number("01.1", mine, [1, 2]) is None  # a notebook would print a value
    assert lessons.RESULTS == {"01.1": said == "solved"}
    assert said in capsys.readouterr().out


def unwritten(**inputs):
    raise NotImplementedError


@pytest.mark.parametrize(
    "mine, said",
    [
        (lambda x_a, O_a, l_a: x_a[:, None] + O_a * l_a[:, None], "exercise 01.2: solved"),
        (lambda **inputs: {"x": offsets.forward(**inputs)[0]}, "exercise 01.2: solved"),
        (unwritten, "not solved: no answer yet"),
        (lambda x_a, O_a, l_a: x_a[:, None] + O_a, "case offsets/ordinary: out.x["),
        (lambda x_a, O_a, l_a: x_a, "case offsets/ordinary: out.x: (5, 3), expected (5, 4, 3)"),
        (lambda x_a, O_a, l_a: 1 / 0, "case offsets/ordinary: ZeroDivisionError"),
    ],
)
def test_forwards(mine, said, capsys):
    assert lessons.forward("01.2", mine, "offsets") is None
    assert said in capsys.readouterr().out


def test_backwards(capsys):
    def without_sum(inputs, cotangents):
        return {**right_backward(inputs, cotangents), "x_a": cotangents["x_bar"][:, -1]}

    def one_missing(inputs, cotangents):
        gradients = right_backward(inputs, cotangents)
        return {name: gradients[name] for name in ("x_a", "O_a")}

    def solved(mine, *wanted):
        assert lessons.backward("01.3", mine, "offsets", *wanted) is None
        return lessons.RESULTS["01.3"]

    assert solved(right_backward)
    assert not solved(without_sum)
    assert solved(without_sum, "O_a", "l_a")
    assert not solved(one_missing)
    assert "in_bar.l_a: expected float64" in capsys.readouterr().out
