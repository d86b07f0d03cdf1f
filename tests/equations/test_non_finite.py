"""What a NaN or an infinity in an input does: it stays in its row, or an error names it."""

import numpy as np
import pytest

from p4dgs_ref import EQUATIONS
from p4dgs_ref.oracle.tolerance import answer_of, cotangents_of
from tests.workshop.cases import case_of
from tests.workshop.shape_comments import arguments, outputs

RAISES = {"rounding": OverflowError, "hash_grid": ValueError, "likelihood": ValueError}
BAD = pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])


def rows_of(eq):
    """The letter of the axis that all outputs begin with, "A" or "N"; None for other equations."""
    firsts = {spec.shapes[0][:1] for spec in outputs(eq.forward, eq.outputs).values()}
    return firsts.pop()[0] if firsts in ({("A",)}, {("N",)}) else None


# Masking makes one list of all rows; the other two raise an error, as `likelihood` does for
# sigma and q.
NOT_BY_ROWS = "masking", "rounding", "hash_grid"
BY_ROWS = [key for key, eq in EQUATIONS.items() if rows_of(eq) and key not in NOT_BY_ROWS]


@BAD
@pytest.mark.parametrize("key", EQUATIONS)
def test_nan_and_infinity_raise_only_as_documented(key, bad):
    eq, inputs = EQUATIONS[key], case_of(key).inputs
    for name, a in inputs.items():
        first, *others = a if isinstance(a, list) else [a]
        if getattr(first, "dtype", np.dtype(int)).kind != "f":
            continue
        wrong = np.array(first)
        wrong.reshape(-1)[wrong.size // 2] = bad
        changed = {**inputs, name: [wrong, *others] if isinstance(a, list) else wrong}
        try:
            with np.errstate(all="ignore"):
                answer_of(eq)(changed, cotangents_of(eq, eq(**changed), key))
        except (ValueError, OverflowError) as error:
            assert type(error) is RAISES[key] and "expected" in str(error), name


@BAD
@pytest.mark.parametrize("key", BY_ROWS)
def test_nan_and_infinity_stay_in_their_row(key, bad):
    eq, inputs = EQUATIONS[key], case_of(key).inputs
    cotangents = cotangents_of(eq, eq(**inputs), key)
    letter, specs = rows_of(eq), arguments(eq.forward)
    names = [
        name
        for name, spec in specs.items()
        if spec.shapes and spec.shapes[0][:1] == (letter,) and name not in ("sigma", "q")
    ]
    right = answer_of(eq)(inputs, cotangents)
    by_row = [f"out.{n}" for n in eq.outputs] + [f"in_bar.{n}" for n in names if n in eq.gradients]
    for name in names:
        wrong = inputs[name].copy()
        wrong[2].reshape(-1)[-1:] = bad
        with np.errstate(all="ignore"):
            answer = answer_of(eq)({**inputs, name: wrong}, cotangents)
        for output in by_row:
            other_rows = (np.delete(a[output], 2, axis=0) for a in (answer, right))
            assert np.array_equal(*other_rows, equal_nan=True), f"{name} -> {output}"


def test_a_nan_position_and_an_infinite_box_are_named():
    inputs = case_of("hash_grid").inputs
    x_a = inputs["x_a"].copy()
    x_a[4, 2] = np.nan
    with pytest.raises(ValueError, match=r"x_a\[4, 2\] is nan"):
        EQUATIONS["hash_grid"].forward(**{**inputs, "x_a": x_a})
    with pytest.raises(ValueError, match="finite corners"):
        EQUATIONS["hash_grid"].forward(**{**inputs, "hi": np.array([1, np.inf, 2])})
