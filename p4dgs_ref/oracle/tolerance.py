"""Measures S, the scale by which a port's errors are judged: a number may be off by c eps S.

A sum whose terms have the size S cannot be computed more accurately than eps S, however small the
sum itself is. Where terms cancel, a bound relative to the result would therefore ask for the
impossible; if they do not, an absolute bound would let mistakes pass. For a number y of an
output or a gradient,

    S = max(|y|, root of the sum over all input numbers x of (x dy/dx)**2)

and y is right within c eps S, with the eps of the port's precision.

The second term of S is measured. All inputs (and for gradients the cotangents) are changed by the
fraction delta of their value with random signs, PROBES times; the root mean square of the change
of y, divided by delta, estimates the term. For a sum it is the size of the summands; for others
it is the effect of rounding the inputs. `tests/workshop/measured.py` measures the tolerance c.

The functions below take `answer(inputs, cotangents)`, which returns outputs and gradients as flat
tensors {"out.x": array, "in_bar.x_a": array}.
"""

import zlib

import numpy as np

from .compare import IMAGES, change_floats
from .published import flatten

PROBES = 12
DELTA = 2.0**-34  # far above float64's rounding, small enough for terms that cancel to eight digits
MIN_SHARE = 2.0**-40  # of the largest S in its array: the smallest S of a number


def answer_of(eq):
    """Return the function `answer` of an equation of the table."""

    def answer(inputs, cotangents):
        outputs, pullback = eq.vjp(**inputs)
        bars = pullback(**cotangents) if eq.gradients else {}
        # A scalar's gradient may be one of Python's numbers.
        arrays = {
            name: bars[name] if isinstance(bars[name], list) else np.asarray(bars[name])
            for name in eq.gradients
        }
        return {**flatten(outputs, "out."), **flatten(arrays, "in_bar.")}

    return answer


def cotangents_of(eq, outputs, seed):
    """Return normal random numbers as the cotangent of every float output. The seed is a string."""
    rng = np.random.default_rng(zlib.crc32(seed.encode()))
    floats = {n: a for n, a in outputs.items() if eq.gradients and np.asarray(a).dtype.kind == "f"}
    return {f"{name}_bar": rng.standard_normal(np.shape(a)) for name, a in floats.items()}


def scales(answer, inputs, cotangents, flat, seed):
    """Return S for every float tensor in the answer `flat`: an array like it, () for an image.

    The seed is a string.
    """
    rng = np.random.default_rng(zlib.crc32(seed.encode()))
    wide = _spread(answer, inputs, cotangents, flat, DELTA, rng)
    narrow = _spread(answer, inputs, cotangents, flat, DELTA / 16, rng)
    return {name: _scale(name, flat[name], wide[name], narrow[name]) for name in wide}


@np.errstate(all="ignore")
def _spread(answer, inputs, cotangents, flat, delta, rng):
    """Return the root mean square change of every number, divided by delta."""

    def move(a):
        return (a * (1 + delta * rng.choice([-1.0, 1.0], np.shape(a)))).astype(a.dtype)

    squares = {name: np.zeros(a.shape) for name, a in flat.items() if a.dtype.kind == "f"}
    for _ in range(PROBES):
        try:
            moved = answer(change_floats(inputs, move), change_floats(cotangents, move))
        except ValueError:  # at a threshold the number of kept Gaussians may change
            continue
        for name in squares:
            step = np.abs(moved[name] - flat[name]) / delta
            squares[name] += np.where(np.isfinite(step), np.minimum(step, 1e150), 0) ** 2
    return {name: np.sqrt(square / PROBES) for name, square in squares.items()}


def _scale(name, values, wide, narrow):
    size = np.where(np.isfinite(values), np.abs(values), 0)
    # At a tie or a kink, y jumps by the same amount for a delta that is sixteen times smaller, so
    # the quotient grows sixteen-fold. There the second term is left out and S is |y|.
    size = np.maximum(size, np.where(narrow > 4 * wide, 0, wide))
    largest = size.max(initial=0)
    is_image = name.split(".")[1] in IMAGES
    size = largest.reshape(()) if is_image else np.maximum(size, MIN_SHARE * largest)
    # float32 has enough digits for S, but not always the range
    in_range = (size == 0) | (size > 1e-30) & (size < 1e30)
    return size.astype(np.float32) if in_range.all() else size
