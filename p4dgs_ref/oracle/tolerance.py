"""How far from a vector a port may be: multiples of eps S, where S says how large the terms are that make up a number.

A sum of terms of size S cannot be had more accurately than eps S, however small it turns out: where terms cancel, a bound
relative to the result would ask for the impossible, and where they do not, an absolute bound would let mistakes pass.  For
every number y of an output or gradient

    S = max(|y|, root of the sum over all input numbers x of (x dy/dx)^2)

and y is right within c eps S, with eps of the port's precision.  The second term is measured: all inputs (for gradients the
cotangents too) are changed by +-delta of themselves, signs drawn at random, PROBES times; the root of the mean square of
y's answer, over delta, estimates it.  For a sum it is the size of the terms; for anything else, how the unavoidable
rounding of the inputs shows.  c is measured too: SAFETY times the largest error, in eps S, that this project's own
evaluation in float32 makes, rounded up to a power of two, and at least FLOOR, for the order of a sum is free.
"""

import zlib

import numpy as np

from ..studies.precision import cast
from .compare import IMAGES
from .subjects import flatten, run

PROBES = 12
DELTA = (
    2.0**-34
)  # far above the rounding of float64, and small enough for terms that cancel to eight digits
SAFETY, FLOOR = 4, 32
LARGEST = 2.0**14  # a case that float32 misses by more asks for more than float32 has
LEAST = 2.0**-40  # S of a number is at least this part of the largest S in its array


def scales(eq, case, cotangents, flat):
    """S of every float tensor in `flat`: {"out.bits": array of its shape, or () for an image}.

    Shapes     flat {"out.x": array, "in_bar.x": array}: the values themselves
    """
    rng = np.random.default_rng(zlib.crc32(case.name.encode()))
    wide, narrow = (
        _spread(eq, case, cotangents, flat, delta, rng) for delta in (DELTA, DELTA / 16)
    )
    return {name: _scale(name, flat[name], wide[name], narrow[name]) for name in wide}


def _spread(eq, case, cotangents, flat, delta, rng):
    """Root mean square of every number's answer to random changes of all inputs by delta, over delta."""
    squares = {name: np.zeros(a.shape) for name, a in flat.items() if a.dtype.kind == "f"}
    with np.errstate(all="ignore"):
        for _ in range(PROBES):
            try:
                moved = named(
                    *run(eq, _moved(case.inputs, rng, delta), _moved(cotangents, rng, delta))
                )
            except (
                ValueError
            ):  # at a threshold: another number of Gaussians is kept, the cotangents do not fit
                continue
            for name in squares:
                step = (moved[name] - flat[name]) / delta
                squares[name] += (
                    np.where(np.isfinite(step), np.minimum(np.abs(step), 1e150), 0) ** 2
                )
    return {name: np.sqrt(square / PROBES) for name, square in squares.items()}


def _scale(name, values, wide, narrow):
    size = np.where(np.isfinite(values), np.abs(values), 0)
    # Across a tie or a kink a sixteenth of the change makes the same jump, sixteen times the quotient: only |y| counts there.
    size = np.maximum(size, np.where(narrow > 4 * wide, 0, wide))
    largest = size.max(initial=0)
    size = (
        largest.reshape(()) if name.split(".")[1] in IMAGES else np.maximum(size, LEAST * largest)
    )
    inside = (size == 0) | (size > 1e-30) & (
        size < 1e30
    )  # six digits of S are enough where float32 has the range
    return size.astype(np.float32) if inside.all() else size


def _moved(values, rng, delta):
    """Every float array times 1 +- delta."""

    def move(a):
        if isinstance(a, list):
            return [move(b) for b in a]
        if isinstance(a, (np.ndarray, np.generic)) and np.asarray(a).dtype.kind == "f":
            return (a * (1 + delta * rng.choice([-1.0, 1.0], np.shape(a)))).astype(a.dtype)
        return a

    return {name: move(a) for name, a in values.items()}


def named(out, gradients):
    """Outputs and gradients as flat tensors with their roles."""
    return {**flatten(out, "out."), **flatten(gradients, "in_bar.")}


def float32_error(eq, case, cotangents, flat, scale):
    """The largest error of this project's own float32 evaluation, in eps S; infinite where float32 cannot follow."""
    try:
        with np.errstate(all="ignore"):
            low = named(*run(eq, cast(case.inputs, np.float32), cast(cotangents, np.float32)))
    except (ValueError, ArithmeticError):
        return np.inf
    worst = 0.0
    for name, want in flat.items():
        got = low.get(name)
        if got is None or got.shape != want.shape:
            return np.inf
        if want.dtype.kind != "f":
            worst = worst if np.array_equal(got, want) else np.inf
            continue
        with np.errstate(
            all="ignore"
        ):  # not `deviations`: here what float32 cannot hold must show, nothing is free
            off = np.abs(got.astype(float) - want) / (
                np.finfo(np.float32).eps * scale[name].astype(float)
            )
        off = np.where(got == want, 0, off)  # equal infinities; 0 where S is 0
        worst = max(worst, float(np.nan_to_num(off, nan=np.inf).max(initial=0)))
    return worst


def tolerances(error, image=False):
    """{"float64": {eps_S, reason}, "float32": the same or None, ...} of a case whose float32 evaluation is off by `error`.

    An image has two bounds: eps_S for its worst value, and a quarter of that for the root mean square of all errors.
    """
    measured = error <= LARGEST
    c = FLOOR if not measured else max(FLOOR, int(2 ** np.ceil(np.log2(max(SAFETY * error, 1)))))
    said = f"{SAFETY} times the {error:.2g} eps S by which float32 misses here, at least {FLOOR}, to a power of two"
    bounds = {"eps_S": c, **({"rms_eps_S": c / 4} if image else {})}
    double = {**bounds, "reason": said if measured else f"{FLOOR} eps S: the order of sums is free"}
    if measured:
        return {"float64": double, "float32": {**bounds, "reason": said}}
    return {
        "float64": double,
        "float32": None,
        "float32_reason": "float32 cannot hold these inputs or misses their result by more than 2^14 eps S; do this case in float64",
    }
