"""One entry of the catalogue of hard cases."""

from typing import Callable, NamedTuple

import numpy as np

from p4dgs_ref.oracle import tolerance
from p4dgs_ref.oracle.compare import change_floats
from p4dgs_ref.splatting.table import EQUATIONS
from tests.workshop.cases import Case

DTYPES = ("float64", "float32")
# The bound of most entries in eps: a few roundings of terms a few times larger than their sum.
FEW = 64


class Entry(NamedTuple):
    """One row of the catalogue with one of its inputs."""

    id: str  # "H-R1.6sigma": the row, then which of its inputs
    equation: str  # its key
    says: str  # what is hard, and what the column "literal" shows
    case: Case
    shown: tuple  # (array, index) of the number in the table
    literal: Callable  # the usual formula, of inputs and cotangents
    bounds: dict  # {dtype: [of the outputs, of the gradients or None]}, relative
    each: bool  # outputs relative to each number, otherwise to the largest of the array


def single(value):
    """The nearest float32 numbers, as float64: both precisions get the same input."""
    return np.asarray(value, np.float32).astype(np.float64)


def hard(
    id,
    key,
    says,
    inputs,  # in float64
    shown,
    literal,
    flags,
    expected=None,  # closed forms
    smooth=True,
    value=None,  # bound of the outputs in float64 and float32
    grad=None,  # bound of the gradients likewise
    each=True,
):
    """An entry that is a case of an equation."""
    eq = EQUATIONS[key]
    inputs = change_floats(inputs, single)
    case = Case(id, inputs, flags, smooth, cotangents_of(eq, id, inputs), expected or {})
    few = [FEW * float(np.finfo(dtype).eps) for dtype in DTYPES]
    bounds = {
        dtype: [of_value, of_grad if eq.gradients else None]
        for dtype, of_value, of_grad in zip(DTYPES, value or few, grad or few)
    }
    return Entry(id, key, says, case, shown, literal, bounds, each)


def cotangents_of(eq, id, inputs):
    """Normal numbers that float32 holds, the same in every run, for every float output."""
    with np.errstate(all="ignore"):
        outputs = eq(**inputs)
    return {name: single(a) for name, a in tolerance.cotangents_of(eq, outputs, id).items()}
