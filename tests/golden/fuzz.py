"""Damages files in many ways and watches the decoder: `python -m tests.golden.fuzz --count N`.

Every damaged file must be refused by `BitstreamError`; only where lengths and checksums were put in order again
("repaired") may it also decode, to a model within every limit of the header.  Never another exception or a warning, never
more memory than `memory_bound`, never more than PATIENCE seconds.
"""

import argparse
import faulthandler
import sys
import time
import tracemalloc
import warnings
from collections import Counter, defaultdict
from functools import cache

import numpy as np

from p4dgs_ref.codec.container import SECTIONS, BitstreamError, open_container, write_container
from p4dgs_ref.codec.file import encode, quantised_of, sections_of
from p4dgs_ref.codec.header import declared_numbers, read_header
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.codec.streams import encode_gaussian
from p4dgs_ref.studies.random_inputs import sample_model
from tests.golden.damage import mutation

PATIENCE, HANGS = (
    5.0,
    60.0,
)  # seconds: too long for a small file; and when to give up on it with a traceback
ANSWERS = ("refused", "within limits", "unchanged", "failed")


@cache
def good_files():
    """Three small files: a scene with everything, the least one, and one whose features are coded in four lanes."""
    least = dict(d=1, k=1, hidden=(), context=(), grid=(("xz", 2),), F=1, effects=())
    q = quantise(sample_model(3, 50, d=8))
    features = [a[:, :8].ravel() for a in (q.symbols, q.context.mu_units, q.context.sigma_units)]
    lanes = write_container({**sections_of(q), "features": encode_gaussian(*features, lanes=4)})
    return encode(sample_model(1, 12)), encode(sample_model(2, 1, **least)), lanes


def memory_bound(data):
    """Bytes that decoding may take beside the file: 64 MiB and, where there is a header, four times what it declares."""
    try:
        design, anchors, _ = read_header(open_container(data)["header"])
    except (BitstreamError, KeyError):
        return 2**26
    return 2**26 + 4 * 8 * sum(declared_numbers(design, anchors))


def beyond_limits(q):
    """The arrays of a decoded file that are not what its header declares, or hold what the format does not allow."""
    model, design, A = q.model, q.model.design, len(q.positions)
    arrays, shapes = (
        model.anchors._asdict(),
        {
            "x_a": (A, 3),
            "f_a": (A, design.d),
            "s_a": (A, 3),
            "l_a": (A, 3),
            "O_a": (A, design.k, 3),
            "mask": (A, design.k),
        },
    )
    for i, (grid, shape) in enumerate(zip(model.grids, design.levels(), strict=True)):
        arrays[f"grid {i}"], shapes[f"grid {i}"] = grid, shape
    for name, pairs in design.layers().items():
        for i, (W, b, pair) in enumerate(zip(*model.networks[name], pairs, strict=True)):
            arrays.update({f"{name} W {i}": W, f"{name} b {i}": b})
            shapes.update({f"{name} W {i}": pair, f"{name} b {i}": pair[1:]})
    ranges = {"positions": (q.positions, 0, 65535), "symbols": (q.symbols, -(2**31), 2**31)}
    return [
        name for name, a in arrays.items() if a.shape != shapes[name] or not np.isfinite(a).all()
    ] + [name for name, (a, low, high) in ranges.items() if not low <= a.min() <= a.max() <= high]


def judge(case):
    """(one of ANSWERS, what is wrong or "") for a mutation; counts memory where tracemalloc runs."""
    tracemalloc.reset_peak()
    before, start, wrong = tracemalloc.get_traced_memory()[0], time.perf_counter(), []
    try:
        q = quantised_of(open_container(case.data))
        answer = "unchanged" if case.data == case.original else "within limits"
    except BitstreamError as error:
        answer = "refused"
        if error.section not in (*SECTIONS, "container") or error.offset < 0 or "\n" in str(error):
            wrong.append(f"refused without a place: {error}")
    except Exception as error:  # whatever it is, it is what we are looking for
        return "failed", f"{type(error).__name__}: {error}"
    seconds, peak = time.perf_counter() - start, tracemalloc.get_traced_memory()[1] - before
    if answer != "refused":
        wrong += [f"{name} beyond the limits" for name in beyond_limits(q)]
    if answer == "within limits" and case.kind.startswith("raw"):
        wrong.append("changed, and yet decoded")
    if answer == "refused" and case.data == case.original:
        wrong.append("a good file was refused")
    if seconds > PATIENCE:
        wrong.append(f"{seconds:.1f} seconds")
    if peak > memory_bound(case.data):
        wrong.append(f"{peak} bytes of memory, at most {memory_bound(case.data)} expected")
    return ("failed" if wrong else answer), "; ".join(wrong)


def fuzz(count, seed=0, files=None):
    """Try mutations 0 ... count - 1 of a seed: ({kind: Counter of answers}, ["mutation i, kind: what is wrong", ...])."""
    files, answers, failures, traced = (
        files or good_files(),
        defaultdict(Counter),
        [],
        tracemalloc.is_tracing(),
    )
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # an overflow or a NaN on the way is a failure, too
            for i in range(count):
                faulthandler.dump_traceback_later(HANGS, exit=True, file=sys.__stderr__)
                case = mutation(seed, i, files)
                answer, wrong = judge(case)
                answers[case.kind][answer] += 1
                failures += [f"mutation {i}, {case.kind}: {wrong}"] if wrong else []
    finally:
        faulthandler.cancel_dump_traceback_later()
        if not traced:
            tracemalloc.stop()
    return answers, failures


def main(arguments=None):
    parser = argparse.ArgumentParser(
        prog="python -m tests.golden.fuzz", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--count", type=int, default=2000, help="how many mutations (default: 2000)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="mutations are numbered under a seed (default: 0)"
    )
    parser.add_argument(
        "file", nargs="?", help="a good file to start from instead of three small built-in ones"
    )
    options = parser.parse_args(arguments)
    files = None
    if options.file:
        try:
            with open(options.file, "rb") as stream:
                files = (stream.read(),)
            quantised_of(open_container(files[0]))
        except (OSError, BitstreamError) as error:
            parser.error(f"{options.file}: a good file expected, {error}")
    answers, failures = fuzz(options.count, options.seed, files)
    print(f"{'':28}" + "".join(f"{name:>15}" for name in ANSWERS))
    for kind, counts in [*sorted(answers.items()), ("all", sum(answers.values(), Counter()))]:
        print(f"{kind:28}" + "".join(f"{counts[name]:15,}" for name in ANSWERS))
    print(
        "\n".join(failures[:20])
        or "no unexpected exception, no accepted change, no hang, no excess of memory"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
