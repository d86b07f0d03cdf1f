"""All subjects of the vectors, in the order in which data flows.

A subject is an equation of the paper, of a baseline or of the coded design, or something that is
called like one: a scalar function, a stage of several equations, the pipeline.
"""

from functools import cache
from typing import Callable, NamedTuple

from p4dgs_ref.beyond import BEYOND
from p4dgs_ref.lab.baselines import ALL_EQUATIONS, BASELINE_EQUATIONS
from p4dgs_ref.oracle import tolerance
from p4dgs_ref.table import EQUATIONS
from tests.golden.cases import cases_of
from tests.golden.declared import CONSTANTS, FORMULAS, GRADIENTS, SHAPES
from tests.golden.hard_cases import catalogue

# Rendering comes first: anchors -> canonical Gaussians -> Gaussians at t -> image -> loss.
# Coding follows: context -> bits -> loss.
FLOW = (
    "mlp",
    "view",
    "offsets",
    "opacity",
    "color",
    "rotation",
    "scale",
    "masking",
    "positional_encoding",
    "deformation",
    "deformed",
    "covariance",
    "projection",
    "compositing",
    "ssim",
    "render_loss",
    "hash_grid",
    "step",
    "prior",
    "noise",
    "rounding",
    "likelihood",
    "anchor_rate",
    "hash_rate",
    "rate_loss",
    "total_loss",
)
OPTIONAL = {"baselines": BASELINE_EQUATIONS, "beyond": BEYOND}  # a port may leave them out


class Subject(NamedTuple):
    """One file of vectors."""

    key: str
    level: str
    equation: str  # the equation to blame where nothing before it fails
    number: str
    formula: str
    shapes: dict  # {name: axes}, see `declared`
    gradients: tuple  # the inputs that receive a gradient
    vjp: Callable  # (**inputs) -> ({output: array}, pullback); pullback(**cotangents)
    cases: Callable  # () -> iterable of Case
    constants: dict = {}
    # Where a gradient is straight-through: surrogate(**base)(**inputs) returns the outputs of a
    # function whose derivative at `base` is that gradient.
    surrogate: Callable | None = None
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


def equation(key):
    """Return the subject of an equation of a table."""
    row = ALL_EQUATIONS[key]

    def cases():
        yield from cases_of(key)
        yield from catalogue.cases(key)

    return Subject(
        key,
        "L1",
        key,
        row.number,
        FORMULAS.get(key, row.formula),
        SHAPES[key],
        GRADIENTS.get(key, row.gradients),
        row.vjp,
        cases,
        CONSTANTS.get(key, {}),
        group=next((group for group, table in OPTIONAL.items() if key in table), ""),
    )


@cache
def subjects():
    """Return {key: Subject}."""
    from tests.golden import (
        encoding,
        kernel,
        pipeline,
        replay,
        scalars,
        scalars_coding,
        stages,
        stages_coding,
    )

    found = [
        *scalars.SUBJECTS,
        *scalars_coding.SUBJECTS,
        *(equation(key) for key in (*FLOW, *BASELINE_EQUATIONS, *BEYOND)),
        *stages.SUBJECTS,
        *stages_coding.SUBJECTS,
        *kernel.SUBJECTS,
        *encoding.SUBJECTS,
        *pipeline.SUBJECTS,
        *replay.SUBJECTS,
    ]
    by_key = {subject.key: subject for subject in found}
    if len(by_key) < len(found) or set(FLOW) != set(EQUATIONS):
        raise ValueError("two subjects have one name, or FLOW and the table of equations differ")
    return by_key
