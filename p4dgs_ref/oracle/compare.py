"""Judges a port's answer to one case: names, shapes and types first, then every number.

A float is right within c eps S, where S is stored beside it in the vectors and c is the case's
tolerance `eps_S` for the port's precision; `tolerance.py` says how both were measured.
"""

from typing import NamedTuple

import numpy as np

# Images have one S for all pixels, a bound for the worst pixel and one for the root mean square.
IMAGES = ("image", "images")
PRECISIONS = {"f8": "float64", "f4": "float32"}


class Finding(NamedTuple):
    """What is wrong with one tensor. The numbers are those of its worst element."""

    tensor: str
    kind: str  # missing, extra, shape, dtype or value
    message: str
    index: tuple = ()
    got: float | None = None
    want: float | None = None
    absolute: float | None = None
    relative: float | None = None
    scaled: float | None = None  # |got - want| / (eps S)
    bound: float | None = None  # the largest `scaled` that is allowed


class Result(NamedTuple):
    """The verdict on one case."""

    id: str
    equation: str
    level: str
    # pass; fail; acceptable (the printed formula is no better here or, where the case is not
    # required, another answer is defensible); unasked (the case is not checked in this precision);
    # or the kind of a PortError
    verdict: str
    required: bool
    findings: tuple = ()  # of Finding
    explanation: str = ""
    hint: str = ""  # a known mistake that agrees with most of the wrong answers, not with all
    unasked: tuple = ()  # names of tensors that are not checked in this precision
    recipe: str = ""  # of the digits that an answer lacks which is as near as the printed formula
    group: str = ""  # of subjects that a port may leave out

    @property
    def wrong(self):
        return self.required and self.verdict not in ("pass", "acceptable", "unasked")


def change_floats(values, change):
    """Apply `change` to every float array of {name: array, list of arrays or setting}."""

    def visit(value):
        if isinstance(value, list):
            return [visit(b) for b in value]
        is_array = isinstance(value, (np.ndarray, np.generic))
        return change(value) if is_array and value.dtype.kind == "f" else value

    return {name: visit(value) for name, value in values.items()}


def cast(values, dtype):
    """The same values with every float array in another precision."""
    return change_floats(values, lambda a: np.asarray(a, dtype))


def expected(tensors):
    """Return the tensors of a case that a port must give: outputs and gradients."""
    return {name: a for name, a in tensors.items() if name.startswith(("out.", "in_bar."))}


def precision(got):
    """Return the precision in which a port computes: float32 if any float tensor has it."""
    arrays = (np.asarray(a) for a in expected(got).values())
    return "float32" if "f4" in {a.dtype.str[1:] for a in arrays} else "float64"


def too_wide(tensors, tolerance, precision):
    """Return the names of the tensors of a case that its tolerance cannot judge in a precision.

    They would pass although every number were off by 1e-3 of itself, zero or negated. In float32
    some results cancel this far. A tensor of zeros is always judged: the right answer is zero.
    """

    def passes(name, wrong):
        alone = {n: tensors[n] for n in (name, "scale." + name)}
        return not compare(alone, {name: wrong.astype(precision)}, tolerance)

    return [
        name
        for name, right in expected(tensors).items()
        if right.dtype.kind == "f" and right.any()
        if any(passes(name, wrong) for wrong in (1.001 * right, np.zeros_like(right), -right))
    ]


def compare(tensors, got, tolerance):
    """Return a Finding for every tensor in which `got` {name: array} differs from a case's tensors.

    `tensors` are those of the vectors with their scales, `tolerance` is the record of the port's
    precision.
    """
    want = expected(tensors)
    extra = [name for name in expected(got) if name not in want]
    found = [
        _difference(name, got.get(name), right, tensors.get("scale." + name), tolerance)
        for name, right in want.items()
    ]
    return [
        *(Finding(name, "extra", "not expected in this case") for name in extra),
        *(finding for finding in found if finding),
    ]


def _difference(name, mine, right, scale, tolerance):
    """Return a Finding if one tensor is missing or wrong, else None."""
    if mine is None:
        return Finding(name, "missing", f"expected {right.dtype} {right.shape}")
    mine = np.asarray(mine)
    if mine.shape != right.shape:
        return Finding(name, "shape", f"{mine.shape}, expected {right.shape}")
    wrong_type = _wrong_type(mine, right)
    if wrong_type:
        return Finding(name, "dtype", f"{mine.dtype}, expected {wrong_type}")
    if right.dtype.kind == "f":
        return _float_difference(name, mine, right, scale, tolerance) if right.size else None
    wrong = mine != right
    if not wrong.any():
        return None
    index = first(wrong)
    got, want = mine[index], right[index]
    return Finding(name, "value", _said(name, index, got, want), index, float(got), float(want))


def first(wrong):
    """Return the index of the first True of an array."""
    return tuple(int(i) for i in np.argwhere(wrong)[0])


def _wrong_type(mine, right):
    """Return the expected type, or "" if the type of the port's array is accepted."""
    if right.dtype.kind == "f":
        asked = "float64 or float32; half precision is not judged, the vectors' page says why"
        return "" if mine.dtype.str[1:] in PRECISIONS else asked
    if right.dtype.kind == "b":
        zeros_and_ones = mine.dtype.kind in "iu" and np.isin(mine, (0, 1)).all()
        return "" if mine.dtype.kind == "b" or zeros_and_ones else "bool"
    return "" if mine.dtype.kind in "iu" else "integers"


def _said(name, index, got, want):
    """Return the message about one element, with enough digits to tell both numbers apart."""
    place = f"{name}{list(index) if index else ''}"
    if not isinstance(want, np.floating):
        return f"{place}: got {int(got)}, expected {int(want)}"
    digits = 9 if f"{got:.9g}" != f"{want:.9g}" else 17
    return f"{place}: got {got:.{digits}g}, expected {want:.{digits}g}"


def deviations(mine, right, scale, precision_of):
    """Return |got - want| of every element, plain and in units of eps S.

    Both are infinite where one side is NaN or the two are unequal infinities. A deviation up to the
    smallest normal number is always allowed, because smaller numbers have few digits and much
    hardware replaces them by 0.
    """
    with np.errstate(all="ignore"):
        absolute = np.abs(mine.astype(float) - right)
        beyond = np.maximum(absolute - np.finfo(precision_of).tiny, 0)
        unit = np.finfo(precision_of).eps * scale.astype(float)
        scaled = np.where(beyond == 0, 0, beyond / unit)
    same = mine == right
    absolute, scaled = (np.where(same, 0, np.nan_to_num(a, nan=np.inf)) for a in (absolute, scaled))
    return absolute, scaled


def _float_difference(name, mine, right, scale, tolerance):
    absolute, scaled = deviations(mine, right, scale, mine.dtype)
    bound, rms_bound = tolerance["eps_S"], np.inf
    worst = tuple(int(i) for i in np.unravel_index(np.argmax(scaled), scaled.shape))
    largest = rms = float(scaled[worst])
    said = f"worst {largest:.3g} eps S, allowed {bound:g}"
    if name.split(".")[1] in IMAGES:
        rms_bound = tolerance["rms_eps_S"]
        if 0 < largest < np.inf:
            rms = float(largest * np.sqrt(((scaled / largest) ** 2).mean()))
        said += f"; root mean square {rms:.3g}, allowed {rms_bound:g}"
    if largest <= bound and rms <= rms_bound:
        return None
    off = f"{int((scaled > bound).sum())} of {scaled.size} numbers off"
    with np.errstate(all="ignore"):
        relative = float(absolute[worst] / abs(right[worst])) if right[worst] else np.inf
    return Finding(
        name,
        "value",
        f"{_said(name, worst, mine[worst], right[worst])} ({off}; {said})",
        worst,
        float(mine[worst]),
        float(right[worst]),
        float(absolute[worst]),
        relative,
        largest,
        float(bound),
    )
