"""The kill matrix: which known mistakes, and which one-token mutations of our own code, do the vectors notice and name?

`python tests/kill_matrix.py` writes tests/kill_matrix.csv anew (a minute on one core).

killed     a required case of the vectors fails: beyond the float64 tolerance, another shape or type, an exception
named      the first case to fail, in the order in which data flows, blames the equation in which the change stands
explained  of a known mistake: the doctor names it; of a mutation: it names a mistake that agrees in every failing case
"""

import csv
import inspect
import io
import signal
import sys
import warnings
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from unittest.mock import patch

import numpy as np
import scipy.sparse

from p4dgs_ref.equations import gaussian_bin, grid_nodes
from p4dgs_ref.oracle import doctor, published
from p4dgs_ref.oracle.compare import compare, precision
from p4dgs_ref.oracle.mistakes import MISTAKES
from p4dgs_ref.oracle.subjects import run, subjects
from p4dgs_ref.oracle.tolerance import named
from p4dgs_ref.oracle.vectors import FOLDER, read_manifest
from p4dgs_ref.splatting import compositing
from p4dgs_ref.studies.precision import cast
from tests.golden.equivalent import EQUIVALENT
from tests.golden.known_mistakes import PATCHES, patched
from tests.golden.mutate import applied, mutations

MATRIX = Path(__file__).with_name("kill_matrix.csv")
COLUMNS = ("id", "kind", "equation", "description", "killed", "named", "explained", "note")
PATIENCE = 20  # seconds for one changed program, which normally takes a fraction of one


class Overdue(Exception):
    """A changed program that does not end."""


@contextmanager
def deadline(seconds):
    """Interrupt what takes longer, each time anew."""

    def stop(*_):
        raise Overdue

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds, seconds)  # again and again: every case may hang
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def checked_matrix(*arguments, **keywords):
    """SciPy's products do not check indices: one out of range would read, or overwrite, anything."""
    matrix = scipy.sparse.csr_matrix(*arguments, **keywords)
    matrix.check_format(full_check=True)
    return matrix


@contextmanager
def laboratory():
    """Where changed code may run: it can neither harm nor hang nor chatter."""
    with (
        warnings.catch_warnings(),
        np.errstate(all="ignore"),
        deadline(PATIENCE),
        patch.object(grid_nodes, "csr_matrix", checked_matrix),
    ):
        warnings.simplefilter("ignore")
        yield


@contextmanager
def small_portions():
    """Even small cases are computed in several portions."""
    with patch.object(compositing, "BLOCK", 64), patch.object(gaussian_bin, "PIECE", 7):
        yield


class Judge:
    """The published vectors, put to this project's own code as it stands at the moment."""

    def __init__(self, folder=FOLDER):
        self.subjects = subjects()
        self.cases = [
            case
            for row in read_manifest(folder)["subjects"]
            for case in published.read(row, folder)
            if case.record["result"] == "valid"
        ]
        self.reached = [self._functions(case) for case in self.cases]

    def answer(self, case, dtype=np.float64):
        """Outputs and gradients of one case, in either precision."""
        return named(
            *run(
                self.subjects[case.subject].eq,
                cast(case.inputs(), dtype),
                cast(case.cotangents(), dtype),
            )
        )

    def in_parts(self, case):
        """The same with one cotangent at a time: the others are None, which stands for zero, and gradients add up."""
        eq, cotangents = self.subjects[case.subject].eq, case.cotangents()
        parameters = inspect.signature(eq.backward).parameters
        optional = [parameters[name].default is None for name in cotangents if name in parameters]
        if len(optional) < 2 or not all(optional):
            return self.answer(case)
        parts = [named(*run(eq, case.inputs(), {name: bar})) for name, bar in cotangents.items()]
        return {
            name: sum(part[name] for part in parts) if name.startswith("in_bar.") else a
            for name, a in parts[0].items()
        }

    def _functions(self, case):
        """The functions {(module, name)} that a case calls: a change anywhere else cannot show in it."""
        called = set()

        def note(frame, event, _):
            if event == "call":
                called.add((frame.f_globals.get("__name__"), frame.f_code.co_name))

        sys.setprofile(note)
        try:
            self.answer(case)
        finally:
            sys.setprofile(None)
        return called

    def wrong(self, case):
        """Whether the code now fails a case; an equation must keep float32, too."""
        try:
            with small_portions() if case.level == "L1" else nullcontext():
                return (
                    self._differs(case, self.answer(case))
                    or self._differs(case, self.in_parts(case))
                    or self._keeps_float32(case)
                    and self._differs(case, self.answer(case, np.float32), np.float32)
                )
        except Exception:  # whatever a changed program does
            return True

    @staticmethod
    def _keeps_float32(case):
        asked = case.level == "L1" and case.tolerance("float32") is not None
        return asked and any(
            a.dtype.kind == "f" for name, a in case.tensors.items() if name.startswith("in.")
        )

    @staticmethod
    def _differs(case, got, dtype=np.float64):
        want = {name: dtype if a.dtype.kind == "f" else a.dtype for name, a in case.tensors.items()}
        return bool(compare(case.tensors, got, case.tolerance(np.dtype(dtype).name))) or any(
            a.dtype != want[name] for name, a in got.items()
        )

    def first_failure(self, equation, places):
        """The first failing case of those that call a function of `places` {(module, name)}, None for any name.

        A port computes the scalars of L0 by themselves; ours go through whole equations and what those share.  So of L0
        only the cases of the changed equation are asked.
        """
        for case, called in zip(self.cases, self.reached):
            if case.level == "L0" and case.equation != equation:
                continue
            if called & places or {(module, None) for module, _ in called} & places:
                if self.wrong(case):
                    return case
        return None

    def answers(self, subject):
        """What the doctor is shown: [(case, tensors, names of the wrong ones)] of an equation's or a stage's own cases.

        Outputs alone where they are too wrong for backward; nothing where a change ends in an exception otherwise.
        """
        found = []
        for case in self.cases:
            if case.subject == subject:
                with suppress(Exception):
                    got = named(self.subjects[subject].eq(**case.inputs())._asdict(), {})
                    if all(a.shape == case.tensors[name].shape for name, a in got.items()):
                        got = self.answer(case)
                    found.append((case, got))
        return [
            (case, got, [f.tensor for f in compare(case.tensors, got, case.tolerance("float64"))])
            for case, got in found
            if precision(got) == "float64"
        ]

    def verdict(self, change, equation, places, subject=None):
        """(killed, named, the first failing case, what the doctor is shown of a subject) under a change."""
        try:
            with laboratory(), change:
                first = self.first_failure(equation, places)
                answers = self.answers(subject or equation) if first else []
        except Exception:  # the changed file cannot even be loaded
            return True, True, None, []
        return first is not None, first is not None and first.equation == equation, first, answers


def mistake_row(judge, mistake):
    """The row of one known mistake, made by a patch of our source."""
    places = {
        ("p4dgs_ref." + file.removesuffix(".py").replace("/", "."), None)
        for file, *_ in PATCHES[mistake.id]
    }
    killed, right, first, answers = judge.verdict(
        patched(mistake.id), mistake.equation, places, mistake.subject
    )
    said = [other.id for other, _, _ in doctor.explain(mistake.subject, answers)]
    others = " and ".join(name for name in said if name != mistake.id)
    return row(
        mistake.id,
        "mistake",
        mistake.equation,
        mistake.description,
        killed,
        right,
        mistake.id in said,
        note(
            right,
            first,
            others and "the doctor says " + ("also " if mistake.id in said else "") + others,
        ),
    )


def mutation_row(judge, mutation):
    """The row of one mutation."""
    places = {(mutation.module, mutation.owner if mutation.is_function else None)}
    killed, right, first, answers = judge.verdict(applied(mutation), mutation.equation, places)
    said = " or ".join(explanations(mutation.equation, answers))
    return row(
        mutation.id,
        "mutation",
        mutation.equation,
        mutation.description,
        killed,
        right,
        bool(said),
        note(right, first, said) if killed else EQUIVALENT.get(mutation.id, ""),
    )


def explanations(equation, answers):
    """The known mistakes that agree with every failing case; most fall at the first, which is therefore tried alone."""
    first = next((answer for answer in answers if answer[2]), None)
    if first is None or not doctor.explain(equation, [first]):
        return []
    return [
        mistake.id
        for mistake, agreed, failed in doctor.explain(equation, answers)
        if agreed == failed
    ]


def note(right, first, said):
    return (
        said
        if right or first is None
        else f"diverges first in {first.equation}" + (f"; {said}" if said else "")
    )


def row(*values):
    return dict(
        zip(
            COLUMNS,
            ["yes" if v is True else "no" if v is False else v for v in values],
            strict=True,
        )
    )


def rows(judge, progress=lambda text: None):
    """The whole matrix: known mistakes in the doctor's order, then mutations in the order of the text."""
    found, work = (
        [],
        [(mistake_row, m) for m in MISTAKES] + [(mutation_row, m) for m in mutations()],
    )
    for i, (make, change) in enumerate(work):
        progress(f"{i + 1} of {len(work)}: {change.id}")
        found.append(make(judge, change))
    return found


def text(found):
    """Rows as the file holds them."""
    file = io.StringIO()
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(found)
    return file.getvalue()


def committed():
    """The rows of the file."""
    with open(MATRIX, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


if __name__ == "__main__":
    made = rows(Judge(), lambda said: print(f"\r{said:<100.100}", end="", flush=True))
    MATRIX.write_text(text(made), encoding="utf-8", newline="")
    print(f"\r{len(made)} rows, {sum(r['killed'] == 'yes' for r in made)} killed".ljust(101))
