"""Which known mistake explains a port's numbers?  Every one is tried on every case that the port answered."""

import numpy as np

from .compare import compare, expected, precision
from .mistakes import MISTAKES, NotApplicable
from .tolerance import named

LENIENCE = 4  # a mistake's numbers are computed another way than the port's: its bounds are this much wider
HUGE = np.finfo(np.float32).max


ROLES = {"outputs": ("out.",), "gradients": ("in_bar.",)}


def diagnose(subject, answers):
    """`explain` of all that was answered; if nothing explains that, of outputs or gradients: (mistakes, which alone).

    A port that was written by hand often has the mistake in one direction only.
    """
    found = explain(subject, answers)
    for part, roles in ROLES.items() if not found else ():
        one = [
            (
                case,
                {n: a for n, a in got.items() if n.startswith(roles)},
                [n for n in wrong if n.startswith(roles)],
            )
            for case, got, wrong in answers
        ]
        if any(wrong for *_, wrong in one) and (found := explain(subject, one)):
            return found, part
    return found, ""


def explain(subject, answers):
    """The mistakes with which a port's answers agree, the best first: [(mistake, cases explained, cases that fail)].

    Shapes     answers [(case of the vectors, got {name: array}, names of its wrong tensors)] of one subject, right ones too
    """
    found = []
    for mistake in MISTAKES:
        if mistake.subject != subject:
            continue
        agreed = failed = 0
        contradicted = False
        for case, got, wrong in answers:
            agrees = _agrees(mistake, case, got, wrong)
            failed += bool(wrong)
            agreed += bool(wrong) and agrees
            contradicted |= (
                not wrong and not agrees
            )  # the mistake would have shown in a case that is right
        if agreed:
            found.append((agreed, not contradicted, mistake, failed))
    found.sort(key=lambda row: row[:2], reverse=True)
    best = found[0][:2] if found else None
    return [
        (mistake, agreed, failed)
        for agreed, clean, mistake, failed in found
        if (agreed, clean) == best
    ]


def _agrees(mistake, case, got, wrong):
    """Whether a port with this mistake would have answered so; where the port is wrong, the mistake must show as well."""
    try:
        with np.errstate(all="ignore"):
            would = named(*mistake.run(case.inputs(), case.cotangents()))
    except NotApplicable:
        return False
    asked = [name for name in expected(case.tensors) if name in got]
    if any(name not in would or would[name].shape != np.shape(got[name]) for name in asked):
        return False
    tensors = {name: _number(would[name]) for name in asked}
    tensors.update(
        {
            f"scale.{name}": _largest(case.tensors[f"scale.{name}"], a)
            for name, a in tensors.items()
            if a.dtype.kind == "f"
        }
    )
    mine = {name: np.asarray(got[name]) for name in asked}
    bound = case.tolerance(precision(got))
    if wrong:
        truth = {
            name: a
            for name, a in case.tensors.items()
            if name in asked or name.startswith("scale.")
        }
        if not compare(truth, {name: would[name] for name in asked}, bound):
            return False
    bound = {name: LENIENCE * c if name.endswith("eps_S") else c for name, c in bound.items()}
    return not compare(tensors, {name: _number(a) for name, a in mine.items()}, bound)


def _number(a):
    """A NaN agrees with a NaN here: a mistake may well make them."""
    return np.where(np.isnan(a), np.finfo(a.dtype).max, a) if a.dtype.kind == "f" else a


def _largest(scale, values):
    """One S for the whole array: a mistake sums other terms than those that S was measured on."""
    size = np.where(np.isfinite(values) & (np.abs(values) < HUGE), np.abs(values), 0)
    return np.full(values.shape, max(size.max(initial=0), scale.max(initial=0)))
