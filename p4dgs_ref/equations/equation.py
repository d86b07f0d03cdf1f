"""What an equation of this project is, and the one table in which every equation is declared.

An equation is an explicit pair of functions:

    forward(**inputs) -> (Out, Res)     pure; Out and Res are NamedTuples; Res is what backward must remember
    backward(res, **cotangents) -> {input name: gradient}     linear in its cotangents

A cotangent bears the name of its output plus `_bar`; `None` stands for zero.  Lists of arrays (the
weights of a network, the levels of a hash grid) are allowed wherever an array is, and their gradient
is a list of the same length.

"Domain" in a docstring is where numbers are right to what `p4dgs_ref.studies.hard_cases.promises` says; there a NaN or an infinity
is never born of finite numbers.  What comes in as NaN or infinity makes what depends on it NaN, infinite or a limit, without
a word and in its own row alone, unless "Raises" or "Domain" say otherwise.
"""

from typing import Callable, NamedTuple

EQUATIONS: dict[str, "Equation"] = {}  # key -> equation, in order of declaration (paper order)

# Why a case exists: the bug that each flag hunts.  Cases name these words; nothing else may be a flag.
FLAGS = {
    "ordinary": "typical magnitudes, every axis of another length: a transposed or mixed-up axis",
    "zero": "an input is exactly zero: 0/0, log 0, a direction without length",
    "kink": "on a kink of the formula: the subgradient chosen here is another one",
    "tie": "half-way between two integers: rounding away from zero or down instead of to even",
    "tail": "far in the tail of the Gaussian: cancellation of two values near one, an infinite bit count",
    "narrow": "a bin much narrower than sigma: cancellation of two nearly equal values",
    "wide": "a bin much wider than sigma: log of a value that rounds to one",
    "saturated": "tanh or sigmoid rounds to its limit: an exact zero where a small number belongs",
    "masked": "masked entries: they cost nothing and receive nothing",
    "empty": "an axis of length zero: a mean over nothing, a shape that is lost",
    "single": "an axis of length one: an axis squeezed away",
    "extreme": "very large or very small magnitudes: overflow, underflow",
    "clamped": "beyond a clamp: the gradient of the clamp is forgotten",
    "outside": "outside the box, the frustum or the image: a read out of range",
    "behind": "behind the camera or before the near plane: a division by zero depth",
    "order": "equal depths: an unstable sort",
    "opaque": "opaque layers: division by one minus alpha",
    "normalise": "a quaternion that is zero or not of unit length: missing or unsafe normalisation",
    "negative": "a negative value where most are positive: a lost sign",
    "off": "an effect the scene does not list: a zero-width input or head that must cost nothing",
}


class Case(NamedTuple):
    """One named set of inputs on which an equation is tested and from which vectors are exported."""

    name: str
    inputs: dict
    flags: tuple = ("ordinary",)
    smooth: bool = (
        True  # False: on a kink; finite differences do not apply, `expected` says what holds
    )
    cotangents: dict = {}  # {"x_bar": array}: used with `expected` gradients; random ones otherwise
    expected: dict = {}  # closed forms: {"x": output} and {"x_a_bar": gradient}, checked to `tolerance`
    tolerance: float = 1e-12  # relative to the largest expected magnitude


class Equation(NamedTuple):
    """One row of the table of equations."""

    key: str  # stable name: module, vector, tutorial
    number: str  # as printed in the paper; "3'" by analogy; "" where the paper prints none
    formula: str  # one line of plain text for tables
    shapes: dict  # name -> axes, "A k 3"; "" is a scalar; "*I J" is a list of 2-d arrays
    differentiable: tuple  # names of the inputs that receive a gradient; the others are data
    forward: Callable
    backward: Callable
    cases: Callable  # () -> iterable of Case
    surrogate: (
        Callable | None
    )  # straight-through parts: surrogate(**base)(**inputs) -> Out, smooth near base
    rungs: dict  # other formulas for the same outputs, the default first: name -> forward
    module: str

    def __call__(self, **inputs):
        """The outputs alone."""
        return self.forward(**inputs)[0]

    def vjp(self, **inputs):
        """Outputs and pullback, in the order of `jax.vjp`: out, pullback(**cotangents) -> gradients."""
        out, res = self.forward(**inputs)
        return out, lambda **cotangents: self.backward(res, **cotangents)


def declare(
    key,
    number,
    formula,
    shapes,
    differentiable,
    forward,
    backward,
    cases,
    surrogate=None,
    rungs=None,
):
    """Register an equation once; tests, vectors, README and command line iterate over the table."""
    if key in EQUATIONS:
        raise ValueError(f"equation {key!r} is declared twice")
    EQUATIONS[key] = Equation(
        key,
        number,
        formula,
        shapes,
        tuple(differentiable),
        forward,
        backward,
        cases,
        surrogate,
        rungs or {},
        forward.__module__,
    )
    return EQUATIONS[key]
