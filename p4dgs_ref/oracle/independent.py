"""Expected numbers that do not come from the code they judge: closed forms, and 60-digit decimals rounded once."""

from decimal import Decimal

import numpy as np

from .subjects import flatten

# Numbers that receive a gradient, at most: each costs four evaluations in decimals.  Beyond it, and for windows over whole
# images, the gradients stored are the reference's; `python -m tests.golden.sixty_digits.record` judges samples of those too.
FEW, MANY = 60, 260
EXACT = 1e-12  # a closed form that is less sure of itself checks the code, but is no golden number
CULLED = (
    "no_determinant",
    "infinite_determinant",
)  # decimals see what floats cull, as projection declares
SLOW = ("ssim", "render_loss")


def values(subject, case, cotangents, flat):
    """({name: array} to store instead of the reference's, provenance, names that stay the reference's).

    Shapes     flat {"out.x": array, "in_bar.x": array}: the reference's numbers, and with them the names wanted
    """
    closed = {
        name: a
        for name, a in _closed(case, cotangents).items()
        if name in flat and case.tolerance <= EXACT
    }
    digits = (
        _decimals(subject, case, cotangents)
        if subject.level == "L1" and case.name not in CULLED
        else {}
    )
    digits = _bin(**case.inputs) if subject.key == "gaussian_bin" else digits
    better = {name: a for name, a in {**digits, **closed}.items() if flat[name].dtype.kind == "f"}
    better = {
        name: np.asarray(a, flat[name].dtype).reshape(flat[name].shape)
        for name, a in better.items()
        if not np.isnan(a).any()
    }  # decimals give no gradient on a kink
    floats = [name for name, a in flat.items() if a.dtype.kind == "f" and a.size]
    provenance = "closed form" if closed else "high-precision" if better else "reference"
    return better, provenance, [name for name in floats if name not in better] if better else []


def _closed(case, cotangents):
    """The case's closed forms; those of gradients hold for its own cotangents only."""
    given = set(case.cotangents) >= set(cotangents)
    out = {name: a for name, a in case.expected.items() if not name.endswith("_bar")}
    back = {name[:-4]: a for name, a in case.expected.items() if name.endswith("_bar") and given}
    return {**flatten(out, "out."), **flatten(back, "in_bar.")}


def _decimals(subject, case, cotangents):
    """Values in decimals; gradients too, where the formula is smooth and they do not take long."""
    from tests.golden.sixty_digits import gradient, value

    found = flatten(_floats(value(subject.key, case.inputs)), "out.")
    asked = {name: case.inputs[name] for name in subject.eq.differentiable}
    count = sum(a.size for a in flatten(asked).values())
    if (
        case.smooth
        and count
        and subject.key not in SLOW
        and count <= (MANY if case.name == "ordinary" else FEW)
    ):
        found.update(flatten(_floats(gradient(subject.key, case.inputs, cotangents)), "in_bar."))
    return found


def _floats(decimals):
    from tests.golden.sixty_digits import to_float

    return {
        name: [to_float(b) for b in a] if isinstance(a, list) else to_float(a)
        for name, a in decimals.items()
        if a is not None
    }


def _bin(z, w):
    """The scalar subject of Eq. (11) from the equation at mu = 0, sigma = 1: log p is -ln 2 times its bits."""
    from tests.golden.sixty_digits import gradient, to_float, value
    from tests.golden.sixty_digits.functions import log, working

    column = np.ones((len(z), 1))
    inputs = dict(f_noisy=z[:, None], mu=0 * column, sigma=column, q=w[:, None])
    slopes = gradient("likelihood", inputs, {"bits_bar": column})
    found = {
        "log_p": value("likelihood", inputs)["bits"],
        "slope_z": slopes["f_noisy"],
        "slope_w": slopes["q"],
    }
    with working():
        ln_2 = log(Decimal(2))
        return {f"out.{name}": to_float(-a[:, 0] * ln_2) for name, a in found.items()}
