"""What the oracle tests, in the order in which data flows: every subject is an equation, or something called like one."""

from typing import NamedTuple

import numpy as np

from .. import splatting  # noqa: F401  declares covariance, projection, compositing
from ..equations import EQUATIONS
from ..equations.equation import Equation
from .pipeline import SUBJECTS_L4
from .scalars import SUBJECTS_L0
from .stages import SUBJECTS_L2

# Rendering first: anchors -> canonical Gaussians -> Gaussians at t -> image -> loss; then coding: context -> bits -> loss.
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
LEVELS = {
    "L0": "scalars",
    "L1": "one equation",
    "L2": "a stage",
    "L3": "the codec",
    "L4": "the pipeline",
}


class Subject(NamedTuple):
    """One file of vectors."""

    key: str  # name of the file
    level: str
    equation: str  # the equation to blame when nothing before it fails
    eq: Equation

    def cases(self):
        """The equation's own cases, then those of the catalogue of hard cases."""
        yield from self.eq.cases()
        if self.level == "L1":
            from tests.golden.hard_cases.catalogue import cases

            yield from cases(self.key)


def subjects():
    """{key: Subject} in the order in which reports are written."""
    found = [Subject(eq.key, "L0", blamed, eq) for blamed, eq in SUBJECTS_L0]
    found += [Subject(key, "L1", key, EQUATIONS[key]) for key in FLOW]
    found += [
        Subject(eq.key, level, blamed, eq)
        for level, rows in (("L2", SUBJECTS_L2), ("L4", SUBJECTS_L4))
        for blamed, eq in rows
    ]
    by_key = {subject.key: subject for subject in found}
    if len(by_key) < len(found) or set(FLOW) != set(EQUATIONS):
        raise ValueError("two subjects have one name, or FLOW and the table of equations differ")
    return by_key


# --- inputs and outputs as flat, named tensors -------------------------------------------------------------------
def flatten(values, prefix=""):
    """{"weights": [W0, W1], "x": x} -> {"weights.0": W0, "weights.1": W1, "x": x}; settings and absent outputs left out."""
    flat = {}
    for name, value in values.items():
        if isinstance(value, list):
            flat.update({f"{prefix}{name}.{i}": np.asarray(a) for i, a in enumerate(value)})
        elif isinstance(value, (np.ndarray, np.generic)):
            flat[prefix + name] = np.asarray(value)
    return flat


def settings(inputs):
    """The inputs that are no tensors: Python's numbers, texts and tuples."""
    return {
        name: value
        for name, value in inputs.items()
        if not isinstance(value, (list, np.ndarray, np.generic))
    }


def run(eq, inputs, cotangents):
    """Outputs and gradients of one call: ({name: output}, {name: gradient})."""
    out, res = eq.forward(**inputs)
    gradients = eq.backward(res, **cotangents) if eq.differentiable else {}
    return out._asdict(), {name: gradients[name] for name in eq.differentiable}
