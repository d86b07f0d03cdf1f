"""Says in plain words how a student's answer differs from the right one."""

import math

import numpy as np

from ..oracle.checker import Report, check_subject, judge

ROLES = {"out": "the output", "in_bar": "the gradient of"}
NEARLY = 1e-6  # of a number: a smaller error comes from rounding, not from the formula


def of_port(cases, port, roles):
    """Return what is wrong with a port in its first wrong case, or "" if nothing is.

    The oracle's doctor sees the answers to all cases and names the mistake if it knows it.
    """
    with np.errstate(all="ignore"):
        first = Report(check_subject(cases, port, roles)).first
        if first is None:
            return ""
        case = next(case for case in cases if case.id == first.id)
        answers = judge(case, port, roles)[1]
    if not first.findings:
        return f"your function raised {first.explanation} (case {first.id})"
    known = first.explanation or first.hint
    finding, tensors = first.findings[0], case.tensors
    lengths = () if known else {n for tensor in tensors.values() for n in tensor.shape}
    said = [of_tensor(finding, answers, tensors, lengths)]
    if known:
        said.append(f"It looks like this: {known}")
    if finding.kind == "value":
        place = str(list(finding.index)) if finding.index else "the number"
        said.append(f"Case {case.id}: {place} is {finding.got:.12g}, not {finding.want:.12g}")
    return "\n  ".join(said)


def of_tensor(finding, answers, tensors, lengths):
    """Return what is wrong with one output or gradient of a case."""
    role, name = finding.tensor.split(".", 1)
    whose = f"{ROLES[role]} {name}"
    if finding.kind == "value" and finding.relative and finding.relative < NEARLY:
        return f"{whose} has too few right digits: {digits(finding)}"
    if finding.kind == "value":
        mine, right = answers[finding.tensor], tensors[finding.tensor]
        return f"{whose}: {difference(mine, right, lengths)}"
    return f"{whose}: {finding.kind}: {finding.message}"


def digits(finding):
    """Explain the oracle's measure of accuracy, for an answer that is nearly right."""
    return (
        f"its error is {finding.scaled:.3g} eps S, and {finding.bound:g} eps S are allowed; eps is "
        "the distance from 1 to the next float, and S the size of the terms of the sum"
    )


def of_number(mine, right):
    """Return what is wrong with a short answer, without giving the right one away."""
    factor = common_factor(mine, right)
    telling = factor is not None and abs(factor) in (0, 0.5, 1, 2)
    return difference(mine, right) if right.size > 1 or telling else "it is wrong"


def difference(mine, right, lengths=()):
    """Return how an array differs from the right one; `lengths` are those of axes in the sum."""
    mine, right = np.asarray(mine, float), np.asarray(right, float)
    factor = common_factor(mine, right)
    them = f"all {right.size} numbers are" if right.size > 1 else "it is"
    if factor is not None:
        return f"{them} {in_words(factor, lengths)}"
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
    return float(factors[0]) if same else None


def in_words(factor, lengths=()):
    """Return a factor in words, with a guess at its cause."""
    if factor == 0:
        return "zero"
    n = max(abs(factor), 1 / abs(factor))
    said = []
    if not math.isclose(n, 1, rel_tol=NEARLY):
        said.append(f"too {'large' if abs(factor) > 1 else 'small'} by a factor of {n:.6g}")
    if factor < 0:
        said.append("of the wrong sign")
    guess = ""
    if math.isclose(n, 1 / math.log(2), rel_tol=NEARLY):
        guess = ": it looks like natural logarithms where bits are meant, or the reverse"
    elif n > 1.5 and any(math.isclose(n, length, rel_tol=NEARLY) for length in lengths):
        kind = ("sum", "mean") if abs(factor) > 1 else ("mean", "sum")
        guess = f": it looks like a {kind[0]} over {n:.0f} numbers where a {kind[1]} is meant"
    return " and ".join(said) + guess
