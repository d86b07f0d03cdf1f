"""The named inputs on which every equation is tested and from which its vectors are published.

One module per equation, `cases/<key>.py`, with a function `cases()` that yields `Case`s.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

# The bug that each flag hunts. A case names only words of this table. Its texts are published with
# the vectors.
FLAGS = {
    "ordinary": "typical magnitudes, every axis of another length: a transposed or mixed-up axis",
    "zero": "an input is exactly zero: 0/0, log 0, a direction without length",
    "kink": "on a kink of the formula: the subgradient chosen here is another one",
    "tie": "half-way between two integers: rounding away from zero or down instead of to even",
    "tail": (
        "far in the tail of the Gaussian: "
        "cancellation of two values near one, an infinite bit count"
    ),
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
    "replay": "steps from a given state: moments, masks or sums that are not carried along",
    "off": "an effect the scene does not list: a zero-width input or head that must cost nothing",
}


class Case(NamedTuple):
    """One named set of inputs."""

    name: str
    inputs: dict
    flags: tuple = ("ordinary",)
    # False on a kink: finite differences do not apply there, and `expected` says what holds.
    smooth: bool = True
    # Cotangents {"x_bar": array} that belong to the expected gradients; those left out are zero.
    cotangents: dict = {}
    # Closed forms of outputs {"x": array} and gradients {"x_a_bar": array}.
    expected: dict = {}
    # How closely they are met, relative to the largest expected magnitude.
    tolerance: float = 1e-12


def one(x):
    """x as an array without axes."""
    return np.asarray(x, float)


def without_view(inputs):
    """The same anchor network in a scene without view effects: no view columns, no view weights."""
    d = inputs["f_a"].shape[1]
    return {
        **inputs,
        "delta_vc": inputs["delta_vc"][:, :0],
        "d_vc": inputs["d_vc"][:, :0],
        "weights": [inputs["weights"][0][:d], *inputs["weights"][1:]],
    }


def cases_of(key):
    """The cases of the equation with that key; none where it has no file of cases."""
    module = f"{__name__}.{key}"
    return list(import_module(module).cases()) if find_spec(module) else []


def case_of(key, name="ordinary"):
    """A case by the key of its equation and its own name."""
    for case in cases_of(key):
        if case.name == name:
            return case
    raise LookupError(f"{key}: no case {name!r} in tests/workshop/cases/{key}.py")
