"""Expected numbers that do not come from the code they judge.

They are closed forms, and 60-digit decimals rounded once.
"""

from decimal import Decimal

import numpy as np

from p4dgs_ref.oracle.published import flatten
from tests.workshop.sixty_digits import gradient, to_float, value
from tests.workshop.sixty_digits.functions import log, working

# How many numbers receive a gradient in decimals, at most; each costs four evaluations. Beyond it,
# and for windows over whole images, the gradients stored are the reference's.
# `python -m tests.workshop.sixty_digits.record` judges samples of those too.
FEW, MANY = 60, 260
EXACT = 1e-12  # a closed form that is met less closely checks the code, but is not published
CULLED = ("no_determinant", "infinite_determinant")  # decimals see what floats cull
SLOW = ("ssim", "render_loss")


def values(subject, case, cotangents, flat):
    """Return what is published in place of the reference's numbers `flat`.

    Returns {name: array}, the provenance, and the names of the tensors that stay the reference's.
    """
    closed = {}
    if case.tolerance <= EXACT:
        closed = {n: a for n, a in _closed(case, cotangents).items() if n in flat}
    digits = {}
    if subject.key == "gaussian_bin":
        digits = _bin(**case.inputs)
    elif subject.level == "L1" and case.name not in CULLED:
        digits = _decimals(subject, case, cotangents)
    better = {}
    for name, a in {**digits, **closed}.items():
        # Decimals give no gradient on a kink, but NaN.
        if flat[name].dtype.kind == "f" and not np.isnan(a).any():
            better[name] = np.asarray(a, flat[name].dtype).reshape(flat[name].shape)
    provenance = "closed form" if closed else "high-precision" if better else "reference"
    floats = [name for name, a in flat.items() if a.dtype.kind == "f" and a.size]
    return better, provenance, [name for name in floats if name not in better] if better else []


def _closed(case, cotangents):
    """Return the case's closed forms; those of gradients hold for its own cotangents only."""
    given = set(case.cotangents) >= set(cotangents)
    outputs, gradients = {}, {}
    for name, a in case.expected.items():
        if not name.endswith("_bar"):
            outputs[name] = a
        elif given:
            gradients[name.removesuffix("_bar")] = a
    return {**flatten(outputs, "out."), **flatten(gradients, "in_bar.")}


def _decimals(subject, case, cotangents):
    """Return values, and gradients where the formula is smooth and they do not take long."""
    tensors = flatten(_floats(value(subject.key, case.inputs)), "out.")
    asked = {name: case.inputs[name] for name in subject.gradients}
    count = sum(a.size for a in flatten(asked).values())
    most = MANY if case.name == "ordinary" else FEW
    if case.smooth and 0 < count <= most and subject.key not in SLOW:
        tensors.update(flatten(_floats(gradient(subject.key, case.inputs, cotangents)), "in_bar."))
    return tensors


def _floats(decimals):
    floats = {}
    for name, a in decimals.items():
        if a is not None:
            floats[name] = [to_float(b) for b in a] if isinstance(a, list) else to_float(a)
    return floats


def _bin(z, w):
    """Return the scalar subject of Eq. (11) from the equation at mu = 0, sigma = 1.

    log p is -ln 2 times its bits.
    """
    column = np.ones((len(z), 1))
    inputs = dict(f_noisy=z[:, None], mu=0 * column, sigma=column, q=w[:, None])
    slopes = gradient("likelihood", inputs, {"bits_bar": column})
    tensors = {
        "log_p": value("likelihood", inputs)["bits"],
        "slope_z": slopes["f_noisy"],
        "slope_w": slopes["q"],
    }
    with working():
        ln_2 = log(Decimal(2))
        return {f"out.{name}": to_float(-a[:, 0] * ln_2) for name, a in tensors.items()}
