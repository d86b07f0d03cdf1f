"""Searches for inputs on which an equation is worse than it promises.

    python -m tests.golden.search --count 100000

Genes in [0, 1) are turned into inputs within the domain of an equation (`arenas`). The equation is
evaluated forward and backward in float64 or float32 and once more in a longer float, and the error
is counted in units of what the equation promises (`promises`). The worst inputs are kept, changed a
little, and tried again. A NaN or an infinity counts as infinitely wrong.
"""

import argparse
import sys
import zlib
from typing import NamedTuple

import numpy as np

from p4dgs_ref.oracle.compare import cast, change_floats
from p4dgs_ref.oracle.published import flatten
from p4dgs_ref.table import EQUATIONS

from . import quadrature, terms
from .arenas import ARENAS
from .promises import LEAST, PROMISES

LONGER = {np.float32: np.float64, np.float64: np.longdouble}
PROBES = 8  # random directions in which the size of the terms is measured
ROWS = 128  # inputs that one call evaluates
# Likelihood computes in float64 whatever its inputs are, so its truth needs another program.
TWINS = {"likelihood": quadrature.likelihood}
TERMS = {
    "rotation": terms.rotation,
    "covariance": terms.covariance,
    "projection": terms.projection,
    "ssim": terms.ssim,
    "likelihood": terms.likelihood,
}


class Found(NamedTuple):
    """What the search found out about one equation in one precision."""

    equation: str
    dtype: str
    inputs: int  # how many were tried
    non_finite: int  # inputs with a NaN or an infinity among outputs or gradients
    beyond: int  # inputs with an error beyond the promise
    worst: float  # largest error in units of the promise
    where: str  # the array that has it
    at: dict  # the input {name: array}, with its cotangents


def evaluate(eq, inputs, cotangents):
    """Outputs and gradients as flat arrays, gradients with `_bar` after their names."""
    outputs, pullback = eq.vjp(**inputs)
    return together(outputs, pullback(**cotangents) if eq.gradients else {})


def together(outputs, gradients):
    """Outputs and gradients as one dictionary of flat arrays."""
    return flatten({**outputs, **{name + "_bar": a for name, a in gradients.items()}})


def truth(key, inputs, cotangents, dtype):
    """Outputs and gradients of the same numbers with more digits."""
    if dtype == np.float64 and key in TWINS:
        return together(*TWINS[key](inputs, cotangents))
    longer = LONGER[dtype]
    return evaluate(EQUATIONS[key], cast(inputs, longer), cast(cotangents, longer))


def moved(values, delta, rng, fixed):
    """Every float array times 1 + delta or 1 - delta, with random signs."""

    def move(a):
        signs = rng.choice(np.array([-1, 1], a.dtype), np.shape(a))
        return a * (1 + a.dtype.type(delta) * signs)

    free = {name: a for name, a in values.items() if name not in fixed}
    return {**values, **change_floats(free, move)}


def sizes(key, inputs, cotangents, dtype, bound, want, rng, fixed):
    """The size S of the terms of every array.

    It is the largest change per delta over some random directions, or the number itself.
    """
    delta, longer = bound * np.finfo(dtype).eps / 2, LONGER[dtype]
    S = {name: np.abs(a) for name, a in want.items() if a.dtype.kind == "f"}
    inputs, cotangents = cast(inputs, longer), cast(cotangents, longer)
    seeds = rng.integers(2**62, size=PROBES).tolist()
    probes = [(seed, delta) for seed in seeds]
    probes.append((seeds[0], -delta))  # one direction both ways: one of them crosses a kink
    for seed, step in probes:
        draws = np.random.default_rng(seed)
        changed = moved(inputs, step, draws, fixed), moved(cotangents, step, draws, ())
        probe = truth(key, *changed, dtype)
        for name in S:
            if probe[name].shape == want[name].shape:
                S[name] = np.fmax(S[name], np.abs(probe[name] - want[name]) / delta)
    if key in TERMS:
        given = cast(inputs, np.float64), cast(cotangents, np.float64)
        for name, a in TERMS[key](*given).items():
            S[name] = np.maximum(S[name], a)
    return S


def judge(key, inputs, cotangents, dtype, rng, n):
    """Errors in units of the promise: the worst of each of n inputs, and {array: worst}."""
    arena, promise = ARENAS[key], PROMISES[key]
    bound = promise.double if dtype == np.float64 else promise.single
    eps, least = np.finfo(dtype).eps, LEAST[dtype]
    with np.errstate(all="ignore"):
        got = evaluate(EQUATIONS[key], cast(inputs, dtype), cast(cotangents, dtype))
        want = truth(key, inputs, cotangents, dtype)
        S = sizes(key, inputs, cotangents, dtype, bound, want, rng, arena.fixed)
        scores, of = np.zeros(n), {}
        for name, a in got.items():
            if a.dtype.kind == "f":
                gap = np.abs(a.astype(want[name].dtype) - want[name]).astype(float)
                error = gap / (bound * eps * S[name] + least).astype(float)
                error = np.where(np.isfinite(a), error, np.inf)
            elif a.shape == want[name].shape:
                error = np.where(a == want[name], 0.0, np.inf)
            else:
                error = np.full(1, np.inf)
            of[name] = float(error.max(initial=0))
            by_row = arena.rows and error.ndim and len(error) == n
            worst = error.reshape(n, -1).max(axis=1, initial=0) if by_row else of[name]
            scores = np.maximum(scores, worst)
    return scores, of


def draw_cotangents(eq, inputs, rng, dtype):
    """Normal numbers of sizes from 1e-2 to 1e2 for every float output."""
    with np.errstate(all="ignore"):
        outputs = eq(**cast(inputs, dtype))

    def draw(a):
        numbers = rng.normal(size=np.shape(a)) * 10.0 ** rng.uniform(-2, 2, np.shape(a))
        return np.asarray(numbers).astype(dtype)

    return {
        name + "_bar": draw(a)
        for name, a in outputs.items()
        if eq.gradients and np.asarray(a).dtype.kind == "f"
    }


def mutate(genes, rng):
    """Change a few genes of every row.

    A gene is nudged, drawn again, replaced by another one of its row, mirrored (which changes a
    sign), or moved to an end of its range.
    """
    genes, (n, m) = genes.copy(), genes.shape
    hit = rng.random((n, m)) < max(1.5 / m, 0.1)
    kind = rng.integers(0, 6, (n, m))
    other = np.take_along_axis(genes, rng.integers(0, m, (n, m)), axis=1)
    nudged = genes + 10.0 ** rng.uniform(-14, -1, (n, m)) * rng.choice([-1, 1], (n, m))
    drawn, ends = rng.random((n, m)), rng.choice([0.0, 0.4999, 1.0], (n, m))
    new = np.choose(kind, [nudged, drawn, other, 1 - genes, ends, nudged])
    return np.where(hit, np.clip(new, 0, 1 - 2.0**-53), genes)


def search(key, dtype, count, seed=0):
    """Try `count` inputs of an equation in one precision."""
    arena, eq = ARENAS[key], EQUATIONS[key]
    rng = np.random.default_rng([seed, zlib.crc32(key.encode()), np.dtype(dtype).itemsize])
    n = ROWS if arena.rows else 1
    tried = non_finite = beyond = 0
    best, record = (-1.0, "", {}), -1.0
    elite, value = np.zeros((0, arena.own)), np.zeros(0)  # the worst inputs and their scores
    shared = rng.random((1, arena.shared))
    while tried < count:
        own, common = rng.random((n, arena.own)), rng.random((1, arena.shared))
        if len(elite):
            climbing = rng.random(n) < 0.7
            parents = elite[rng.integers(0, len(elite), climbing.sum())]
            own[climbing] = mutate(parents, rng)
            common = mutate(shared, rng) if arena.shared and rng.random() < 0.7 else common
        inputs = cast(cast(arena.decode(own, common[0], dtype), dtype), np.float64)
        cotangents = draw_cotangents(eq, inputs, rng, dtype)
        scores, of = judge(key, inputs, cotangents, dtype, rng, n)
        tried += n
        non_finite += int(np.isinf(scores).sum())
        beyond += int((scores > 1).sum())
        if scores.max() > best[0]:
            at = row_of({**inputs, **cotangents}, int(scores.argmax()), n, arena)
            best = float(scores.max()), max(of, key=of.get), at
        if scores.max() > record:
            shared, record = common, scores.max()
        elite, value = np.concatenate([elite, own]), np.concatenate([value, scores])
        keep = np.argsort(-value, kind="stable")[:16]
        # Old scores fade, because they may be due to the other rows of their call.
        elite, value = elite[keep], value[keep] * 0.999
    return Found(key, np.dtype(dtype).name, tried, non_finite, beyond, *best)


def row_of(values, i, n, arena):
    """One input of a call of n."""
    if not arena.rows:
        return values
    return {
        name: a[i : i + 1] if isinstance(a, np.ndarray) and a.ndim and len(a) == n else a
        for name, a in values.items()
    }


def run(count=100_000, seed=0, report=lambda found: None):
    """Spend `count` inputs on all equations, half in either precision."""
    total = sum(arena.share for arena in ARENAS.values())
    found = []
    for key, arena in ARENAS.items():
        for dtype in (np.float64, np.float32):
            share = int(np.ceil(count * arena.share / total / 2))
            found.append(search(key, dtype, share, seed))
            report(found[-1])
    return found


def describe(f):
    """One line about one equation in one precision."""
    return (
        f"{f.equation} {f.dtype}: {f.inputs:,} inputs, {f.non_finite} not finite, {f.beyond} "
        f"beyond the promised error; the worst has {f.worst:.2f} of it, in {f.where}"
    )


def main(arguments):
    """The exit code: 0 if every equation keeps its promise, 1 otherwise."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden.search")
    parser.add_argument("--count", type=int, default=100_000, help="inputs to try (default 100000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the search (default 0)")
    options = parser.parse_args(arguments)
    found = run(options.count, options.seed, report=lambda f: print(describe(f), flush=True))
    bad = sum(f.non_finite + f.beyond for f in found)
    print(f"{sum(f.inputs for f in found):,} inputs tried, {bad} beyond what is promised")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
