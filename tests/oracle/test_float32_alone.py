"""A port that computes in float32 alone, as on a GPU: right, it fails nothing; wrong, it is found.

The port is this project's own code, in float32 also where it asks for float64.
"""

import numpy as np
import pytest

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.checker import Report, check_subject, judge_answer
from p4dgs_ref.oracle.compare import cast, change_floats, expected_tensors
from p4dgs_ref.oracle.report import as_json
from tests.oracle.answers import Port
from tests.sampling import few
from tests.workshop.measured import single
from tests.workshop.mistakes import MISTAKES
from tests.workshop.mistakes.__main__ import answers
from tests.workshop.subjects import subjects

SUBJECTS = published.subjects()
KEYS = [key for key, row in SUBJECTS.items() if row["level"] != "L3"]
# Known mistakes that show elsewhere than in float32: 0.2 is another number there, and an epsilon of
# 1e-15 in another place moves no digit that float32 has.
NOT_FOUND = "projection-near-inclusive", "adam-epsilon-after-correction"
FOUND = [m for m in MISTAKES if m.subject in KEYS and m.id not in NOT_FOUND]

SOME = "projection", "likelihood"


def alone(answer):
    """The port whose answers are those of `answer(case)` in float32 alone.

    `Port` answers nothing where a case is not asked in float32.
    """

    def compute(case, _):
        return answer(case._replace(tensors=change_floats(case.tensors, single)))

    return Port(compute, np.float32)


def ours(case):
    return subjects()[case.subject].answer(case.inputs(), case.cotangents())


@pytest.mark.parametrize("key", few(KEYS, 12))
def test_a_right_port_fails_nothing(key):
    # f / q is to be computed in float64 even so.
    cases = [case for case in published.cases(key) if case.id != "rounding/float32_inputs"]
    report = Report(check_subject(cases, alone(ours)))
    assert not any(r.wrong for r in report.results), str(report)


@pytest.mark.filterwarnings("ignore:Mean of empty slice")  # of mistakes of the window of SSIM
@pytest.mark.parametrize("mistake", few(FOUND, 8, 50), ids=lambda mistake: mistake.id)
def test_a_wrong_port_is_found(mistake):
    port = alone(lambda case: answers(mistake, case))
    assert any(r.wrong for r in check_subject(published.cases(mistake.subject), port))


@pytest.mark.parametrize("key", ["kernel_many", "likelihood"])
def test_a_tensor_that_is_not_judged_is_asked_for_all_the_same(key):
    """Its name, its shape, finite numbers, and a coarse bound."""
    for case in published.cases(key):
        right = cast(expected_tensors(case.tensors), np.float32)
        wide = case.not_judged("float32") if case.tolerance("float32") else ()
        for name in wide:
            a = right[name]
            for wrong in a * np.float32(np.nan), a[None], a * np.float32(1e3), None:
                got = {n: b for n, b in {**right, name: wrong}.items() if b is not None}
                result = judge_answer(case, got)
                assert result.wrong and [f.tensor for f in result.findings] == [name], case.id


def test_what_is_not_judged_is_named():
    """A needle and a Gaussian of 1e19 units are culled in float32. Strictly, they may not be."""
    results, strictly = (
        [r for key in SOME for r in check_subject(published.cases(key), alone(ours), strict=strict)]
        for strict in (False, True)
    )
    culled = ["projection/H-G3.1e4px", "projection/H-G4.scale1e30"]
    assert [r.id for r in results if r.verdict == "acceptable"] == culled
    assert [r.id for r in strictly if r.wrong] == culled
    (line,) = [line for line in str(Report(results)).splitlines() if line.startswith("not judged")]
    for named in "projection/H-G3.1e3px (out.conic, in_bar.Sigma)", ", likelihood/H-R5.width1000,":
        assert named in line
    rows = {row["id"]: row for row in as_json(Report(results))["cases"]}
    assert rows["projection/H-G3.1e3px"]["not_judged"] == ["out.conic", "in_bar.Sigma"]
    assert not rows["likelihood/H-R5.width1e+06"]["required"]
