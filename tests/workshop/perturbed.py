"""Every published tensor with a mistake in it: which are not noticed, and why.

`python -m tests.workshop.perturbed` writes `data/unnoticed.csv` in some minutes: a row for every
change of a tensor that passes, is acceptable or is not judged. A reason is written by hand, and
stays; without one a test fails.
"""

import csv
from pathlib import Path

import numpy as np

from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle.compare import cast, expected, measured

TABLE = Path(__file__).parent / "data" / "unnoticed.csv"
FIELDS = ("precision", "case", "tensor", "change", "verdict", "reason")
PRECISIONS = ("float64", "float32")


def changes(a):
    """Yield (name of the change, changed copy) of an array that is not empty."""

    def at(i, value):
        wrong = np.array(a)
        wrong.flat[i] = value
        return wrong

    if len(a) > 1 if a.ndim else False:
        other = next((i for i in range(1, len(a)) if not equal(a[0], a[i])), None)
        if other is not None:
            wrong = np.array(a)
            wrong[[0, other]] = wrong[[other, 0]]
            yield "two rows", wrong
    if a.dtype.kind != "f":
        yield "one", at(0, not a.flat[0] if a.dtype.kind == "b" else a.flat[0] + 1)
        return
    size = np.where(np.isfinite(a), np.abs(a), 0)
    largest = int(size.argmax())
    smallest = int(np.where(size > 0, size, np.inf).argmin())
    yield "NaN", at(largest, np.nan)
    if size.flat[largest]:
        yield "largest", at(largest, 1.001 * a.flat[largest])
        yield "smallest sign", at(smallest, -a.flat[smallest])
        yield from (("all by 1e-3", 1.001 * a), ("zero", 0 * size), ("all signs", -a))
    else:
        yield "largest", at(largest, 1e-3)


def equal(a, b):
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def unnoticed(key, precision):
    """Yield the rows of a subject, without reasons."""
    for case in published.cases(key):
        not_judged = case.not_judged(precision)
        with np.errstate(over="ignore"):
            right = cast(expected(case.tensors), precision)
        for name, a in right.items():
            if name in not_judged or not a.size:
                continue
            # Alone, to save time; what the printed formula leaves depends on other tensors.
            names = right if (case.id, precision) in measured() else [name]
            kept = {n: b for n, b in case.tensors.items() if n.removeprefix("scale.") in names}
            for change, wrong in changes(a):
                answer = {n: right[n] for n in names} | {name: wrong.astype(a.dtype)}
                result = checker.judge_answer(case._replace(tensors=kept), answer)
                if result.verdict != "fail" and not equal(wrong.astype(a.dtype), a):
                    verdict = "not judged" if name in result.not_judged else result.verdict
                    yield precision, case.id, name, change, verdict


def reasons():
    """Return {row without its reason: reason} of the table."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {tuple(row[:-1]): row[-1] for row in list(csv.reader(file))[1:]}


def main():
    known = reasons() if TABLE.exists() else {}
    rows = [
        (*row, known.get(row, ""))
        for precision in PRECISIONS
        for key in published.subjects()
        for row in unnoticed(key, precision)
    ]
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([FIELDS, *rows])
    missing = sum(not row[-1] for row in rows)
    print(f"{len(rows)} changes are not noticed, {missing} without a reason")


if __name__ == "__main__":
    main()
