"""No tensor of the vectors passes that is off by 1e-3, zero or negated."""

import numpy as np
import pytest

from p4dgs_ref.oracle import checker, published, report
from p4dgs_ref.oracle import printed as scales
from p4dgs_ref.oracle.compare import expected
from tests.sampling import few

PRECISIONS = ("float64", "float32")


def cases():
    return [case for key in published.subjects() for case in published.cases(key)]


def perturbed(case, name):
    """Return a tensor off by 1e-3, zero and negated.

    What is all zero is changed by 1e-3 of its S, and by 1e-3 where S is 0.
    """
    a = case.tensors[name]
    if a.dtype.kind == "b":
        return [~a]
    if a.dtype.kind != "f":
        return [a + 1, -a - 1]
    if a.any():
        return [1.001 * a, np.zeros_like(a), -a]
    S = np.where(case.tensors["scale." + name] == 0, 1, case.tensors["scale." + name])
    return [a + 1e-3 * S, a - 1e-3 * S]


def cast(tensors, dtype):
    with np.errstate(over="ignore"):
        return {n: a.astype(dtype) if a.dtype.kind == "f" else a for n, a in tensors.items()}


@pytest.mark.parametrize("dtype", few(PRECISIONS, 1))
def test_no_wrong_tensor_passes(dtype):
    """Nor is it acceptable, but where the printed formula has no more digits."""
    judged = acceptable = 0
    for case in cases():
        unasked = case.unasked(dtype)
        as_printed = scales.measured().get((case.id, dtype), {})
        for name, right in expected(case.tensors).items():
            if name in unasked or not right.size:
                continue
            alone = {n: case.tensors[n] for n in (name, "scale." + name) if n in case.tensors}
            for wrong in perturbed(case, name):
                got = cast({name: wrong}, dtype)
                result = checker.judge_answer(case._replace(tensors=alone), got)
                judged += 1
                acceptable += bool(result.recipe)
                if result.recipe:
                    assert f"scale.{name}" in as_printed, (case.id, name)
                else:
                    assert result.verdict != "pass" and result.findings, (case.id, name)
                    assert result.wrong == result.required, (case.id, name)
    assert judged > 3000 and acceptable < 0.05 * judged


def test_what_is_not_asked_in_float32():
    assert not any(case.unasked("float64") for case in cases())
    first = [case for case in cases() if "since" not in case.record]  # of version 1.0
    found = {case.id: case.unasked("float32") for case in first if case.tolerance("float32")}
    whole = {id for id in found if set(found[id]) >= set(by_id(id))}
    assert whole == {"likelihood/H-R5.width1e+06", "likelihood/H-R5.width1000"}
    rest = {f"{id} {name}" for id, names in found.items() if id not in whole for name in names}
    for id in ("H-G3.1e4px", "H-G3.1e3px"):
        for name in ("out.conic", "in_bar.Sigma"):
            assert f"projection/{id} {name}" in rest
    assert len(rest) == 13


def by_id(id):
    (case,) = (case for case in published.cases(id.split("/")[0]) if case.id == id)
    return list(expected(case.tensors))


class Single:
    """A right port in float32; what float32 cannot compute is nonsense."""

    def run(self, case):
        with np.errstate(over="ignore"):
            got = cast(expected(case.tensors), "float32")
        return {n: a + np.inf if n in case.unasked("float32") else a for n, a in got.items()}


def test_they_are_counted_apart():
    results = []
    for key in ("projection", "likelihood"):
        results += checker.check_subject(published.cases(key), Single())
    found = checker.Report(results)
    verdicts = {r.id: r.verdict for r in results}
    assert found.ok and verdicts["likelihood/H-R5.width1e+06"] == "unasked"
    assert verdicts["projection/H-G3.1e4px"] == "pass"
    count = sum(verdict == "unasked" for verdict in verdicts.values())
    assert f"{count} cases and 8 tensors of other cases are not checked" in str(found)
    assert found.levels()["L1"]["passed"] == len(results) - count
    rows = {row["id"]: row for row in report.as_json(found)["cases"]}
    assert rows["projection/H-G3.1e3px"]["unasked"] == ["out.conic", "in_bar.Sigma"]
    assert not rows["likelihood/H-R5.width1e+06"]["required"]
