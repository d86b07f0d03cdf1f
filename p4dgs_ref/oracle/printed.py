"""What the printed formulas give on the cases for which they have too few digits.

A few cases ask for more than the paper's formulas give as they are printed and differentiated by
the textbook: tanh has the slope 1 - tanh(y)**2, which cancels where tanh is close to 1, and the
square of a long vector overflows. A port on stock automatic differentiation has the right formula
and misses these cases. `tests/golden/printed.py` measures by how much, and this file holds:

    <precision>/<subject>/<case>/scale.out.x    the scale S of the printed formula
    <precision>/<subject>/<case>/range.out.x    where it leaves the range of the precision: there
                                                0, an infinity or NaN is what it leaves
"""

from functools import cache
from pathlib import Path

import numpy as np

from . import safetensors
from .compare import precision

FILE = Path(__file__).with_name("printed_v1.safetensors")

SIGMOID = "sigmoid'(y) = sigmoid(y) sigmoid(-y)"
UNIT = (
    "|r| by hypot, without squares, and for the gradient the part of r_bar perpendicular to the "
    "unit vector n, sum over j of (r_bar_i n_j - n_i r_bar_j) n_j"
)
# What keeps the digits, and for which subjects.
RECIPES_FOR = {
    "tanh'(y) = 4 e / (1 + e)^2 with e = exp(-2 |y|)": ("tanh", "opacity"),
    SIGMOID: ("sigmoid", "color", "scale"),
    UNIT: ("unit_quaternion", "rotation", "deformed", "rotation_4d"),
    f"{SIGMOID}; {UNIT}": ("activations",),
    "q = 2 Q_0 sigmoid(2 u) above its floor, with the slope 4 Q_0 sigmoid(2 u) sigmoid(-2 u)": (
        "step_floor",
        "step",
    ),
    "delta_vc by hypot, without squares": ("view",),
    "1 - SSIM = mean(l + s - l s) with e = image - truth, l = mu_e^2 / (mu_x^2 + mu_y^2 + C1), "
    "s = var_e / (var_x + var_y + C2)": ("ssim", "render_loss"),
    "Sigma_t = Y Y^T, where the rows of Y are those of R diag(s) for x, y and z without their "
    "components along its last row": ("conditional",),
}
RECIPES = {subject: recipe for recipe, of in RECIPES_FOR.items() for subject in of}


@cache
def measured():
    """Return {case id and precision: {name: array}} of the file."""
    cases = {}
    for name, array in safetensors.load(FILE.read_bytes(), FILE).items():
        precise, subject, case, tensor = name.split("/")
        cases.setdefault((f"{subject}/{case}", precise), {})[tensor] = array
    return cases


def as_printed(case, got):
    """Return a case with the scales of the printed formula, and an answer in its range.

    Where the formula leaves the range, infinities, NaN and what is as good as 0 are replaced by the
    expected numbers; anything else is judged.
    """
    mine, precise = dict(got), precision(got)
    stored = measured().get((case.id, precise), {})
    scales = {name: a for name, a in stored.items() if name.startswith("scale.")}
    for name in stored.keys() - scales.keys():
        a, tensor = stored[name], name.removeprefix("range.")
        if tensor in mine and np.shape(mine[tensor]) == a.shape:
            least = np.finfo(precise).eps * case.tensors["scale." + tensor]
            kept = np.isfinite(mine[tensor]) & (np.abs(mine[tensor]) > least)
            right = case.tensors[tensor].astype(mine[tensor].dtype)
            mine[tensor] = np.where(a & ~kept, right, mine[tensor])
    return case._replace(tensors=case.tensors | scales), mine
