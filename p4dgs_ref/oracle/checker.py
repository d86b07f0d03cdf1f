"""The checker: every case put to a port, its answers judged, the first equation that diverges named and explained."""

from typing import NamedTuple

import numpy as np

from . import doctor, published, streams
from .compare import Result, compare, precision
from .ports import FunctionPort, PortError
from .subjects import LEVELS
from .vectors import FOLDER, read_manifest


class Report(NamedTuple):
    """All verdicts, in the order in which data flows."""

    results: list
    strangers: tuple = ()  # tensors that belong to no case: a misspelt name, reported and otherwise ignored

    @property
    def ok(self):
        """Whether every required case passed, and there was one."""
        return any(r.required for r in self.results) and not any(r.wrong for r in self.results)

    @property
    def first(self):
        """The first required case that was answered wrongly, else the first that was not answered, else None."""
        wrong = [r for r in self.results if r.wrong]
        return next((r for r in wrong if r.findings), next(iter(wrong), None))

    def levels(self):
        """{level: {passed, of, says}} over the required cases."""
        return {
            level: {"passed": sum(not r.wrong for r in rows), "of": len(rows), "says": says}
            for level, says in LEVELS.items()
            if (rows := [r for r in self.results if r.level == level and r.required])
        }

    def __str__(self):
        from .report import text

        return text(self)


def judge(case, port, roles=("out.", "in_bar.")):
    """(Result of one case, what the port answered or None)."""
    required = case.record["result"] == "valid"

    def result(verdict, findings=(), said=""):
        return Result(case.id, case.equation, case.level, verdict, required, tuple(findings), said)

    try:
        got = {name: np.asarray(a) for name, a in port.run(case).items()}
    except PortError as error:
        required = required and error.kind != "unasked"
        return result(error.kind, said=printable(str(error))), None
    tolerance = case.tolerance(precision(got))
    if tolerance is None:
        return result("unasked")._replace(required=False), None
    tensors = {n: a for n, a in case.tensors.items() if n.startswith((*roles, "scale."))}
    findings = compare(tensors, got, tolerance)
    return result(
        "fail" if findings and required else "acceptable" if findings else "pass", findings
    ), got


def check_subject(cases, port, roles=("out.", "in_bar.")):
    """Verdicts on one subject's cases; where one fails, the doctor says what explains it."""
    results, answers = [], []
    for case in cases:
        result, got = judge(case, port, roles)
        results.append(result)
        if got is not None:
            answers.append((case, got, [f.tensor for f in result.findings]))
    if any(r.findings for r in results):
        said = sentence(*doctor.diagnose(cases[0].subject, answers))
        results = [
            r._replace(explanation=said) if r.findings and not r.explanation else r for r in results
        ]
    return results


def printable(text):
    """A port's words without what would move the cursor or cannot be written."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def sentence(explained, part=""):
    """What the doctor found, in one sentence; empty if nothing."""
    found = [f"{mistake.description} [{mistake.id}]" for mistake, _, _ in explained]
    if not found:
        return ""
    agreed, failed = explained[0][1:]
    limits = [f"{agreed} of {failed} cases"] * (agreed != failed) + [f"the {part} alone"] * bool(
        part
    )
    return " or ".join(found) + (f" (explains {', '.join(limits)})" if limits else "")


def check_port(port, levels=(), only=(), folder=FOLDER, progress=lambda text: None):
    """A Report on everything, or on some levels, or on `only` some subjects or equations, in the order of the data."""
    results, only = [], (only,) if isinstance(only, str) else only
    manifest = read_manifest(folder)
    for level in (level for level in LEVELS if not levels or level in levels):
        if level == "L3" and (not only or "codec" in only):
            progress("codec")
            results += streams.check(port)
        for subject in manifest["subjects"]:
            if subject["level"] == level and (
                not only or {subject["key"], subject["equation"]} & set(only)
            ):
                progress(subject["key"])
                results += check_subject(published.read(subject, folder), port)
    return Report(_share(results), tuple(port.strangers()))


def _share(results):
    """A scalar or a stage that diverges has few known mistakes of its own, or none: it takes what explains its equation."""
    said = {r.equation: r.explanation for r in reversed(results) if r.findings and r.explanation}
    return [
        r._replace(explanation=said.get(r.equation, "")) if r.findings and not r.explanation else r
        for r in results
    ]


def check(forward, key, vjp=None):
    """Judge a Python function as an equation of the table.

    forward(**inputs) gives the outputs: a dictionary, a NamedTuple, a tuple in order or one array; vjp(inputs, cotangents)
    gives {input: gradient}, and without it only outputs are judged.  Arrays are whatever `np.asarray` reads.

    Raises     KeyError where `key` is no subject of the vectors
    """
    subject = next((s for s in read_manifest()["subjects"] if s["key"] == key), None)
    if subject is None:
        raise KeyError(
            f"{key!r}: expected one of {', '.join(s['key'] for s in read_manifest()['subjects'])}"
        )
    roles = ("out.", "in_bar.") if vjp else ("out.",)
    return Report(check_subject(published.read(subject), FunctionPort(forward, vjp), roles))
