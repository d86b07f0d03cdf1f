"""Says in plain words how a student's answer differs from the right one."""

import math

import numpy as np

from ...oracle.checker import Report, check_subject

ROLES = {"out": "the output", "in_bar": "the gradient of"}
NEARLY = 1e-6  # of a number: a smaller error comes from rounding, not from the formula
# The oracle's measure of accuracy, for an answer that is nearly right.
DIGITS = (
    "its error is {:.3g} eps S, and {:g} eps S are allowed; eps is the distance from 1 to the next "
    "float, and S the size of the terms of the sum"
)


def of_port(cases, port, roles):
    """Return what is wrong with a port in its first wrong case, or "" if nothing is.

    The oracle's doctor sees the answers to all cases and names the mistake if it knows it.
    """
    with np.errstate(all="ignore"):
        first = Report(check_subject(cases, port, roles)).first
        if first is None:
            return ""
        if not first.findings:
            return f"your function raised {first.explanation} (case {first.id})"
        case = next(case for case in cases if case.id == first.id)
        mine = port.run(case)
    finding, known = first.findings[0], first.explanation or first.hint
    role, name = finding.tensor.split(".", 1)
    said = f"{ROLES[role]} {name}: {of_finding(finding, mine, case.tensors, known)}"
    if known:
        said += f"\n  It looks like this: {known}"
    if finding.kind == "value":
        place = list(finding.index) or "the number"
        said += f"\n  Case {case.id}: {place} is {finding.got:.12g}, not {finding.want:.12g}"
    return said


def of_finding(finding, mine, right, known):
    """Return what is wrong with one output or gradient; `known` is the doctor's diagnosis."""
    if finding.kind != "value":
        return f"{finding.kind}: {finding.message}"
    if finding.relative is None or finding.relative >= NEARLY:
        return difference(mine[finding.tensor], right[finding.tensor])
    measure = DIGITS.format(finding.scaled, finding.bound)
    return "too few right digits" + ("" if known else f": {measure}")


def of_number(mine, right):
    """Return what is wrong with a short answer, without giving the right one away."""
    factor = common_factor(mine, right)
    telling = factor is not None and abs(factor) in (0, 0.5, 1, 2)
    return difference(mine, right) if right.size > 1 or telling else "it is wrong"


def difference(mine, right):
    """Return how an array differs from the right one of the same shape."""
    mine, right = np.asarray(mine, float), np.asarray(right, float)
    factor = common_factor(mine, right)
    them = f"all {right.size} numbers are" if right.size > 1 else "it is"
    if factor is not None:
        return f"{them} {in_words(factor)}"
    if right.size == 1:
        return "it is wrong"
    wrong = ~np.isclose(mine, right, NEARLY, 0)
    return f"{wrong.sum()} of {right.size} numbers are wrong"


def common_factor(mine, right):
    """Return the factor between all numbers and the right ones, or None if there is none."""
    with np.errstate(all="ignore"):
        factors = mine[right != 0] / right[right != 0]
    if not factors.size or not np.isfinite(factors).all() or mine[right == 0].any():
        return None
    same = np.ptp(factors) <= NEARLY * np.abs(factors).max()
    return float(factors[0]) if same and abs(factors[0] - 1) > NEARLY else None


def in_words(factor):
    """Return in words how numbers that are wrong by a factor differ from the right ones."""
    if factor == 0:
        return "zero"
    sign = "of the opposite sign"
    n = max(abs(factor), 1 / abs(factor))
    if math.isclose(n, 1, rel_tol=NEARLY):
        return sign
    size = f"too {'large' if abs(factor) > 1 else 'small'} by a factor of {n:.6g}"
    return f"{size} and {sign}" if factor < 0 else size
