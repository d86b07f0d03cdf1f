"""Runs a port on every case, judges its answers, and names the first equation that diverges."""

from collections import Counter
from typing import NamedTuple

import numpy as np

from . import doctor, published
from .compare import RECIPES, Result, compare, expected_tensors, precision, printed_form
from .ports import ROLES, FunctionPort, PortError
from .published import GROUPS, INVALID, LEVELS
from .report import text


class Report(NamedTuple):
    """All verdicts, in the order in which data flows."""

    results: list
    says: dict = {}  # the first line of a port that runs as a process
    dtype: str | None = None  # in which that port was asked; None: each tensor has its own
    strict: bool = False

    @property
    def ok(self):
        """Whether at least one case was required and every required case passed."""
        return any(r.required for r in self.results) and not any(r.wrong for r in self.results)

    @property
    def first(self):
        """The first required case with a wrong answer, else the first without one, else None."""
        wrong = [r for r in self.results if r.wrong]
        return next((r for r in wrong if r.findings), next(iter(wrong), None))

    def levels(self):
        """Return {level or group: {passed, acceptable, of, says}} of the required cases.

        Streams that a decoder has to refuse are a row of their own: refusing all of them is easy.
        """
        says = {**LEVELS, **INVALID, **GROUPS}
        required = [(r.group or r.level, r.verdict) for r in self.results if r.required]
        counts = {level: Counter(v for of, v in required if of == level) for level in says}
        return {
            level: {
                "passed": count["pass"],
                "acceptable": count["acceptable"],
                "of": count.total(),
                "says": says[level],
            }
            for level, count in counts.items()
            if count
        }

    def __str__(self):
        return text(self)


def check(forward, key, vjp=None, strict=False, dtype="float64"):
    """Judge a Python function as an equation of the table, or as another subject of the vectors.

    `key` may be the id of a single case. `forward(**inputs)` returns the outputs: a dictionary, a
    tuple in order or one array. `vjp(inputs, cotangents)` returns {input: gradient}; without it
    only outputs are judged. Arrays are whatever `np.asarray` reads, in the precision `dtype`, in
    which the inputs are given. With `strict`, answers that are acceptable only because the printed
    formula is no better fail. Raises KeyError if `key` is neither a subject nor a case, TypeError
    if `forward` is not a function, and ValueError if `dtype` is neither float64 nor float32.
    """
    if not callable(forward):
        raise TypeError(f"forward: expected a function, got {type(forward).__name__}")
    port = FunctionPort(forward, vjp, dtype)
    return Report(check_subject(published.cases(key), port, strict), {}, port.dtype.name, strict)


def check_port(port, levels=(), only=(), progress=lambda text: None, strict=False):
    """Return a Report on a port, in the order in which data flows.

    `levels` and `only` (subjects, equations, groups or ids of cases) choose cases; if they are
    empty, all cases run. `strict` is that of `check`. Raises SelectionError if they name something
    unknown or choose no case.
    """
    levels, only = ({names} if isinstance(names, str) else {*names} for names in (levels, only))
    published.require_known(levels, only)
    results = []
    for level in (level for level in LEVELS if not levels or level in levels):
        chosen = [row["name"] for row in _chosen(published.stream_rows(), {"codec"}, only)]
        if level == "L3" and chosen:
            from . import streams  # loads the codec

            progress("codec")
            results += streams.check(port, chosen)
        for subject in published.subjects().values():
            names = {subject["key"], subject["equation"], subject.get("group")}
            chosen = {row["id"] for row in _chosen(subject["cases"], names, only)}
            if subject["level"] == level and chosen:
                progress(subject["key"])
                cases = [case for case in published.read(subject) if case.id in chosen]
                results += check_subject(cases, port, strict)
    if not results:
        raise published.SelectionError(
            f"levels {' '.join(sorted(levels))}, only {' '.join(sorted(only))}: no such case; "
            "`p4dgs-ref oracle list` lists them"
        )
    dtype = getattr(port, "dtype", None)
    says = getattr(port, "says", {})
    return Report(results, says, dtype and np.dtype(dtype).name, strict)


def _chosen(rows, names, only):
    """Return the rows of a subject that a selection means: all, or those whose ids it has."""
    return rows if not only or names & only else [row for row in rows if row["id"] in only]


def check_subject(cases, port, strict=False):
    """Return the results of one subject's cases. Wrong answers are explained by the doctor.

    A port may leave out a whole subject of a group, but not single cases of it. If the port has a
    field `asked`, only the tensors of these roles are judged.
    """
    judged = [judge(case, port, strict) for case in cases]
    results = [result for result, _ in judged]
    if cases[0].group and all(r.verdict in ("skipped", "missing", "not_judged") for r in results):
        return [r._replace(required=False) for r in results]
    if not any(r.findings and not r.recipe for r in results):
        return results
    diagnoses = doctor.diagnose(
        cases[0].subject,
        [
            evidence(case, got, result)
            for case, (result, got) in zip(cases, judged)
            if result.verdict in ("pass", "fail") and not result.recipe
        ],
    )
    return [with_diagnosis(r, diagnoses) for r in results]


def judge(case, port, strict=False):
    """Return the Result of one case, and what the port answered, or None."""
    try:
        got = {name: np.asarray(a) for name, a in port.run(case).items()}
    except PortError as error:
        return Result(
            case.id,
            case.equation,
            case.level,
            verdict=error.kind,
            required=case.record["result"] == "valid"
            and error.kind not in ("not_judged", "absent"),
            explanation=str(error),
            group=case.group,
        ), None
    return judge_answer(case, got, getattr(port, "asked", ROLES), strict), got


def judge_answer(case, got, roles=ROLES, strict=False):
    """Return the Result of one case for the answer {"out.x": array, "in_bar.x_a": array}.

    A tensor whose bound is too wide to judge it can still fail: if it is missing, has another
    shape, is not finite or exceeds even that bound.
    """
    got = {n: a for n, a in got.items() if n in case.tensors or not n.startswith("in_bar.")}
    is_valid, not_judged = case.record["result"] == "valid", case.not_judged(precision(got))
    # In the group `inside` a port may answer some tensors only; elsewhere all are expected.
    some = case.group == "inside" and expected_tensors(case.tensors).keys() & got.keys()
    names = [n for n in some or expected_tensors(case.tensors) if n.startswith(roles)]
    if case.tolerance(precision(got)) is None:
        names = []
    findings = findings_of(case, got, names) if names else []
    printed, mine = printed_form(case, got)
    mistaken = [
        finding
        for finding in findings and findings_of(printed, mine, names)
        if not is_defensible(case, got, finding)
    ]
    # Where a wrong answer would be as near as the printed formula, being as near proves nothing.
    wide = printed.not_judged(precision(got)) if findings and not strict else []
    vague = {f.tensor for f in findings if f.tensor in wide} - {f.tensor for f in mistaken}
    findings = [f for f in findings if f.tensor not in vague]
    wrong = {f.tensor for f in findings}
    not_judged = [name for name in not_judged if name not in wrong]
    names = [name for name in names if name not in {*vague, *not_judged}]
    verdict = "fail" if mistaken or is_valid and strict else "acceptable"
    if not findings:
        verdict = "pass" if names else "not_judged"
    return Result(
        case.id,
        case.equation,
        case.level,
        verdict,
        required=bool(names) and (is_valid or verdict == "fail"),
        findings=tuple(mistaken or findings),
        not_judged=(*not_judged, *sorted(vague)),
        recipe=RECIPES[case.subject] if is_valid and (findings or vague) and not mistaken else "",
        group=case.group,
    )


def is_defensible(case, got, finding):
    """Return whether a wrong tensor is another answer that the case allows."""
    name, others = finding.tensor, case.record.get("others", {})
    if finding.kind != "value" or name not in others:
        return False
    distance = np.abs(got[name].astype(float) - others[name]["times"] * case.tensors[name])
    return bool((distance <= others[name]["within"]).all())  # false for NaN


def findings_of(case, got, names):
    """Return the findings of `compare` on some tensors of a case."""
    return compare(
        {n: a for n, a in case.tensors.items() if n.removeprefix("scale.") in names},
        got,
        case.tolerance(precision(got)),
    )


def evidence(case, got, result):
    """Return what the doctor sees of a case, with the scales of the printed formula.

    Tensors that are off, but no further than the printed formula, say nothing about a mistake.
    """
    wrong = [finding.tensor for finding in result.findings]
    near = {finding.tensor for finding in findings_of(case, got, got)} - set(wrong)
    shown = {n: a for n, a in got.items() if n not in near and n not in result.not_judged}
    return printed_form(case, got)[0], shown, wrong


def with_diagnosis(result, diagnoses):
    """Return a result with what the diagnoses say of its case: an explanation or a hint.

    A known mistake also names the equation to blame.
    """
    rows = [row for row in diagnoses if result.id in row.cases]
    is_certain = bool(rows) and rows[0].certain
    blamed = rows[0].mistake.equation if is_certain and rows[0].mistake.id else result.equation
    field = "explanation" if is_certain else "hint"
    return result._replace(**{field: " or ".join(map(str, rows)), "equation": blamed})
