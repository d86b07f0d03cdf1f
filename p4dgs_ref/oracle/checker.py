"""Runs a port on every case, judges its answers, and names the first equation that diverges."""

from typing import NamedTuple

import numpy as np

from . import doctor, published
from .compare import Result, compare, precision
from .ports import FunctionPort, PortError
from .published import FOLDER, LEVELS
from .report import text


class Report(NamedTuple):
    """All verdicts, in the order in which data flows."""

    results: list
    strangers: tuple = ()  # tensors that belong to no case, perhaps misspelt; otherwise ignored

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
        """Return {level: {passed, of, says}} of the required cases."""
        found = {}
        for level, says in LEVELS.items():
            rows = [r for r in self.results if r.level == level and r.required]
            if rows:
                passed = sum(not r.wrong for r in rows)
                found[level] = {"passed": passed, "of": len(rows), "says": says}
        return found

    def __str__(self):
        return text(self)


def check(forward, key, vjp=None):
    """Judge a Python function as an equation of the table, or as another subject of the vectors.

    `forward(**inputs)` returns the outputs: a dictionary, a NamedTuple, a tuple in order or one
    array. `vjp(inputs, cotangents)` returns {input: gradient}; without it only outputs are judged.
    Arrays are whatever `np.asarray` reads. Raises KeyError where `key` is no subject.
    """
    roles = ("out.", "in_bar.") if vjp else ("out.",)
    return Report(check_subject(published.cases(key), FunctionPort(forward, vjp), roles))


def check_port(
    port,
    levels=(),
    only=(),
    folder=FOLDER,
    progress=lambda text: None,
    version=published.VERSIONS[-1],
):
    """Return a Report on a port, in the order in which data flows.

    `levels` and `only` (subjects or equations) choose cases; empty, they choose all. `version` is
    that of the vectors: cases that joined later are left out.
    """
    only = {only} if isinstance(only, str) else set(only)
    manifest = published.read_manifest(folder, version)
    results = []
    for level in LEVELS:
        if levels and level not in levels:
            continue
        if level == "L3" and (not only or "codec" in only):
            from . import streams  # loads the codec

            progress("codec")
            results += streams.check(port, {row["name"] for row in manifest["streams"]})
        for subject in manifest["subjects"]:
            called = {subject["key"], subject["equation"], "codec" if level == "L3" else ""}
            chosen = not only or called & only
            if subject["level"] == level and chosen:
                progress(subject["key"])
                results += check_subject(published.read(subject, folder), port)
    return Report(_shared(results), tuple(port.strangers()))


def check_subject(cases, port, roles=("out.", "in_bar.")):
    """Return the results of one subject's cases. Wrong answers are explained by the doctor."""
    results, answers = [], []
    for case in cases:
        result, got = judge(case, port, roles)
        results.append(result)
        if got is not None and result.verdict != "acceptable":
            answers.append((case, got, [f.tensor for f in result.findings]))
    if not any(r.findings for r in results):
        return results
    diagnoses = doctor.diagnose(cases[0].subject, answers)
    return [explained(r, diagnoses) for r in results]


def judge(case, port, roles=("out.", "in_bar.")):
    """Return the Result of one case, and what the port answered, or None."""
    required = case.record["result"] == "valid"

    def result(verdict, findings=(), said="", required=required):
        return Result(case.id, case.equation, case.level, verdict, required, tuple(findings), said)

    try:
        got = {name: np.asarray(a) for name, a in port.run(case).items()}
    except PortError as error:
        asked = required and error.kind != "unasked"
        return result(error.kind, said=printable(str(error)), required=asked), None
    tolerance = case.tolerance(precision(got))
    if tolerance is None:
        return result("unasked", required=False), None
    tensors = {n: a for n, a in case.tensors.items() if n.startswith((*roles, "scale."))}
    findings = compare(tensors, got, tolerance)
    if not findings:
        return result("pass"), got
    return result("fail" if required else "acceptable", findings), got


def printable(text):
    """Return a port's words, with every unprintable character escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def explained(result, diagnoses):
    """Return a result with what the diagnoses say of its case: an explanation or a hint."""
    rows = [row for row in diagnoses if result.id in row.cases]
    said = " or ".join(map(str, rows))
    if rows and rows[0].certain:
        return result._replace(explanation=said)
    return result._replace(hint=said)


def _shared(results):
    """Give wrong answers of which nothing is known the explanation of their equation.

    It comes from the cases of another subject; where the doctor was silent about a case of the same
    subject, that case contradicts it.
    """
    sources = {r.equation: r for r in reversed(results) if r.findings and r.explanation}
    shared = []
    for r in results:
        source = sources.get(r.equation)
        silent = r.findings and not r.explanation and not r.hint
        if silent and source and r.id.split("/")[0] != source.id.split("/")[0]:
            r = r._replace(explanation=f"{source.explanation} (seen in {source.id})")
        shared.append(r)
    return shared
