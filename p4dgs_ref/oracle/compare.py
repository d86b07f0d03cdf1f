"""Judges a port's answer to one case: names, shapes and types first, then every number.

A float is right within c eps S, where S is stored beside it in the vectors and c is the case's
tolerance `eps_S` for the port's precision; `tolerance.py` says how both were measured.

A few cases ask for more digits than the paper's formulas have when they are computed as printed and
differentiated by the textbook: the slope of tanh, 1 - tanh(y)**2, cancels if tanh is close to 1,
and the square of a long vector overflows. A port that uses automatic differentiation has the right
formula and misses these cases. So does a correct port that uses float32 throughout where this
project computes in float64 inside. How far such ports are off was measured with the printed
formulas, with every intermediate result rounded. The file PRINTED contains:

    <precision>/<subject>/<case>/scale.out.x    the scale S of the printed formula
    <precision>/<subject>/<case>/range.out.x    where it leaves the range of the precision: outputs
                                                are 0 or infinite there, gradients also NaN
    <precision>/<subject>/<case>/other.out.x    all tensors if it culls the only Gaussian

If S is so wide that a wrong tensor would be as near as the printed formula, or if the formula
leaves the range, the verdict "acceptable" is not given: the tensor is left without a verdict, and
the report names it.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import safetensors

# Images have one S for all pixels, a bound for the worst pixel and one for the root mean square.
IMAGES = ("image", "images")
# Gradients of symmetric matrices: a port may read one triangle or both, so that only the symmetric
# part of its gradient says anything.
SYMMETRIC = ("in_bar.Sigma",)
PRECISIONS = "float64", "float32"
PRINTED = Path(__file__).with_name("printed_v1.safetensors")


class Finding(NamedTuple):
    """What is wrong with one tensor. The numbers are those of its worst element."""

    tensor: str
    kind: str  # missing, extra, shape, dtype or value
    message: str
    index: tuple = ()
    got: float | None = None
    want: float | None = None
    scaled: float | None = None  # |got - want| / (eps S)
    bound: float | None = None  # the largest `scaled` that is allowed


class Result(NamedTuple):
    """The verdict on one case."""

    id: str
    equation: str
    level: str
    # pass; fail; acceptable (the printed formula is no better here or, if the case says so,
    # another answer is defensible); not_judged (none of the case's tensors is judged); or the kind
    # of a PortError
    verdict: str
    required: bool
    findings: tuple = ()  # of Finding
    explanation: str = ""
    hint: str = ""  # a known mistake that agrees with most of the wrong answers, not with all
    not_judged: tuple = ()  # names of tensors for which wrong answers would pass too
    recipe: str = ""  # keeps the digits that this answer and the printed formula lack
    group: str = ""  # of subjects that a port may leave out

    @property
    def subject(self):
        """The first part of the id."""
        return self.id.partition("/")[0]

    @property
    def wrong(self):
        return self.required and self.verdict not in ("pass", "acceptable", "not_judged")


def change_floats(values, change):
    """Apply `change` to every float array of {name: array, list of arrays or setting}."""

    def visit(value):
        if isinstance(value, list):
            return [visit(b) for b in value]
        is_array = isinstance(value, (np.ndarray, np.generic))
        return change(value) if is_array and value.dtype.kind == "f" else value

    return {name: visit(value) for name, value in values.items()}


def cast(values, dtype):
    """Return the same values with every float array in another precision."""
    return change_floats(values, lambda a: np.asarray(a, dtype))


def expected_tensors(tensors):
    """Return the tensors of a case that a port must give: outputs and gradients."""
    return {name: a for name, a in tensors.items() if name.startswith(("out.", "in_bar."))}


@np.errstate(all="ignore")
def symmetric_parts(tensors):
    """Return the tensors with the symmetric part (a + a^T) / 2 of those that SYMMETRIC names."""

    def part(a):  # which a port has sent, so that it may be anything
        is_square = a.ndim > 1 and a.shape[-1] == a.shape[-2]
        return a / 2 + a.swapaxes(-1, -2) / 2 if is_square and a.dtype.kind == "f" else a

    return {n: part(np.asarray(a)) if n in SYMMETRIC else a for n, a in tensors.items()}


def precision(got):
    """Return the precision in which a port computes: float32 if any float tensor has it."""
    is_single = any(np.asarray(a).dtype.name == "float32" for a in expected_tensors(got).values())
    return "float32" if is_single else "float64"


def too_wide(tensors, tolerance, precision):
    """Return the names of the tensors of a case that its tolerance cannot judge in a precision.

    They would pass even if every number were off by 1e-3 of itself, zero or negated. In float32
    some results cancel this far. Where a scale is infinite any number passes. A tensor of zeros can
    be judged: the right answer is zero. Without a tolerance, no tensor can.
    """

    def passes(name, wrong):
        alone = {n: tensors[n] for n in (name, "scale." + name)}
        return not compare(alone, {name: wrong.astype(precision)}, tolerance)

    return [
        name
        for name, right in expected_tensors(tensors).items()
        if tolerance is None
        or np.isinf(tensors.get("scale." + name, 0)).any()
        or right.any()
        and right.dtype.kind == "f"
        and any(passes(name, wrong) for wrong in (1.001 * right, np.zeros_like(right), -right))
    ]


def compare(tensors, got, tolerance):
    """Return a Finding for every tensor in which `got` {name: array} differs from a case's tensors.

    `tensors` are those of the vectors with their scales, `tolerance` is the record of the port's
    precision.
    """
    return differences(
        expected_tensors(tensors), symmetric_parts(expected_tensors(got)), tensors, tolerance
    )


def differences(want, got, tensors=None, tolerance=None):
    """Return a Finding for every array that is missing or wrong in `got`, then for unexpected ones.

    Without a tolerance, all bits of a float must agree.
    """
    findings = [
        _difference(name, got.get(name), right, (tensors or {}).get("scale." + name), tolerance)
        for name, right in want.items()
    ]
    return [
        *filter(None, findings),
        *(Finding(name, "extra", "not expected in this case") for name in got if name not in want),
    ]


def _difference(name, mine, right, scale, tolerance):
    """Return a Finding if one array is missing or wrong, else None."""
    if mine is None:
        return Finding(name, "missing", f"expected {right.dtype} {right.shape}")
    mine = np.asarray(mine)
    if mine.shape != right.shape:
        return Finding(name, "shape", f"{mine.shape}, expected {right.shape}")
    wrong_type = _wrong_type(mine, right, exact=tolerance is None)
    if wrong_type:
        return Finding(name, "dtype", f"{mine.dtype}, expected {wrong_type}")
    if tolerance and right.dtype.kind == "f":
        return _float_difference(name, mine, right, scale, tolerance) if right.size else None
    wrong = _bits(mine, right.dtype) != _bits(right, right.dtype)
    if not wrong.any():
        return None
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    got, want = mine[index], right[index]
    return Finding(
        name,
        "value",
        f"{_element(name, index, got, want)} ({int(wrong.sum())} of {wrong.size} numbers off)",
        index,
        float(got),
        float(want),
    )


def _wrong_type(mine, right, exact):
    """Return the expected type, or "" if the type of the port's array is accepted."""
    is_whole = mine.dtype.kind in "iub"
    if right.dtype.kind == "f":
        types = [right.dtype.name] if exact else PRECISIONS
        expects = " or ".join(types)
        return "" if mine.dtype.name in types else expects
    if right.dtype.kind == "b":
        return "" if is_whole and np.isin(mine, (0, 1)).all() else "bool"
    return "" if is_whole else "integers"


def _bits(a, dtype):
    """Return floats of a type as integers, which tell -0 from 0; other arrays as they are."""
    return a.astype(dtype).view(f"u{dtype.itemsize}") if dtype.kind == "f" else a


def _element(name, index, got, want):
    """Return the message about one element, with enough digits to tell both numbers apart."""
    place = f"{name}{list(index) if index else ''}"
    if not isinstance(want, np.floating):
        return f"{place}: got {int(got)}, expected {int(want)}"
    digits = 9 if f"{got:.9g}" != f"{want:.9g}" else 17
    return f"{place}: got {got:.{digits}g}, expected {want:.{digits}g}"


@np.errstate(all="ignore")
def deviations(mine, right, scale, precision_of):
    """Return |got - want| of every element, plain and in units of eps S.

    Both are infinite if one side is NaN or the two are unequal infinities. A deviation up to the
    smallest normal number is always allowed, because smaller numbers have few digits and much
    hardware replaces them by 0.
    """
    absolute = np.abs(mine.astype(float) - right)
    beyond = np.maximum(absolute - np.finfo(precision_of).tiny, 0)
    unit = np.finfo(precision_of).eps * scale.astype(float)
    scaled = np.where(beyond == 0, 0, beyond / unit)
    same = mine == right
    absolute, scaled = (np.where(same, 0, np.nan_to_num(a, nan=np.inf)) for a in (absolute, scaled))
    return absolute, scaled


@np.errstate(all="ignore")
def _float_difference(name, mine, right, scale, tolerance):
    _, scaled = deviations(mine, right, scale, mine.dtype)
    bound = tolerance["eps_S"]
    worst = tuple(int(i) for i in np.unravel_index(np.argmax(scaled), scaled.shape))
    largest = float(scaled[worst])
    passes, measure = largest <= bound, f"worst {largest:.3g} eps S, allowed {bound:g}"
    if name.split(".")[1] in IMAGES:
        rms, rms_bound = float(np.sqrt((scaled**2).mean())), tolerance["rms_eps_S"]
        passes &= rms <= rms_bound
        measure += f"; root mean square {rms:.3g}, allowed {rms_bound:g}"
    if passes:
        return None
    return Finding(
        name,
        "value",
        f"{_element(name, worst, mine[worst], right[worst])} "
        f"({int((scaled > bound).sum())} of {scaled.size} numbers off; {measure})",
        worst,
        float(mine[worst]),
        float(right[worst]),
        largest,
        float(bound),
    )


# --- the printed formulas -----------------------------------------------------------------------
SIGMOID = "sigmoid'(y) = sigmoid(y) sigmoid(-y)"
UNIT = (
    "|r| by hypot, without squares, and for the gradient the part of r_bar perpendicular to the "
    "unit vector n, sum over j of (r_bar_i n_j - n_i r_bar_j) n_j"
)
# What keeps the digits, and for which subjects.
RECIPES_FOR = {
    "tanh'(y) = 4 e / (1 + e)^2 with e = exp(-2 |y|)": ("tanh", "opacity"),
    SIGMOID: ("sigmoid", "color", "scale"),
    UNIT: ("unit_quaternion", "rotation", "deformed"),
    "q = 2 Q_0 sigmoid(2 u) above its floor, with the slope 4 Q_0 sigmoid(2 u) sigmoid(-2 u)": (
        "step_floor",
        "step",
    ),
    "delta_vc by hypot, without squares": ("view",),
    "1 - SSIM = mean(l + s - l s) with e = image - truth, l = mu_e^2 / (mu_x^2 + mu_y^2 + C1), "
    "s = var_e / (var_x + var_y + C2)": ("ssim", "render_loss"),
    "the projection in float64: float32 has neither the range nor the digits of a c - b^2": (
        "projection",
    ),
}
RECIPES = {subject: recipe for recipe, of in RECIPES_FOR.items() for subject in of}


@cache
def printed_arrays():
    """Return {case id and precision: {name: array}} of the file."""
    cases = {}
    for name, array in safetensors.load(PRINTED.read_bytes()).items():
        precise, subject, case, tensor = name.split("/")
        cases.setdefault((f"{subject}/{case}", precise), {})[tensor] = array
    return cases


def printed_form(case, got):
    """Return a case with the scales of the printed formula, and an answer in its range.

    Where the formula leaves the range, an answer of 0, infinity or NaN is replaced by the expected
    number, with an infinite scale; any other answer there is judged.
    """
    mine, precise = dict(got), precision(got)
    stored = printed_arrays().get((case.id, precise), {})

    def of(role):
        return {n.removeprefix(role): a for n, a in stored.items() if n.startswith(role)}

    tensors = case.tensors | {"scale." + n: S for n, S in of("scale.").items()}
    others = of("other.")
    if np.array_equal(got.get("out.visible"), others.get("out.visible")):
        tensors |= others
    for name, beyond in of("range.").items():
        answer, scale = np.asarray(mine.get(name)), "scale." + name
        if answer.shape == beyond.shape and answer.dtype.name == precise:
            unit = np.finfo(precise).eps * case.tensors[scale]
            lost = beyond & (np.isinf(answer) | (np.abs(answer) <= unit))
            if name.startswith("in_bar."):
                lost |= beyond & np.isnan(answer)
            mine[name] = np.where(lost, tensors[name].astype(precise), answer)
            tensors[scale] = np.where(lost, np.inf, tensors[scale])
    return case._replace(tensors=tensors), mine
