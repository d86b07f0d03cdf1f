"""The search that climbs toward trouble: for every equation, inputs of its domain that go wrong, if there are any.

Genes of random inputs are turned into inputs (`arenas`), the equation is evaluated forward and backward in float64 or
float32 and once more in a longer float, and the error is counted in units of what is promised (`promises`).  The worst
inputs are kept, changed a little, and tried again.  A number that is not finite counts as infinitely wrong.
"""

import argparse
import sys
import zlib
from typing import NamedTuple

import numpy as np

from p4dgs_ref.studies.precision import cast
from p4dgs_ref.table import EQUATIONS

from . import quadrature, terms
from .arenas import ARENAS
from .promises import LEAST, PROMISES

LONGER = {np.float32: np.float64, np.float64: np.longdouble}
PROBES = 8  # random directions in which the size of the terms is measured
ROWS = 128  # inputs that one call evaluates
TWINS = {"likelihood": quadrature.likelihood}  # where the equation itself is float64 inside
TERMS = {
    "rotation": terms.rotation,
    "covariance": terms.covariance,
    "projection": terms.projection,
    "ssim": terms.ssim,
    "likelihood": terms.likelihood,
}


class Found(NamedTuple):
    """What the search knows of one equation in one precision."""

    equation: str
    dtype: str
    inputs: int  # how many were tried
    non_finite: int  # inputs with a NaN or an infinity among outputs or gradients
    beyond: int  # inputs with an error beyond what is promised
    worst: float  # largest error in units of the promise
    where: str  # the array it is in
    at: dict  # the input: {name: array}, with its cotangents


def flat(values):
    """{"weights": [W, V]} -> {"weights.0": W, "weights.1": V}; what is no array is left out."""
    found = {}
    for name, value in values.items():
        if isinstance(value, list):
            found.update({f"{name}.{i}": np.asarray(a) for i, a in enumerate(value)})
        elif isinstance(value, (np.ndarray, np.generic)):
            found[name] = np.asarray(value)
    return found


def evaluate(eq, inputs, cotangents):
    """Outputs and gradients as flat arrays, gradients with `_bar` behind their names."""
    out, res = eq.forward(**inputs)
    return _named(out._asdict(), eq.backward(res, **cotangents) if eq.differentiable else {})


def _named(out, gradients):
    return flat({**out, **{name + "_bar": a for name, a in gradients.items()}})


def truth(key, inputs, cotangents, dtype):
    """Outputs and gradients of the same numbers with more digits."""
    if dtype == np.float64 and key in TWINS:
        return _named(*TWINS[key](inputs, cotangents))
    longer = LONGER[dtype]
    return evaluate(EQUATIONS[key], cast(inputs, longer), cast(cotangents, longer))


def moved(values, delta, rng, fixed):
    """Every float array times 1 +- delta, signs drawn at random."""

    def move(a):
        if isinstance(a, list):
            return [move(b) for b in a]
        if isinstance(a, (np.ndarray, np.generic)) and a.dtype.kind == "f":
            return a * (
                1 + a.dtype.type(delta) * rng.choice(np.array([-1, 1], a.dtype), np.shape(a))
            )
        return a

    return {name: a if name in fixed else move(a) for name, a in values.items()}


def sizes(key, inputs, cotangents, dtype, bound, want, rng, fixed):
    """S of every array: the largest change per delta over some random directions, or the number itself."""
    delta = bound * np.finfo(dtype).eps / 2
    longer = LONGER[dtype]
    S = {name: np.abs(a) for name, a in want.items() if a.dtype.kind == "f"}
    inputs, cotangents = cast(inputs, longer), cast(cotangents, longer)
    seeds = rng.integers(2**62, size=PROBES).tolist()
    for seed, step in [
        *((seed, delta) for seed in seeds),
        (seeds[0], -delta),
    ]:  # one there and back: one crosses a kink
        draws = np.random.default_rng(seed)
        probe = truth(
            key, moved(inputs, step, draws, fixed), moved(cotangents, step, draws, ()), dtype
        )
        for name in S:
            if probe[name].shape == want[name].shape:
                S[name] = np.fmax(S[name], np.abs(probe[name] - want[name]) / delta)
    larger = (
        TERMS[key](cast(inputs, np.float64), cast(cotangents, np.float64), S)
        if key in TERMS
        else {}
    )
    return {**S, **{name: np.maximum(S[name], a) for name, a in larger.items()}}


def judge(key, inputs, cotangents, dtype, rng, n):
    """Errors in units of what is promised: worst of each of the n inputs (n,), and of every array {name: number}."""
    arena, promise = ARENAS[key], PROMISES[key]
    bound = promise.double if dtype == np.float64 else promise.single
    eps, least = np.finfo(dtype).eps, LEAST[dtype]
    with np.errstate(all="ignore"):
        got = evaluate(EQUATIONS[key], cast(inputs, dtype), cast(cotangents, dtype))
        want = truth(key, inputs, cotangents, dtype)
        S = sizes(key, inputs, cotangents, dtype, bound, want, rng, arena.fixed)
        scores, of = np.zeros(n), {}
        for name, a in got.items():
            if a.dtype.kind != "f":
                error = (
                    np.where(a == want[name], 0.0, np.inf)
                    if a.shape == want[name].shape
                    else np.full(1, np.inf)
                )
            else:
                off = np.abs(a.astype(want[name].dtype) - want[name]).astype(float)
                error = off / (bound * eps * S[name] + least).astype(float)
                error = np.where(np.isfinite(a), error, np.inf)
            of[name] = float(error.max(initial=0))
            by_row = arena.rows and error.ndim and len(error) == n
            scores = np.maximum(
                scores, error.reshape(n, -1).max(axis=1, initial=0) if by_row else of[name]
            )
    return scores, of


def draw_cotangents(eq, inputs, rng, dtype):
    """Normal numbers of sizes from 1e-2 to 1e2 for every float output."""
    with np.errstate(all="ignore"):
        out = eq.forward(**cast(inputs, dtype))[0]._asdict()
    draw = lambda a: (
        rng.normal(size=np.shape(a)) * 10.0 ** rng.uniform(-2, 2, np.shape(a))
    ).astype(dtype)
    return {
        name + "_bar": [draw(b) for b in a] if isinstance(a, list) else draw(a)
        for name, a in out.items()
        if a is not None
        and eq.differentiable
        and all(b.dtype.kind == "f" for b in flat({"": a}).values())
    }


def mutate(genes, rng):
    """Change a few genes of every row: nudge, redraw, copy another of the row, mirror (which is a sign), or to an end."""
    genes, (n, m) = genes.copy(), genes.shape
    hit = rng.random((n, m)) < max(1.5 / m, 0.1)
    kind = rng.integers(0, 6, (n, m))
    other = np.take_along_axis(genes, rng.integers(0, m, (n, m)), axis=1)
    nudged = genes + 10.0 ** rng.uniform(-14, -1, (n, m)) * rng.choice([-1, 1], (n, m))
    new = np.choose(
        kind,
        [
            nudged,
            rng.random((n, m)),
            other,
            1 - genes,
            rng.choice([0.0, 0.4999, 1.0], (n, m)),
            nudged,
        ],
    )
    return np.where(hit, np.clip(new, 0, 1 - 2.0**-53), genes)


def search(key, dtype, count, seed=0):
    """Try `count` inputs of an equation: Found."""
    arena, eq = ARENAS[key], EQUATIONS[key]
    rng = np.random.default_rng([seed, zlib.crc32(key.encode()), np.dtype(dtype).itemsize])
    n, tried, non_finite, beyond, best = (ROWS if arena.rows else 1), 0, 0, 0, (-1.0, "", {})
    elite, shared, record = np.zeros((0, arena.own)), rng.random((1, arena.shared)), -1.0
    value = np.zeros(0)  # scores of the elite
    while tried < count:
        own, common = rng.random((n, arena.own)), rng.random((1, arena.shared))
        if len(elite):
            climbing = rng.random(n) < 0.7
            own[climbing] = mutate(elite[rng.integers(0, len(elite), climbing.sum())], rng)
            common = mutate(shared, rng) if arena.shared and rng.random() < 0.7 else common
        inputs = cast(cast(arena.decode(own, common[0], dtype), dtype), np.float64)
        cotangents = draw_cotangents(eq, inputs, rng, dtype)
        scores, of = judge(key, inputs, cotangents, dtype, rng, n)
        tried, non_finite, beyond = (
            tried + n,
            non_finite + int(np.isinf(scores).sum()),
            beyond + int((scores > 1).sum()),
        )
        if scores.max() > best[0]:
            best = (
                float(scores.max()),
                max(of, key=of.get),
                _row({**inputs, **cotangents}, int(scores.argmax()), n, arena),
            )
        if scores.max() > record:
            shared, record = common, scores.max()
        elite, value = np.concatenate([elite, own]), np.concatenate([value, scores])
        keep = np.argsort(-value, kind="stable")[:16]
        elite, value = (
            elite[keep],
            value[keep] * 0.999,
        )  # old records fade: they may owe to their neighbours
    return Found(key, np.dtype(dtype).name, tried, non_finite, beyond, *best)


def _row(values, i, n, arena):
    """One input of a call of n: rows of arrays that have one for each."""
    if not arena.rows:
        return values
    return {
        name: a[i : i + 1] if isinstance(a, np.ndarray) and a.ndim and len(a) == n else a
        for name, a in values.items()
    }


def run(count=100_000, seed=0, keys=None, report=lambda found: None):
    """Spend `count` inputs on all equations (or on `keys`), half in either precision: [Found, ...]."""
    keys = list(keys or ARENAS)
    total = sum(ARENAS[key].share for key in keys)
    found = []
    for key in keys:
        for dtype in (np.float64, np.float32):
            found.append(
                search(key, dtype, int(np.ceil(count * ARENAS[key].share / total / 2)), seed)
            )
            report(found[-1])
    return found


def main(arguments):
    """`python -m tests.golden.search`: 0 if nothing was found, 1 otherwise."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden.search", description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="inputs to try (default 100000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the search (default 0)")
    options = parser.parse_args(arguments)
    found = run(options.count, options.seed, report=lambda f: print(describe(f), flush=True))
    bad = sum(f.non_finite + f.beyond for f in found)
    print(f"{sum(f.inputs for f in found):,} inputs tried, {bad} beyond what is promised")
    return int(bad > 0)


def describe(f):
    """One line about what was found for one equation in one precision."""
    return (
        f"{f.equation} {f.dtype}: {f.inputs:,} inputs, {f.non_finite} not finite, {f.beyond} "
        f"beyond the promised error; the worst has {f.worst:.2f} of it, in {f.where}"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
