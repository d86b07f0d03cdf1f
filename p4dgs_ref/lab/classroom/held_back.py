"""Cases that no student has seen: the published ones of an equation, changed by a seed.

Inputs and cotangents are new. The reference's answers and the bounds on errors come with them.
"""

import zlib
from functools import cache

import numpy as np

from ...oracle import published, tolerance
from ...oracle.compare import change_floats
from ...splatting.table import EQUATIONS

ORDINARY_DRAWS = 3  # of every ordinary case; one of every other case
# Rows are multiplied by 0.8 to 1, which preserves signs, zeros and upper bounds on magnitudes.
MIN_FACTOR = 0.8
# Cases with these flags or names would lose their point if numbers changed. Their inputs stay, with
# other cotangents.
FLAGS_OF_KEPT_INPUTS = {
    "kink",
    "tie",
    "clamped",
    "outside",
    "order",
    "extreme",
    "tail",
    "narrow",
    "wide",
    "behind",
    "normalise",
    "identical",
    "H-P7.identical",
}


def is_ordinary(case):
    """Whether a case has typical inputs."""
    return case.record["flags"] == ["ordinary"]


@cache
def cases(key, seed):
    """Return the held-back cases of an equation; a seed always gives the same.

    They have the form of published cases, and are drawn once for all students.
    """
    return [
        drawn(case, f"{case.id}#{i + 1}", seed)
        for case in published.cases(key)
        for i in range(ORDINARY_DRAWS if is_ordinary(case) else 1)
    ]


def drawn(case, id, seed):
    """Return a case with changed inputs, new cotangents and the reference's answers to them."""
    eq, inputs = EQUATIONS[case.equation], case.inputs()
    rng = np.random.default_rng((seed, zlib.crc32(id.encode())))
    if not FLAGS_OF_KEPT_INPUTS & {case.name, *case.record["flags"]}:
        inputs = change_floats(inputs, lambda a: scaled(a, rng))
    cotangents = tolerance.cotangents_of(eq, eq(**inputs), f"{seed}/{id}")
    answer = tolerance.answer_of(eq)
    answers = answer(inputs, cotangents)
    scales = tolerance.scales(answer, inputs, cotangents, answers, id)
    tensors = {
        **published.flatten(inputs, "in."),
        **published.flatten({n.removesuffix("_bar"): a for n, a in cotangents.items()}, "out_bar."),
        **answers,
        **published.flatten(scales, "scale."),
    }
    return case._replace(id=id, tensors=tensors)


def scaled(a, rng):
    """Return an array whose rows are multiplied by random numbers; unit vectors stay.

    A factor for a whole row leaves covariances symmetric and conics positive definite.
    """
    lengths = np.linalg.norm(a, axis=-1) if a.shape[-1:] in ((3,), (4,)) else 0
    if np.allclose(lengths, 1, rtol=0, atol=1e-9):
        return a
    return (a * rng.uniform(MIN_FACTOR, 1, a.shape[:1] + (1,) * (a.ndim - 1))).astype(a.dtype)
