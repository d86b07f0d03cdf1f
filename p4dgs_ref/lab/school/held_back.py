"""Inputs that no student has seen: the published cases of an equation, changed by a seed.

The reference's answers and the bounds on errors come with them.
"""

import zlib
from functools import cache

import numpy as np

from ...oracle import published, tolerance
from ...table import EQUATIONS

DRAWS = 3  # of every ordinary case; one of every other case
# Numbers are multiplied by 0.8 to 1, which preserves signs, zeros and upper bounds on magnitudes.
LEAST = 0.8
# Cases with these flags or names would lose their point if single numbers changed. Only the order
# along their axes is changed.
KEPT = {
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
    """Return the held-back cases of an equation, ordinary ones first; a seed always gives the same.

    They have the form of published cases, and are drawn once for all students.
    """
    found = []
    for case in sorted(published.cases(key), key=lambda case: not is_ordinary(case)):
        draws = [f"#{i + 1}" for i in range(DRAWS)] if is_ordinary(case) else [""]
        found += [drawn(case, f"{key}/{case.name}{draw}", seed) for draw in draws]
    return found


def drawn(case, id, seed):
    """Return a case with changed inputs, new cotangents and the reference's answers to them."""
    eq = EQUATIONS[case.equation]
    rng = np.random.default_rng((seed, zlib.crc32(id.encode())))
    inputs = permuted(published.subjects()[eq.key]["shapes"], case.inputs(), rng)
    if not KEPT & {case.name, *case.record["flags"]}:
        inputs = changed(inputs, rng)
    outputs = eq(**inputs)
    cotangents = tolerance.cotangents_of(eq, outputs, f"{seed}/{id}")
    answer = tolerance.answer_of(eq)
    answers = answer(inputs, cotangents)
    scales = tolerance.scales(answer, inputs, cotangents, answers, id)
    bars = {name.removesuffix("_bar"): a for name, a in cotangents.items()}
    tensors = {
        **published.flatten(inputs, "in."),
        **published.flatten(bars, "out_bar."),
        **answers,
        **{f"scale.{name}": a for name, a in scales.items()},
    }
    return case._replace(id=id, tensors=tensors)


def permuted(shapes, inputs, rng):
    """Return inputs in another order along every named axis, the same order in all arrays.

    `shapes` are those of the manifest, such as "A k 3 -> N 3"; lists of arrays begin with "*".
    """
    made = dict(inputs)
    orders = {}
    for name, a in inputs.items():
        letters = shapes.get(name, "*").split("->")[0].split()
        if isinstance(a, np.ndarray) and len(letters) == a.ndim:
            for axis, (letter, n) in enumerate(zip(letters, a.shape)):
                if letter.isalpha():
                    order = orders.setdefault((letter, n), rng.permutation(n))
                    made[name] = np.take(made[name], order, axis=axis)
    return made


def changed(inputs, rng):
    """Return inputs with every float multiplied by a random number."""
    return {
        name: [scaled(name, a, rng) for a in value]
        if isinstance(value, list)
        else scaled(name, value, rng)
        for name, value in inputs.items()
    }


def scaled(name, a, rng):
    """Return one array with changed floats.

    Rotations, directions, conics and covariances keep this property.
    """
    is_array = isinstance(a, (np.ndarray, np.generic))
    if not is_array or a.dtype.kind != "f" or a.shape == (3, 3):  # (3, 3): the camera's rotation
        return a
    factor = rng.uniform(LEAST, 1, a.shape)
    if name == "conic":  # (a, b, c) of D K D with a diagonal D stays positive definite
        d, e = factor[:, 0], factor[:, 1]
        factor = np.stack([d * d, d * e, e * e], axis=1)
    elif a.shape[-2:] == (3, 3):
        factor = factor[:, :1] * factor[:, :1].swapaxes(1, 2)
    made = (a * factor).astype(a.dtype)
    if a.size and a.shape[-1:] in ((3,), (4,)):
        norm = np.linalg.norm(a, axis=-1)
        if np.allclose(norm, 1, rtol=0, atol=1e-9):
            made /= np.linalg.norm(made, axis=-1, keepdims=True)
    return made
