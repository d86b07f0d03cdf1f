"""Measures c, the tolerance of a case: a port may miss a number by c eps S.

c is SAFETY times the largest error, in eps S, of right evaluations: this project's own in float32,
with float64 inside where the code asks for it and without, as on a GPU; and those that a subject
calls its twins, in float64 too. It is rounded up to a power of two, and at least FLOOR, because the
order of a sum is free. `p4dgs_ref.oracle.tolerance` measures S.
"""

from functools import partial

import numpy as np

from p4dgs_ref.oracle.compare import IMAGES, cast, change_floats, expected_tensors, precision

SAFETY, FLOOR = 4, 32
LARGEST = 2.0**14  # a case that float32 misses by more asks for more than float32 has


class Single(np.ndarray):
    """An array of float32 numbers. What is computed from it is float32 too, whatever is asked."""

    def __array_ufunc__(self, ufunc, method, *inputs, **keywords):
        return single(getattr(ufunc, method)(*plain(inputs), **plain(keywords)))

    def __array_function__(self, function, _, inputs, keywords):
        return single(function(*plain(inputs), **plain(keywords)))

    def astype(self, dtype, **_):
        return single(np.asarray(self).astype(plain(dtype)))


def plain(value):
    """Return arrays as NumPy's own, and float32 for float64; an `out` keeps its memory."""
    if isinstance(value, (list, tuple)):
        return type(value)(map(plain, value))
    if isinstance(value, dict):
        return {name: plain(a) for name, a in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return np.asarray(value, np.float32 if value.dtype == np.float64 else None)
    is_type = isinstance(value, (type, np.dtype)) and value in (float, np.float64)
    return np.float32 if is_type else value


def single(value):
    """Return arrays, and those of a list or tuple, as Singles."""
    if isinstance(value, (list, tuple)):
        return type(value)(map(single, value))
    value = plain(value)
    return value.view(Single) if isinstance(value, np.ndarray) else value


CASTS = (
    partial(cast, dtype=np.float64),
    partial(cast, dtype=np.float32),
    partial(change_floats, change=single),
)


@np.errstate(all="ignore")
def largest_error(subject, inputs, cotangents, tensors):
    """Return the largest error of the right evaluations of a case, in eps S.

    `tensors` has what is expected, and the scales. The error is infinite where float32 with float64
    inside fails. Where float32 throughout is off by more than LARGEST, it cannot hold the case,
    which is what `printed_v1.safetensors` of the oracle is for.
    """
    error = 0.0
    for answer in (subject.answer, *subject.twins):
        double, mixed, alone = (
            _error(answer, cast(inputs), cast(cotangents), tensors) for cast in CASTS
        )
        error = max(error, double, mixed, alone if alone <= LARGEST else 0.0)
    return error


def _error(answer, inputs, cotangents, tensors):
    """Return the largest error of the answer to some inputs, in eps S of its precision."""
    try:
        got = answer(inputs, cotangents)
    except (ValueError, ArithmeticError):
        return np.inf
    eps = np.finfo(precision(got)).eps
    worst = 0.0
    for name, want in expected_tensors(tensors).items():
        mine = got.get(name)
        if mine is None or mine.shape != want.shape:
            return np.inf
        if want.dtype.kind != "f":
            worst = worst if np.array_equal(mine, want) else np.inf
            continue
        # Not `compare.deviations`, which leaves small numbers free: here all errors must show.
        unit = eps * tensors["scale." + name].astype(float)
        off = np.abs(np.asarray(mine, float) - want) / unit
        off = np.where(mine == want, 0, off)  # equal infinities; 0 where S is 0
        worst = max(worst, float(np.nan_to_num(off, nan=np.inf).max(initial=0)))
    return worst


def tolerances(error, tensors):
    """Return the tolerance record of a case whose right evaluations are off by up to `error`.

    It is {"float64": {eps_S, reason}, "float32": the same or None, ...}. An image among the names
    of the tensors has two bounds: eps_S for its worst value, and a quarter of that for the root
    mean square of all errors.
    """
    measured, c = error <= LARGEST, FLOOR
    if measured:
        c = max(FLOOR, int(2 ** np.ceil(np.log2(max(SAFETY * error, 1)))))
    bounds = {"eps_S": c}
    if any(name.split(".")[1] in IMAGES for name in tensors):
        bounds["rms_eps_S"] = c / 4
    if measured:
        bounds["reason"] = (
            f"{SAFETY} times the {error:.3g} eps S by which right evaluations miss, "
            f"at least {FLOOR}, to a power of two"
        )
        return {"float64": bounds, "float32": dict(bounds)}
    return {
        "float64": {**bounds, "reason": f"{FLOOR} eps S: the order of sums is free"},
        "float32": None,
        "float32_reason": "float32 cannot hold these inputs or misses their result by more than "
        "2^14 eps S; do this case in float64",
    }
