"""What the tutorials share: checks of gradients, and exercises that check themselves."""

import re

import numpy as np
import pytest

from p4dgs_ref import EQUATIONS, lessons, oracle
from p4dgs_ref.equations import mlp, offsets


@pytest.fixture(autouse=True)
def results(monkeypatch):
    monkeypatch.setattr(lessons, "RESULTS", {})


def right_backward(inputs, cotangents):
    _, saved = offsets.forward(**inputs)
    return offsets.backward(saved, **cotangents)


def test_close_is_relative_to_the_largest_number():
    assert lessons.close([1e6, 1e-9], [1e6, 0])
    assert not lessons.close([1.0, 1e-9], [1.0, 0])
    assert lessons.close([1.0, 1e-9], [1.0, 0], 1e-8)
    assert lessons.close([0.0], [0.0]) and not lessons.close([1e-300], [0.0])
    assert not lessons.close([np.nan], [1.0])


@pytest.mark.parametrize(
    "mine, message",
    [
        (..., 'exercise 01.1: not solved: no answer yet\n  lessons.hint("01.1") gives a hint\n'),
        ([1, 2], "exercise 01.1: solved\n"),
        ([1, 2.00001], "not solved: nearly right, but 6 right digits are expected"),
        ([-2, -4], "not solved: all 2 numbers are -2 times the right ones"),
        ([0, 0], "not solved: all 2 numbers are 0 times the right ones"),
        ([57.3, 114.6], "not solved: all 2 numbers are 57.3 times the right ones"),
        ([1, -2], "not solved: 1 of 2 numbers have the wrong sign"),
        ([1, 5], "1 of 2 numbers are wrong; the first, [1]: it is wrong: its sign is right, its"),
        ([-1, 6], "2 of 2 numbers are wrong; the first, [0]: it is -1 times the right number"),
        ([1, -np.inf], "not solved: [1] is -inf\n"),
        (3, "not solved: shape [], expected [2]; [] means a single number"),
        ("two", "not solved: expected a number"),
    ],
)
def test_numbers(mine, message, capsys):
    assert lessons.check_number("01.1", mine, [1.0, 2.0]) is None  # a notebook would print a value
    assert lessons.RESULTS == {"01.1": mine == [1, 2]}
    assert message in capsys.readouterr().out


@pytest.mark.parametrize(
    "mine, message",
    [
        (7, "solved"),
        (-7, "it is -1 times the right number"),
        (14, "it is 2 times the right number"),
        (7.001, "it is wrong: its sign is right, its magnitude too large"),
        (56, "it is 8 times the right number"),
        (0.07, "it is 0.01 times the right number"),
        (9, "it is wrong: its sign is right, its magnitude too large"),
        (-6, "it is wrong: its sign is wrong, its magnitude too small"),
        (float("nan"), "not solved: it is nan\n"),
        (10**400, "not solved: expected a number\n"),
    ],
)
def test_short_answers_are_stored_and_not_given_away(mine, message, capsys):
    lessons.check_number("21.1", mine)
    printed = capsys.readouterr().out
    assert message in printed
    assert message == "solved" or "7" not in printed.replace("21.1", "")


@pytest.mark.parametrize(
    "exercise, mine, message",
    [
        ("25.1", 768, "not solved: the biases are missing\n"),
        ("25.1", 773, "its sign is right, its magnitude too large\n"),
        ("20.1", 2400, "not solved: the box is missing\n"),
        ("22.1", [567, 629], "not solved: slot 9 is read as A's where A has only slots 0 to 8\n"),
        ("26.1", 6, "it is 2 times the right number"),
        (
            "26.2",
            3393264,
            "not solved: 3393264 times the prime is beyond 2^53, but even, so a double holds it\n",
        ),
        ("26.2", 3393266, "its sign is right, its magnitude too large\n"),
    ],
)
def test_a_whole_number_is_right_or_wrong(exercise, mine, message, capsys):
    lessons.check_number(exercise, mine)
    assert message in capsys.readouterr().out


def test_a_typical_wrong_answer_is_told_what_it_forgets(capsys):
    """In most exercises with a stored answer; three digits are enough."""
    asked, told = lessons.read_stored("answers"), lessons.read_stored("mistakes")
    assert told.keys() < asked.keys() and len(told) >= 35
    for exercise, rows in told.items():
        for wrong, reason in rows:
            lessons.check_number(exercise, wrong)
            assert f": not solved: {reason}\n" in capsys.readouterr().out, (exercise, wrong)
    lessons.check_number("05.1", [9, 33])
    assert "not solved: the factor 2^j of a frequency is missing" in capsys.readouterr().out
    lessons.check_number("12.3", 0.0548)
    assert "the 1 / ln 2 of the bits is missing" in capsys.readouterr().out


def test_numbers_that_agree_with_the_largest_alone_are_counted():
    right = np.array([1.0, 1e-9, 1e-9, 2.0])
    said = [lessons.difference(right * [1, c, 1, 1], right) for c in (2, -1)]
    assert said == ["1 of 4 numbers are wrong", "1 of 4 numbers have the wrong sign"]
    assert lessons.difference(right < 1, right > 0) == "2 of 4 numbers are wrong"  # flags, too


def test_an_exercise_has_no_case_without_rows(capsys):
    """A right answer may reshape by the number of rows, which fails where there are none."""

    def color(f_a, delta_vc, d_vc, weights, biases):
        y, _ = mlp.forward(np.concatenate([f_a, delta_vc, d_vc], axis=1), weights, biases)
        return 1 / (1 + np.exp(-y.reshape(len(y), -1, 3)))

    with np.errstate(over="ignore"):
        lessons.check_forward("04.2", color, "color")
    assert "exercise 04.2: solved" in capsys.readouterr().out


def test_hints_come_one_after_the_other(capsys, monkeypatch):
    monkeypatch.setattr(lessons, "HINTS_GIVEN", {})
    first, second = lessons.read_stored("hints")["07.3"]
    for message in (f"1 of 2: {first}", f"2 of 2: {second}", f"2 of 2: {second}"):
        lessons.hint("07.3")
        assert capsys.readouterr().out == f"hint {message}\n"
    with pytest.raises(KeyError, match="7.3"):
        lessons.hint("7.3")


def unwritten(**inputs):
    raise NotImplementedError


@pytest.mark.parametrize(
    "mine, message",
    [
        (lambda x_a, O_a, l_a: x_a[:, None] + O_a * l_a[:, None], "exercise 01.2: solved"),
        (lambda **inputs: {"x": offsets.forward(**inputs)[0]}, "exercise 01.2: solved"),
        (unwritten, "not solved: no answer yet"),
        (lambda x_a, O_a, l_a: x_a[:, None] + O_a, "the output x: 60 of 60 numbers are wrong"),
        (
            lambda x_a, O_a, l_a: x_a,
            "the output x (shape): (5, 3), expected (5, 4, 3)",
        ),
        (lambda **_: None, "the output x (missing): expected float64 (5, 4, 3)"),
        (lambda x_a, **_: (x_a, x_a), "not solved: expected the output x, got 2 of type tuple"),
        (
            lambda x_a, O_a, l_a: 1 / 0,
            "error in offsets/ordinary: ZeroDivisionError: division by zero",
        ),
    ],
)
def test_forwards(mine, message, capsys):
    assert lessons.check_forward("01.2", mine, "offsets") is None
    assert message in capsys.readouterr().out


def test_backwards(capsys):
    def without_sum(inputs, cotangents):
        return {**right_backward(inputs, cotangents), "x_a": cotangents["x_bar"][:, -1]}

    def one_missing(inputs, cotangents):
        gradients = right_backward(inputs, cotangents)
        return {name: gradients[name] for name in ("x_a", "O_a")}

    def solved(mine, *wanted):
        assert lessons.check_backward("01.3", mine, "offsets", *wanted) is None
        return lessons.RESULTS["01.3"]

    assert solved(right_backward)
    assert not solved(without_sum)
    assert solved(without_sum, "O_a", "l_a")
    assert not solved(one_missing)
    assert "the gradient of l_a (missing): expected float64 (5, 3)" in capsys.readouterr().out
    assert not solved(lambda inputs, cotangents: (cotangents["x_bar"],))
    message = "not solved: expected a dictionary {input name: gradient}, got tuple\n"
    assert message in capsys.readouterr().out


def wrong_in_q(change):
    """A backward of Eq. (7) whose gradient of q is changed."""

    def backward(inputs, cotangents):
        f_bar = cotangents["f_noisy_bar"]
        q_bar = (f_bar * inputs["u"]).sum(axis=1, keepdims=True)
        return {"f": f_bar, "q": change(q_bar, f_bar)}

    return backward


def message_of(change, capsys):
    lessons.check_backward("07.3", wrong_in_q(change), "noise")
    return capsys.readouterr().out


def test_of_gradients_only_a_mistake_of_gradients_is_named(capsys):
    """The outputs are right: d_vc from the anchor to the camera would show in them."""
    eq = EQUATIONS["view"]

    def turned(inputs, cotangents):
        _, pullback = eq.vjp(**inputs)
        return pullback(**{**cotangents, "d_vc_bar": -cotangents["d_vc_bar"]})

    lessons.check_backward("02.3", turned, "view")
    said = capsys.readouterr().out
    assert "the gradient of x_a" in said and "d_vc points from the anchor" not in said
    backward = lambda i, c: {"x_a": -1 * eq.vjp(**i)[1](**c)["x_a"]}  # noqa: E731
    lessons.check_backward("02.3", backward, "view")
    assert "  It looks like this: the gradient of x_a has the wrong sign" in capsys.readouterr().out


def test_solved_says_where_digits_were_lost(capsys):
    def printed(x_a, x_c):
        ray = x_a - x_c
        delta = np.sqrt((ray**2).sum(axis=1, keepdims=True))
        return delta, np.where(delta > 0, ray / delta, 0)

    lessons.check_forward("02.2", printed, "view")
    says = "exercise 02.2: solved, but digits are lost in view/far, view/near: delta_vc by hypot"
    assert says in capsys.readouterr().out


def test_feedback_names_the_mistake_that_the_oracle_names(capsys):
    def mean(q_bar, f_bar):
        return q_bar / f_bar.shape[1]

    message = message_of(mean, capsys)
    by_oracle = oracle.check(EQUATIONS["noise"], "noise", wrong_in_q(mean)).first.explanation
    assert "mean over the channels instead of the sum" in by_oracle
    assert message.splitlines()[:3] == [
        "exercise 07.3: not solved: the gradient of q: all 6 numbers are 0.2 times the right ones",
        "  Case noise/ordinary: in_bar.q[3, 0]: got 0.135502324, expected 0.677511622",
        f"  It looks like this: {by_oracle}",
    ]


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda q_bar, f_bar: 0 * q_bar, "the gradient of q: all 6 numbers are 0 times"),
        (lambda q_bar, f_bar: q_bar / -4, "are -0.25 times the right ones\n"),
        (lambda q_bar, f_bar: 7 * q_bar, "are 7 times the right ones\n"),
        (lambda q_bar, f_bar: q_bar**3 + 1, "q: 6 of 6 numbers are wrong\n"),
        (lambda q_bar, f_bar: q_bar * np.nan, "q: [0, 0] is nan\n"),
        (lambda q_bar, f_bar: q_bar * (1 + 1e-9), "q: too few right digits\n"),
    ],
)
def test_feedback_in_plain_words(change, message, capsys):
    assert message in message_of(change, capsys)


def test_feedback_on_integers(capsys):
    def floored(f, q):
        symbols = np.floor(f / q).astype(int)
        return symbols, symbols * q

    lessons.check_forward("07.2", floored, "rounding")
    message = capsys.readouterr().out
    assert "the output symbols: " in message and " numbers are wrong\n" in message


def test_a_number_that_should_be_zero_and_integers_of_few_bits():
    assert lessons.difference(np.array(1.0), np.array(0.0)) == "it is wrong"
    twice = lessons.difference(np.array([32.0, 32.0]), np.array([16, 16], np.uint8))
    assert twice == "all 2 numbers are 2 times the right ones"


def test_a_mistake_that_is_not_known_is_told_by_its_first_wrong_number(capsys):
    lessons.check_mistake(
        lambda x_a, O_a, l_a: x_a[:, None] + 1.2345 * O_a * l_a[:, None], "offsets"
    )
    assert re.search(r"offsets/ordinary fails: out\.x\S* \S", capsys.readouterr().out)
