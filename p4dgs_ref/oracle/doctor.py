"""Finds the known mistakes with which a port's wrong answers agree.

A known mistake is one way in which ports go wrong. `tests/golden/mistakes` defines each as a change
of behaviour and computes what a port with that mistake answers to the published cases. The folder
`mistakes_v1` holds these answers: `mistakes.json` lists the mistakes, and one compressed
safetensors file a subject holds every tensor that a mistake gets wrong, as
`<mistake>/<case>/<tensor>`. Tensors that are not in the file are right in spite of the mistake.
"""

import gzip
import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import safetensors
from .compare import differences, expected, precision

FOLDER = Path(__file__).with_name("mistakes_v1")
LENIENCE = 4  # factor on the bounds: a port may compute the same mistake in another way
HUGE = np.finfo(np.float32).max
ROLES = {"outputs": "out.", "gradients": "in_bar."}


class Mistake(NamedTuple):
    """A known mistake and its wrong answers."""

    id: str
    subject: str  # whose cases show it
    equation: str  # to blame
    description: str  # of what the port does wrong, addressed to its author
    answers: dict  # {case name: {"out.x": array}}


@cache
def known(subject):
    """Return the known mistakes of a subject."""
    rows = json.loads((FOLDER / "mistakes.json").read_text(encoding="utf-8"))
    found = {row["id"]: Mistake(**row, answers={}) for row in rows if row["subject"] == subject}
    if found:
        file = FOLDER / f"{subject}.safetensors.gz"
        arrays = safetensors.load(gzip.decompress(file.read_bytes()), file)
        for name, array in arrays.items():
            id, case, tensor = name.split("/")
            found[id].answers.setdefault(case, {})[tensor] = array
    return list(found.values())


def diagnose(subject, answers):
    """Return (`explain` of the answers, "").

    A port that was written by hand often has a mistake in one direction only. Where nothing
    explains all answers, the outputs or the gradients are explained by themselves, and the second
    value is "outputs" or "gradients".
    """
    found = explain(subject, answers)
    if found:
        return found, ""
    for part, role in ROLES.items():
        of_role = []
        for case, got, wrong in answers:
            tensors = {name: a for name, a in got.items() if name.startswith(role)}
            of_role.append((case, tensors, [name for name in wrong if name.startswith(role)]))
        if any(wrong for *_, wrong in of_role):
            found = explain(subject, of_role)
            if found:
                return found, part
    return [], ""


def explain(subject, answers):
    """Return the mistakes with which a port's answers agree best.

    `answers` lists (published case, {name: array}, names of the wrong tensors) of one subject, the
    right answers too. Returns [(mistake, number of cases explained, number of failing cases)].
    """
    found = []
    for mistake in known(subject):
        explained = failed = 0
        consistent = True
        for case, got, wrong in answers:
            agrees = _agrees(mistake, case, got, wrong)
            if wrong:
                failed += 1
                explained += agrees
            elif not agrees:  # the mistake would have shown in a case that the port gets right
                consistent = False
        if explained:
            found.append(((explained, consistent), mistake, failed))
    best = max((rank for rank, *_ in found), default=None)
    return [(mistake, rank[0], failed) for rank, mistake, failed in found if rank == best]


def _agrees(mistake, case, got, wrong):
    """Whether a port with this mistake would have answered like this.

    In a case that the port gets wrong, the mistake must show as well.
    """
    right = {name: a for name, a in expected(case.tensors).items() if name in got}
    shown = {n: a for n, a in mistake.answers.get(case.name, {}).items() if n in right}
    if not shown:
        return not wrong
    would = {**right, **shown}
    if any(a.shape != np.shape(got[name]) for name, a in would.items()):
        return False
    bound = case.tolerance(precision(got))
    scales = {name: a for name, a in case.tensors.items() if name.startswith("scale.")}
    if wrong and not any(differences({**right, **scales}, would, bound)):
        return False
    for name, a in would.items():
        if a.dtype.kind == "f":
            scales["scale." + name] = _largest(scales["scale." + name], a)
    wider = {name: LENIENCE * c if name.endswith("eps_S") else c for name, c in bound.items()}
    mine = {name: _without_nan(np.asarray(got[name])) for name in would}
    theirs = {name: _without_nan(a) for name, a in would.items()}
    return not any(differences({**theirs, **scales}, mine, wider))


def _without_nan(a):
    """Replace NaN by a very large number: mistakes may produce NaN, which must then agree."""
    return np.where(np.isnan(a), HUGE, a) if a.dtype.kind == "f" else a


def _largest(scale, values):
    """Return one S for the whole array, because a mistake may sum other terms than S describes."""
    size = np.abs(values)[np.isfinite(values) & (np.abs(values) < HUGE)]
    return np.full(values.shape, max(size.max(initial=0), scale.max(initial=0)))
