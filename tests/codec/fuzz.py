"""Damages files in many ways and checks the decoder.

A damaged file must be refused by BitstreamError. It may decode only where lengths and checksums
were made valid again ("repaired"), and then only to a model within every limit of the header. Any
other exception, a warning, more memory than `memory_bound` or more than PATIENCE seconds is a
failure.
"""

import faulthandler
import sys
import time
import tracemalloc
import warnings
from collections import Counter, defaultdict
from functools import cache

import numpy as np

from p4dgs_ref.codec.container import (
    SECTIONS,
    BitstreamError,
    read_container,
    write_container,
)
from p4dgs_ref.codec.file import encode, quantised_of, sections_of
from p4dgs_ref.codec.header import read_header
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.codec.streams import encode_gaussian
from p4dgs_ref.model import declared_numbers
from tests.workshop.damage import mutation
from tests.workshop.sample_model import sample_model

PATIENCE = 5.0  # seconds of processor time: more is too long for a small file
HANGS = 60.0  # seconds after which the program stops with a traceback


@cache
def good_files():
    """Small files: of a scene with every effect, the least, with four lanes."""
    least = dict(d=1, k=1, hidden=(), context=(), grid=(("xz", 2),), F=1, effects=())
    q = quantise(sample_model(3, 50, d=8))
    features = [a[:, :8].ravel() for a in (q.symbols, q.context.mu_units, q.context.sigma_units)]
    lanes = write_container({**sections_of(q), "features": encode_gaussian(*features, lanes=4)})
    return encode(sample_model(1, 12)), encode(sample_model(2, 1, **least)), lanes


def memory_bound(data):
    """The bytes that decoding may take beside the file.

    They are 64 MiB and, where the header is valid, four times the size of the numbers it declares.
    """
    try:
        design, anchors, _ = read_header(read_container(data)["header"])
    except (BitstreamError, KeyError):
        return 2**26
    return 2**26 + 4 * 8 * sum(declared_numbers(design, anchors).values())


def beyond_limits(q):
    """The names of decoded arrays with another shape than the header's or a value out of range."""
    model, design, A = q.model, q.model.design, len(q.positions)
    arrays = model.anchors._asdict()
    shapes = {
        "x_a": (A, 3),
        "f_a": (A, design.d),
        "s_a": (A, 3),
        "l_a": (A, 3),
        "O_a": (A, design.k, 3),
        "mask": (A, design.k),
    }
    for i, (grid, shape) in enumerate(zip(model.grids, design.levels(), strict=True)):
        arrays[f"grid {i}"], shapes[f"grid {i}"] = grid, shape
    for name, pairs in design.layers().items():
        for i, (W, b, pair) in enumerate(zip(*model.networks[name], pairs, strict=True)):
            arrays[f"{name} W {i}"], shapes[f"{name} W {i}"] = W, pair
            arrays[f"{name} b {i}"], shapes[f"{name} b {i}"] = b, pair[1:]
    wrong = [
        name for name, a in arrays.items() if a.shape != shapes[name] or not np.isfinite(a).all()
    ]
    ranges = {"positions": (q.positions, 0, 65535), "symbols": (q.symbols, -(2**31), 2**31)}
    for name, (values, low, high) in ranges.items():
        if not low <= values.min() <= values.max() <= high:
            wrong.append(name)
    return wrong


def judge(case):
    """Decode a mutation: refused, within limits, unchanged or failed, and what is wrong or "".

    Memory is measured where tracemalloc runs.
    """
    tracemalloc.reset_peak()
    before, start = tracemalloc.get_traced_memory()[0], time.process_time()
    changed, q, wrong = case.data != case.original, None, []
    try:
        q = quantised_of(read_container(case.data))
        answer = "within limits" if changed else "unchanged"
    except BitstreamError as error:
        answer = "refused"
        if error.section not in (*SECTIONS, "container") or error.offset < 0 or "\n" in str(error):
            wrong.append(f"refused without a place: {error}")
    except Exception as error:  # any other exception is what the fuzzer looks for
        return "failed", f"{type(error).__name__}: {error}"
    seconds = time.process_time() - start
    peak = tracemalloc.get_traced_memory()[1] - before
    if q is not None:
        wrong += [f"{name} beyond the limits" for name in beyond_limits(q)]
    if answer == "within limits" and case.kind.startswith("raw"):
        wrong.append("changed, but decoded")
    if answer == "refused" and not changed:
        wrong.append("a good file was refused")
    if seconds > PATIENCE:
        wrong.append(f"{seconds:.1f} seconds")
    if peak > memory_bound(case.data):
        wrong.append(f"{peak} bytes of memory, expected at most {memory_bound(case.data)}")
    return ("failed" if wrong else answer), "; ".join(wrong)


def fuzz(count, seed=0):
    """Try mutations 0 to count - 1 of a seed.

    Returns the answers {kind: Counter} and the failures ["mutation i, kind: what is wrong", ...].
    """
    files, answers, failures = good_files(), defaultdict(Counter), []
    traced = tracemalloc.is_tracing()
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # an overflow or a NaN on the way is a failure, too
            for i in range(count):
                faulthandler.dump_traceback_later(HANGS, exit=True, file=sys.__stderr__)
                case = mutation(seed, i, files)
                answer, wrong = judge(case)
                answers[case.kind][answer] += 1
                if wrong:
                    failures.append(f"mutation {i}, {case.kind}: {wrong}")
    finally:
        faulthandler.cancel_dump_traceback_later()
        if not traced:
            tracemalloc.stop()
    return answers, failures
