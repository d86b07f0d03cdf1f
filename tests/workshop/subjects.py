"""All subjects of the vectors, in the order in which data flows.

A subject is an equation of the paper or something that is called like one: a scalar function, a
stage of several equations, the pipeline.
"""

from functools import cache
from itertools import pairwise
from typing import Callable, NamedTuple

import numpy as np

from p4dgs_ref.oracle import published, tolerance
from p4dgs_ref.oracle.compare import cast, expected_tensors
from p4dgs_ref.splatting.table import EQUATIONS
from tests.workshop import shape_comments
from tests.workshop.cases import Case, cases_of
from tests.workshop.hard_cases import catalogue
from tests.workshop.sixty_digits.gradients import FORMULAS

# Numbers that an equation takes for granted.
CONSTANTS = {
    "rotation": {"EPSILON": 1e-12},
    "projection": {"near": 0.2, "blur": 0.3, "tan_clamp": 1.3},
    "compositing": {"occlusion": True, "alpha_max": 0.99},
    "ssim": {"C1": 0.0001, "C2": 0.0009},
    "step": {"FLOOR": 0.0009765625},
    "prior": {"RAW_MIN": -14.0, "RAW_MAX": 6.0},
    "rounding": {"LIMIT": 2147483648.0},
}


class Subject(NamedTuple):
    """One file of vectors."""

    key: str
    level: str
    equation: str  # the equation to blame where nothing before it fails
    number: str
    formula: str
    shapes: dict  # {name: axes}, see `shape_comments.manifest_shapes`
    gradients: tuple  # the inputs that receive a gradient
    vjp: Callable  # (**inputs) -> ({output: array}, pullback); pullback(**cotangents)
    cases: Callable  # () -> iterable of Case
    constants: dict = {}
    single: bool = False  # all inputs and cotangents are float32 numbers, and stored as such
    steady: tuple = ()  # inputs that decide something, and are not changed to measure S
    even: tuple = ()  # tensors in which all numbers have the S of the largest
    twins: tuple = ()  # like `answer`: other right evaluations, whose errors are allowed too
    group: str = ""  # of subjects that a port may leave out

    def __call__(self, **inputs):
        """Return {output: array}."""
        return self.vjp(**inputs)[0]

    def answer(self, inputs, cotangents):
        """Return outputs and gradients as flat tensors {"out.x": array, "in_bar.x_a": array}."""
        return tolerance.answer_of(self)(inputs, cotangents)


def no_pullback(**cotangents):
    """The pullback of a subject without gradients."""
    return {}


def as_published(key, vjp, added=lambda: (), **more):
    """Return a Subject whose declaration and cases are the published ones, then those of `added`.

    The inputs of its cases were drawn once by random numbers that mean nothing, so only the vectors
    have them. A new case is yielded by `added()`; once it is published, the vectors have it too.
    """
    row = published.subjects()[key]

    def frozen():
        dtype = np.float64 if more.get("single") else None
        for case in published.cases(key):
            inputs, cotangents = (cast(a, dtype) for a in (case.inputs(), case.cotangents()))
            flags = tuple(case.record["flags"])
            yield Case(case.name, inputs, flags, True, cotangents, closed_form(case))
        known = {case.name for case in published.cases(key)}
        yield from (case for case in added() if case.name not in known)

    return Subject(
        **{name: row[name] for name in ("key", "level", "equation", "number", "formula", "shapes")},
        gradients=tuple(row["differentiable"]),
        vjp=vjp,
        cases=frozen,
        constants=row["constants"],
        group=row.get("group", ""),
        **more,
    )


def closed_form(case):
    """Return the outputs and gradients of a published case that are closed forms, {name: array}."""
    if case.record["provenance"] != "closed form":
        return {}
    others = case.record.get("reference", ())
    known = {name: a for name, a in expected_tensors(case.tensors).items() if name not in others}
    return {n.split(".")[1] + "_bar" * n.startswith("in_bar."): a for n, a in known.items()}


def equation(key):
    """Return the subject of an equation of a table."""
    row = EQUATIONS[key]
    inputs = cases_of(key)[0].inputs  # names the inputs, and gives their order

    def cases():
        yield from cases_of(key)
        yield from catalogue.cases(key)

    return Subject(
        key,
        "L1",
        key,
        row.number,
        published.subjects().get(key, {}).get("formula", row.formula),  # what is published stays
        shape_comments.manifest_shapes(row.forward, inputs, row.outputs),
        tuple(name for name in inputs if name in row.gradients),
        row.vjp,
        cases,
        CONSTANTS.get(key, {}),
    )


def lacking(key):
    """Return one line on what an equation of a table still lacks, or None."""
    row = EQUATIONS[key]
    if not cases_of(key):
        return f"{key}: no cases in tests/workshop/cases/{key}.py"
    if key not in FORMULAS:
        return f"{key}: no formula in tests/workshop/sixty_digits"
    arguments = shape_comments.arguments(row.forward)
    unknown = {name for case in cases_of(key) for name in case.inputs if name not in arguments}
    if unknown:
        return f"{key}: its cases have {min(unknown)!r}, which is no argument of `forward`"
    specs = shape_comments.outputs(row.forward, row.outputs)
    unwritten = [name for name, spec in specs.items() if not spec.shapes]
    if unwritten:
        return f"{key}: no shape of {unwritten[0]} in the docstring of `forward`"
    return None


def flow():
    """Return the keys of all equations in the order in which data flows, that of the manifest.

    An equation that is not published yet follows the one before it in the table.
    """
    keys = [key for key, row in published.subjects().items() if row["level"] == "L1"]
    for before, key in pairwise(EQUATIONS):
        if key not in keys:
            keys.insert(keys.index(before) + 1, key)
    return keys


@cache
def subjects():
    """Return {key: Subject}, without equations that `lacking` names."""
    from tests.workshop import (
        encoding,
        kernel,
        pictures,
        pipeline,
        replay,
        scalars,
        scalars_coding,
        stages,
        stages_coding,
    )

    rows = [
        *scalars.SUBJECTS,
        *scalars_coding.SUBJECTS,
        *(equation(key) for key in flow() if not lacking(key)),
        *stages.SUBJECTS,
        *stages_coding.SUBJECTS,
        *kernel.SUBJECTS,
        *encoding.SUBJECTS,
        *pictures.SUBJECTS,
        *pipeline.SUBJECTS,
        *replay.SUBJECTS,
    ]
    by_key = {subject.key: subject for subject in rows}
    if len(by_key) < len(rows):
        raise ValueError("two subjects have one name")
    return by_key
