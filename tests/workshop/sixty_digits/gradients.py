"""Values and gradients of every equation in decimals; gradients are difference quotients.

The quotient is taken at two steps, h and 10^-10 h. Between them the first difference must fall like
h and the second like h^2, each to 30 digits; then the quotient at the smaller step is right to 50
digits of the largest term. Where they do not, the step was wider than some feature of the formula,
and a narrower one is tried. Where no step will do, the input is on a kink or a jump, and the
gradient is NaN.
"""

import zlib
from decimal import Decimal

import numpy as np

from . import images, prediction, rates
from .floats import exact, wrapped
from .functions import WORKING, working

FORMULAS = {
    **prediction.FORMULAS,
    **rates.FORMULAS,
    **images.FORMULAS,
}
# Their `grids` pass a sign: it is held, while the clipped parameter moves.
STRAIGHT_THROUGH = ("hash_grid", "hash_rate")
# Settings that have the precision of the input that they are compared with.
MEETS = {
    "deformation": ("t", "x"),
    "masking": ("tau_alpha", "alpha"),
    "compositing": ("alpha_max", "alpha"),
}

NAN = Decimal("NaN")
STEPS = Decimal("1e-40"), Decimal("1e-65")  # relative to x, to its array, or to one
FINER = Decimal("1e-10")
AGREE = Decimal("1e-30")  # error of the first difference, or the second, between the two steps
NOISE = Decimal(10) ** (
    20 - WORKING
)  # of the summed terms: rounding errors, with twenty digits spare


def value(key, inputs):
    """{output: array of decimals} of one equation.

    Lists stay lists; integers and masks become decimals too. Raises decimal.InvalidOperation where
    the formula says inf - inf or 0/0, or compares with a NaN.
    """
    with working():
        return {name: wrapped(a) for name, a in FORMULAS[key][0](**taken(key, inputs)).items()}


def taken(key, inputs):
    """Inputs as decimals; a time and thresholds get the precision of the input in MEETS."""
    if key in MEETS:
        name, other = MEETS[key]
        inputs = {**inputs, name: inputs[other].dtype.type(inputs.get(name, images.ALPHA_MAX))}
    return {name: exact(a) for name, a in inputs.items()}


def gradient(key, inputs, cotangents, name=None, samples=None):
    """{input: array of decimals}: the gradient of <y_bar, y> by one input, or by all of them.

    Cotangents {"x_bar": array} that are absent are zero. An element is NaN on a kink and at an
    infinite input, and where only some `samples` of every array are asked for. Every element costs
    four values of the formula.
    """
    formula, names = FORMULAS[key]
    with working():
        start = taken(key, inputs)
        bars = {n[:-4]: exact(np.asarray(bar)) for n, bar in cotangents.items() if bar is not None}
        if key in STRAIGHT_THROUGH:
            start["held"] = start["grids"]
        shapes = {n: np.shape(a) for n, a in formula(**start).items()}

        def terms(**changed):
            """The terms of <y_bar, y>; None where the changed inputs gave y another shape."""
            out = formula(**{**start, **changed})
            if any(np.shape(a) != shapes[n] for n, a in out.items()):
                return None
            return np.concatenate(
                [np.zeros(0, object), *(np.ravel(bar * out[n]) for n, bar in bars.items())]
            )

        return {n: _gradient_of(terms, n, start[n], samples) for n in ([name] if name else names)}


def _gradient_of(terms, name, x, samples):
    """The gradient of one input, or of a list of arrays, element by element."""
    arrays = x if isinstance(x, list) else [np.asarray(x, object)]
    slopes = [np.full(a.shape, NAN, object) for a in arrays]
    for i, a in enumerate(arrays):
        for at in sampled(a.shape, f"{name}.{i}", samples):
            if not a[at].is_finite():
                continue

            def along(step, i=i, a=a, at=at):
                moved = a.copy()
                moved[at] += step
                return terms(
                    **{
                        name: [*arrays[:i], moved, *arrays[i + 1 :]]
                        if isinstance(x, list)
                        else moved
                    }
                )

            slopes[i][at] = slope(along, sizes(a, at))
    return slopes if isinstance(x, list) else slopes[0]


def sampled(shape, name, samples):
    """The indices of the elements to differentiate: all, or some drawn by name.

    A smaller number of samples is a subset of a larger one.
    """
    size = int(np.prod(shape))
    drawn = np.random.default_rng(zlib.crc32(name.encode())).permutation(size)
    return [np.unravel_index(j, shape) for j in (drawn if samples is None else drawn[:samples])]


def sizes(a, at):
    """The magnitudes on which x may act, the largest first: that of its array, 1, its own."""
    size, widest = abs(a[at]), max((abs(v) for v in a.ravel() if v.is_finite()), default=Decimal(0))
    return sorted({v for v in (widest, Decimal(1), size) if v}, reverse=True)


def slope(f, scales):
    """The derivative at 0 of the sum of the terms f(step); NaN where there is none."""
    middle, tried = f(Decimal(0)), None
    for h in sorted((scale * step for scale in scales for step in STEPS), reverse=True):
        if tried is not None and h * 100 > tried:  # as good as one that failed
            continue
        tried = h
        quotient = _quotient(f, middle, h)
        if quotient is not None:
            return quotient
    return NAN


def _quotient(f, middle, h):
    """The central quotient at h / 10^10 if f is smooth on the scale of h, else None."""
    ends = [f(h), f(-h), f(h * FINER), f(-h * FINER)]
    if any(end is None or not all(v.is_finite() for v in end) for end in ends):
        return None
    noise = NOISE * sum(max(abs(v) for v in row) for row in zip(middle, *ends[:2]))
    first, second = ends[0] - ends[1], ends[0] + ends[1] - 2 * middle
    first_finer, second_finer = ends[2] - ends[3], ends[2] + ends[3] - 2 * middle
    first, second, first_finer, second_finer = (
        sum(v, Decimal(0)) for v in (first, second, first_finer, second_finer)
    )
    if abs(first_finer) <= noise:
        first_finer = Decimal(0)
    for wide, fine in ((first, first_finer / FINER), (second, second_finer / FINER**2)):
        if abs(wide - fine) > AGREE * abs(wide) + noise / FINER**2:
            return None
    return first_finer / (2 * h * FINER)
