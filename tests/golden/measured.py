"""Measures c, the tolerance of a case: a port may miss a number by c eps S.

c is SAFETY times the largest error, in eps S, of this project's own evaluation in float32, rounded
up to a power of two. It is at least FLOOR, because the order of a sum is free.
`p4dgs_ref.oracle.tolerance` measures S.
"""

import numpy as np

from p4dgs_ref.oracle.compare import IMAGES, cast

SAFETY, FLOOR = 4, 32
LARGEST = 2.0**14  # a case that float32 misses by more asks for more than float32 has


def float32_error(answer, inputs, cotangents, flat, scale):
    """Return the largest error of a float32 evaluation in eps S; infinite where it fails."""
    try:
        with np.errstate(all="ignore"):
            low = answer(cast(inputs, np.float32), cast(cotangents, np.float32))
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
        # Not `compare.deviations`, which leaves small numbers free: here all errors must show.
        with np.errstate(all="ignore"):
            unit = np.finfo(np.float32).eps * scale[name].astype(float)
            off = np.abs(got.astype(float) - want) / unit
        off = np.where(got == want, 0, off)  # equal infinities; 0 where S is 0
        worst = max(worst, float(np.nan_to_num(off, nan=np.inf).max(initial=0)))
    return worst


def tolerances(error, tensors):
    """Return the tolerance record of a case whose float32 evaluation is off by `error`.

    It is {"float64": {eps_S, reason}, "float32": the same or None, ...}. An image among the names
    of the tensors has two bounds: eps_S for its worst value, and a quarter of that for the root
    mean square of all errors.
    """
    measured = error <= LARGEST
    c = FLOOR
    if measured:
        c = max(FLOOR, int(2 ** np.ceil(np.log2(max(SAFETY * error, 1)))))
    bounds = {"eps_S": c}
    if any(name.split(".")[1] in IMAGES for name in tensors):
        bounds["rms_eps_S"] = c / 4
    if measured:
        reason = f"{SAFETY} times the {error:.2g} eps S by which float32 misses here, "
        reason += f"at least {FLOOR}, to a power of two"
        bounds["reason"] = reason
        return {"float64": bounds, "float32": dict(bounds)}
    return {
        "float64": {**bounds, "reason": f"{FLOOR} eps S: the order of sums is free"},
        "float32": None,
        "float32_reason": "float32 cannot hold these inputs or misses their result by more than "
        "2^14 eps S; do this case in float64",
    }
