"""An answer passes within the published tolerance of its case and fails beyond it."""

import numpy as np
import pytest

from p4dgs_ref.oracle import checker
from p4dgs_ref.oracle.compare import expected_tensors
from tests.oracle.answers import case_of, in_precision

EPS = {"float64": 2.0**-52, "float32": 2.0**-23}


@pytest.mark.parametrize("precision", EPS)
@pytest.mark.parametrize(
    "id, name",
    [
        ("offsets/ordinary", "out.x"),
        ("offsets/ordinary", "in_bar.O_a"),
        ("total_loss/ordinary", "out.L_total"),  # a single number
        ("hash_grid/ordinary", "in_bar.grids.0"),  # one array of a list
        ("projection/ordinary", "in_bar.Sigma"),  # only its symmetric part counts
        ("trace/ten_steps", "out.final"),  # steps of training have a wider tolerance
        ("frames/front_000", "out.image"),  # one S for all pixels
    ],
)
def test_one_number_may_be_off_by_nine_tenths_of_the_bound_but_not_by_eleven(id, name, precision):
    case = case_of(id)
    bound = case.record["tolerance"][precision]["eps_S"]
    for share, verdict in (0.9, "pass"), (1.1, "fail"):
        error = np.zeros(case.tensors[name].shape)
        error.flat[0] = share * bound * EPS[precision] * case.tensors["scale." + name].flat[0]
        what = f"{id}: {name} off by {share} of the published {bound} eps S"
        assert verdict_of(case, name, error, precision) == verdict, what


@pytest.mark.parametrize("precision", EPS)
def test_all_pixels_may_be_off_by_nine_tenths_of_their_bound_but_not_by_eleven(precision):
    """The root mean square of an image has a bound of its own, `rms_eps_S`."""
    case = case_of("frames/front_000")
    bound = case.record["tolerance"][precision]["rms_eps_S"]
    for share, verdict in (0.9, "pass"), (1.1, "fail"):
        error = share * bound * EPS[precision] * case.tensors["scale.out.image"]
        what = f"all pixels off by {share} of the published rms_eps_S, {bound}"
        assert verdict_of(case, "out.image", error, precision) == verdict, what


def verdict_of(case, name, error, precision):
    """Return the verdict on a right answer with an error in one tensor."""
    right = in_precision(expected_tensors(case.tensors), precision)
    wrong = (case.tensors[name] + error).astype(precision)
    return checker.judge_answer(case, right | {name: wrong}).verdict
