"""Finds the known mistakes with which a port's wrong answers agree.

A known mistake is one way in which ports go wrong. `tests/workshop/mistakes` defines each as a
change of behaviour and computes what a port with that mistake answers to the published cases. The
folder `mistakes_v1` contains these answers: `mistakes.json` lists the mistakes, and one compressed
safetensors file per subject contains every tensor that a mistake gets wrong, as
`<mistake>/<case>/<tensor>`. Tensors that are not in the file are right in spite of the mistake.
For a mistake's `noisy` cases, in which its answers are rounding noise, nothing is stored and any
answer agrees.

A mistake explains wrong answers if it agrees with all of them and shows in no tensor that the port
gets right. One that agrees with most of the failing cases is a hint. Weaker evidence is not
mentioned, because a wrong diagnosis costs more time than none: a mistake in the outputs is not
offered for gradients alone, and gradients say nothing if the outputs are wrong for an unknown
reason.
"""

import gzip
import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import safetensors
from .compare import PRECISIONS, deviations, precision, symmetric_parts

FOLDER = Path(__file__).with_name("mistakes_v1")
LENIENCE = 4  # factor on the bounds: a port may compute the same mistake in another way
NEARNESS = 64  # times nearer to the mistake's answer than to the right one
NAN_VALUE = np.finfo(np.float32).max  # a very large number, which stands for NaN
MIN_HINT_SHARE, MIN_HINT_CASES = 0.6, 3  # of the failing cases agree with a hint
ROLES = {"outputs": "out", "gradients": "in_bar"}
# Mistakes that need no stored answers: the right values times a factor.
FACTORS = {0: "is zero", -1: "has the wrong sign", 2: "is doubled", 0.5: "is halved"}


class Mistake(NamedTuple):
    """A known mistake and its wrong answers."""

    id: str  # "" for a factor
    subject: str  # whose cases show it
    equation: str  # to blame
    description: str  # of what the port does wrong, addressed to its author
    answers: dict  # {case name: {"out.x": array}}
    noisy: tuple = ()  # names of cases in which the mistake's answers are rounding noise


class Diagnosis(NamedTuple):
    """A mistake with which a port's wrong answers agree."""

    mistake: Mistake
    cases: tuple  # ids of the failing cases that agree
    failed: int  # number of failing cases
    part: str = ""  # "outputs" or "gradients" if only those were compared
    certain: bool = True  # whether all wrong answers are explained; otherwise it is a hint

    def __str__(self):
        text = self.mistake.description
        if self.mistake.id:
            text += f" [{self.mistake.id}]"
        if self.certain:
            return f"{text} (explains the {self.part} alone)" if self.part else text
        part = f"the {self.part} of " if self.part else ""
        return f"{text} (agrees with {part}{len(self.cases)} of {self.failed} failing cases)"


@cache
def known_mistakes(subject):
    """Return the known mistakes of a subject."""
    rows = json.loads((FOLDER / "mistakes.json").read_text(encoding="utf-8"))
    mistakes = {row["id"]: Mistake(**row, answers={}) for row in rows if row["subject"] == subject}
    if mistakes:
        file = FOLDER / f"{subject}.safetensors.gz"
        for name, array in safetensors.load(gzip.decompress(file.read_bytes())).items():
            id, case, tensor = name.split("/")
            mistakes[id].answers.setdefault(case, {})[tensor] = array
    return list(mistakes.values())


def diagnose(subject, answers):
    """Return the Diagnoses of a port's wrong answers, the most certain first.

    `answers` lists (published case, {name: array}, names of the wrong tensors) of one subject, the
    right answers too. Several mistakes may explain the same answers; then all are returned. A port
    that was written by hand often has a mistake in one direction only. Where no mistake explains
    all answers, the outputs are explained by themselves, and then the gradients.
    """
    # A tensor that is missing or extra neither agrees with a mistake nor contradicts it.
    answers = [
        (case, symmetric_parts(got), [n for n in wrong if n in got and n in case.tensors])
        for case, got, wrong in answers
    ]
    mistakes = known_mistakes(subject) + _scaling_mistake(answers)
    rows = explain(mistakes, answers)
    outputs, gradients = (_of(answers, role) for role in ROLES.values())
    of_outputs = _best(explain(mistakes, outputs, "outputs"))
    backward = [
        mistake
        for mistake in mistakes
        if not any(name.startswith("out.") for a in mistake.answers.values() for name in a)
    ]
    of_gradients = _best(explain(backward, gradients, "gradients"))
    explained = _best(rows)
    if not any(wrong for *_, wrong in gradients):  # a mistake in the outputs alone fits as well
        explained += of_outputs
    elif not explained and of_outputs and of_gradients:
        explained = of_outputs + of_gradients
    if explained:
        return _distinct(explained)
    hints = [
        row
        for row in sorted(rows, key=lambda row: len(row.cases), reverse=True)
        if len(row.cases) >= max(MIN_HINT_CASES, MIN_HINT_SHARE * row.failed)
    ]
    return [row._replace(certain=False) for row in _distinct(hints + of_outputs)]


def explain(mistakes, answers, part=""):
    """Return a Diagnosis of every mistake that agrees with a failing case and with all others."""
    failing, right = [row for row in answers if row[2]], [row for row in answers if not row[2]]
    diagnoses = [
        Diagnosis(
            mistake,
            tuple(row[0].id for row in failing if _agrees(mistake, *row)),
            len(failing),
            part,
        )
        for mistake in mistakes
    ]
    return [
        row
        for row in diagnoses
        # In a noisy case every answer agrees, so it is no evidence.
        if any(id.partition("/")[2] not in row.mistake.noisy for id in row.cases)
        and all(_agrees(row.mistake, *r) for r in right)
    ]


def _best(rows):
    """Return the diagnoses with which all failing cases agree; named mistakes before factors."""
    complete = [row for row in rows if len(row.cases) == row.failed]
    return [row for row in complete if row.mistake.id] or complete


def _distinct(rows):
    """Return the first diagnosis of every mistake."""
    ids = [row.mistake.id for row in rows]
    return [row for i, row in enumerate(rows) if ids.index(row.mistake.id) == i]


def _of(answers, prefix):
    """Return the answers of one role or quantity: "out", "in_bar.weights"."""

    def within(name):
        return (name + ".").startswith(prefix + ".")

    return [
        (case, {n: a for n, a in got.items() if within(n)}, [n for n in wrong if within(n)])
        for case, got, wrong in answers
    ]


def _scaling_mistake(answers):
    """Return the mistake of giving quantities multiplied by a factor, if the answers suggest one.

    Every wrong output or gradient has the factor with which most cases agree.
    """
    mistakes = []
    names = (name for *_, wrong in answers for name in wrong)
    for quantity in dict.fromkeys(".".join(name.split(".")[:2]) for name in names):
        rows = _of(answers, quantity)
        rows = explain([_times(factor, quantity, rows) for factor in FACTORS], rows)
        if rows:
            mistakes.append(max(rows, key=lambda row: len(row.cases)).mistake)
    together = {
        case.name: {n: a for mistake in mistakes for n, a in mistake.answers[case.name].items()}
        for case, *_ in answers
    }
    description = " and ".join(mistake.description for mistake in mistakes)
    return [m._replace(description=description, answers=together) for m in mistakes[:1]]


@np.errstate(all="ignore")
def _times(factor, quantity, answers):
    """Return the mistake of multiplying an output or a gradient by a factor."""
    (role, name), first = quantity.split("."), answers[0][0]
    part = "the output" if role == "out" else "the gradient of"
    scaled = {
        case.name: {
            n: factor * a for n, a in case.tensors.items() if n in got and a.dtype.kind == "f"
        }
        for case, got, _ in answers
    }
    return Mistake("", first.subject, first.equation, f"{part} {name} {FACTORS[factor]}", scaled)


def _agrees(mistake, case, got, wrong):
    """Return whether a port with this mistake would have answered a case like this."""
    stored = mistake.answers.get(case.name, {})
    bound = case.tolerance(precision(got))["eps_S"]

    def fits(name):
        numbers = got[name], stored[name], case.tensors[name], case.tensors.get("scale." + name)
        if name in wrong:
            return _is_mistake(*numbers, bound)
        return not _shows(*numbers, LENIENCE * bound)

    return case.name in mistake.noisy or (
        stored.keys() >= set(wrong) and all(fits(name) for name in stored.keys() & got.keys())
    )


@np.errstate(over="ignore")
def _shows(mine, would, right, scale, bound):
    """Return whether a port with this mistake would have failed in a tensor, in `mine`'s type."""
    if would.shape != right.shape or right.dtype.kind != "f":
        return not np.array_equal(would, right)
    return bool((deviations(would.astype(mine.dtype), right, scale, mine.dtype)[1] > bound).any())


@np.errstate(over="ignore")
def _is_mistake(mine, would, right, scale, bound):
    """Return whether a wrong tensor is the mistake's, and not the right one with fewer digits."""
    if mine.shape != would.shape or right.dtype.kind != "f":
        return np.array_equal(mine, would) and not np.array_equal(would, right)
    if mine.dtype.name not in PRECISIONS or not _shows(mine, would, right, scale, bound):
        return False
    if would.shape != right.shape:
        right, scale = np.full(would.shape, np.nan), np.zeros(would.shape)
    # A mistake may produce NaN, which must then agree.
    would = would.astype(mine.dtype)
    mine, would = (np.where(np.isnan(a), a.dtype.type(NAN_VALUE), a) for a in (mine, would))
    size = np.maximum(scale, np.abs(would)).astype(float)
    # A mistake may sum other terms than S describes: then the largest S of the array counts, as
    # long as the mistake changes the number by much more.
    largest = size[size < NAN_VALUE].max(initial=0)
    residual, scaled = deviations(mine, would, size, mine.dtype)
    _, coarse = deviations(mine, would, np.full(size.shape, largest), mine.dtype)
    effect, _ = deviations(would, right, scale, mine.dtype)
    error, units = deviations(mine, right, scale, mine.dtype)
    allowed, worst = LENIENCE * bound, units == units.max(initial=0)
    near = (scaled <= allowed) | (coarse <= allowed) & (NEARNESS * residual <= effect)
    return bool(near.all() and (NEARNESS * residual[worst] <= error[worst]).all())
