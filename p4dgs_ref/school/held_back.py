"""Inputs that no student has seen: an equation's cases, drawn anew by a seed, with the reference's answers and bounds."""

import zlib

import numpy as np

from ..oracle import tolerance
from ..oracle.published import Golden
from ..oracle.subjects import flatten, run, settings
from ..oracle.vectors import cotangents_of

DRAWS = 3  # of every ordinary case; one of every other
LEAST = 0.8  # numbers are multiplied by 0.8 ... 1: signs, zeros and every bound on a magnitude stay
# What these cases are about does not survive a change of single numbers: their axes are permuted instead.
KEPT = {"kink", "tie", "clamped", "outside", "order", "extreme", "tail", "narrow", "wide", "behind"}


def is_ordinary(case):
    return tuple(case.flags) == ("ordinary",)


def cases(subject, seed):
    """[Golden] of a subject, the ordinary ones first; the same for the same seed."""
    found = []
    for case in sorted(subject.cases(), key=lambda case: not is_ordinary(case)):
        for draw in range(DRAWS if is_ordinary(case) else 1):
            name = f"{case.name}#{draw + 1}" if is_ordinary(case) else case.name
            found.append(golden(subject, case, f"{subject.key}/{name}", seed))
    return found


def golden(subject, case, id, seed):
    """One case drawn anew, as if it stood among the published vectors."""
    rng = np.random.default_rng((seed, zlib.crc32(id.encode())))
    inputs = permuted(subject.eq, case.inputs, rng)
    if case.smooth and not KEPT & set(case.flags):
        inputs = changed(inputs, rng)
    case = case._replace(inputs=inputs, cotangents={}, expected={})
    out = subject.eq.forward(**inputs)[0]
    cotangents = cotangents_of(subject.eq, case, out, f"{seed}/{id}")
    flat = tolerance.named(*run(subject.eq, inputs, cotangents))
    scale = tolerance.scales(subject.eq, case, cotangents, flat)
    error = tolerance.float32_error(subject.eq, case, cotangents, flat, scale)
    record = {
        "result": "valid",
        "flags": list(case.flags),
        "settings": settings(inputs),
        "tolerance": tolerance.tolerances(
            error, any(name.split(".")[1] in tolerance.IMAGES for name in flat)
        ),
    }
    tensors = {
        **flatten(inputs, "in."),
        **flatten({n[:-4]: a for n, a in cotangents.items()}, "out_bar."),
        **flat,
        **{f"scale.{name}": a for name, a in scale.items()},
    }
    return Golden(id, case.name, subject.key, subject.key, "L1", record, tensors)


def permuted(eq, inputs, rng):
    """Inputs with every lettered axis in another order, the same in all arrays that have it."""
    axes = {
        name: eq.shapes[name].split("->")[0].split()
        for name, a in inputs.items()
        if isinstance(a, np.ndarray) and not eq.shapes.get(name, "*").startswith("*")
    }
    axes = {name: letters for name, letters in axes.items() if len(letters) == inputs[name].ndim}
    lengths = {}
    for name, letters in axes.items():
        for letter, n in zip(letters, inputs[name].shape):
            lengths.setdefault(letter, set()).add(n)
    orders = {
        letter: rng.permutation(min(n))
        for letter, n in sorted(lengths.items())
        if letter.isalpha() and len(n) == 1
    }
    made = dict(inputs)
    for name, letters in axes.items():
        for i, letter in enumerate(letters):
            if letter in orders:
                made[name] = np.take(made[name], orders[letter], axis=i)
    return made


def changed(inputs, rng):
    """Inputs with every float multiplied by a random number; what must stay a rotation, a direction or a covariance does."""
    return {
        name: [_noisy(name, a, rng) for a in value]
        if isinstance(value, list)
        else _noisy(name, value, rng)
        for name, value in inputs.items()
    }


def _noisy(name, a, rng):
    if not isinstance(a, (np.ndarray, np.generic)) or np.asarray(a).dtype.kind != "f":
        return a
    factor = rng.uniform(LEAST, 1, np.shape(a))
    if name == "conic":  # (a, b, c) of D K D with a diagonal D stays positive definite
        d = factor[:, :2]
        factor = np.stack([d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2], axis=1)
    elif np.shape(a)[-2:] == (3, 3):
        if np.ndim(a) == 2:  # the rotation from world to camera
            return a
        factor = factor[:, :1] * factor[:, :1].swapaxes(1, 2)
    made = (a * factor).astype(a.dtype)
    if np.ndim(a) and np.shape(a)[-1] in (3, 4) and np.size(a):
        norm = np.linalg.norm(a, axis=-1)
        if np.allclose(norm, 1, rtol=0, atol=1e-9):
            made /= np.linalg.norm(made, axis=-1, keepdims=True)
    return made
