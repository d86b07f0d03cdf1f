"""Which one-token mutations of our own code do the vectors notice?

`python -m tests.workshop.kill_matrix` writes `kill_matrix.json` in a few minutes:

    total        how many mutations there are
    killed       how many make a required case fail, which is not merely acceptable
    survivors    the others, a list of {id, change, reason}
"""

import json
import signal
import sys
import warnings
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from unittest.mock import patch

import numpy as np
import scipy.sparse

from p4dgs_ref.equations import grid_nodes, likelihood
from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle.compare import cast, compare
from p4dgs_ref.splatting import compositing
from tests.workshop.equivalent import EQUIVALENT
from tests.workshop.mutate import applied, mutations
from tests.workshop.subjects import subjects

MATRIX = Path(__file__).with_name("kill_matrix.json")
PATIENCE = 60  # seconds for one changed program, which normally takes a fraction of this


class Overdue(Exception):
    """A changed program that does not end."""


@contextmanager
def deadline(seconds):
    """Interrupt what takes longer, again and again: every case may hang.

    Seconds are of the processor: on a busy machine a right program must not count as one that
    hangs, because then everything would be killed.
    """

    def stop(*_):
        raise Overdue

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def checked_matrix(*arguments, **keywords):
    """SciPy's products do not check indices: one out of range could read or overwrite anything."""
    matrix = scipy.sparse.csr_matrix(*arguments, **keywords)
    matrix.check_format(full_check=True)
    return matrix


@contextmanager
def laboratory():
    """Where changed code may run: it can do no harm, cannot hang and prints no warnings."""
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
    """Let small cases too be computed in several portions."""
    with patch.object(compositing, "BLOCK", 64), patch.object(likelihood, "PIECE", 7):
        yield


class Judge:
    """Puts the published vectors to this project's own code as it stands at the moment."""

    def __init__(self):
        keys = published.subjects()
        cases = [case for key in keys for case in published.cases(key)]
        self.cases = [case for case in cases if case.record["result"] == "valid"]
        self.reached = [self._functions(case) for case in self.cases]

    def answer(self, case, dtype=np.float64):
        """Return outputs and gradients of one case, in either precision."""
        inputs, cotangents = cast(case.inputs(), dtype), cast(case.cotangents(), dtype)
        return subjects()[case.subject].answer(inputs, cotangents)

    def in_parts(self, case):
        """Return the same with one cotangent of an equation at a time, the others left out."""
        cotangents, subject = case.cotangents(), subjects()[case.subject]
        if case.level != "L1" or len(cotangents) < 2:
            return self.answer(case)
        parts = [subject.answer(case.inputs(), {n: bar}) for n, bar in cotangents.items()]
        whole = dict(parts[0])
        for name in whole:
            if name.startswith("in_bar."):
                whole[name] = sum(part[name] for part in parts)
        return whole

    def _functions(self, case):
        """Return the functions {(module, name)} that a case calls; no others can change it.

        (module, None) stands for any of the module.
        """
        called = set()

        def note(frame, event, _):
            if event == "call":
                called.add((frame.f_globals.get("__name__"), frame.f_code.co_name))

        sys.setprofile(note)
        try:
            self.answer(case)
        finally:
            sys.setprofile(None)
        return called | {(module, None) for module, _ in called}

    def wrong(self, case):
        """Whether the code now fails a case, in parts and in float32 too."""
        try:
            with small_portions() if case.level == "L1" else nullcontext():
                if differs(case, self.answer(case)):
                    return True
                if differs(case, self.in_parts(case)):
                    return True
                return keeps_float32(case) and differs(
                    case, self.answer(case, np.float32), np.float32
                )
        except Exception:  # a changed program may fail in any way
            return True

    def first_failure(self, equation, places):
        """Return the first failing case of those that call a function of `places`, else None.

        A port computes the scalars of L0 by themselves; ours go through whole equations and what
        those share. Of L0, therefore, only the cases of the changed equation are asked; all of
        them for a helper of several equations, "".
        """
        for case, called in zip(self.cases, self.reached):
            if case.level == "L0" and equation not in ("", case.equation):
                continue
            if called & places and self.wrong(case):
                return case
        return None

    def answers(self, subject):
        """Return what the doctor is shown of a subject: [(case, tensors, names of wrong ones)]."""
        rows = []
        for case in self.cases:
            if case.subject == subject:
                with suppress(Exception):
                    got = self.answer(case)
                    result = checker.judge_answer(case, got)
                    if not result.recipe:
                        rows.append(checker.evidence(case, got, result))
        return rows


def keeps_float32(case):
    """Whether an equation must answer a case in float32."""
    asked = case.level == "L1" and case.tolerance("float32") is not None
    inputs = [a for name, a in case.tensors.items() if name.startswith("in.")]
    return asked and any(a.dtype.kind == "f" for a in inputs)


def differs(case, got, dtype=np.float64):
    """Whether an answer is wrong, or of another type. What is acceptable is not wrong."""
    if compare(case.tensors, got, case.tolerance(np.dtype(dtype).name)):
        if checker.judge_answer(case, got).wrong:
            return True
    wanted = {n: dtype if a.dtype.kind == "f" else a.dtype for n, a in case.tensors.items()}
    return any(a.dtype != wanted[name] for name, a in got.items())


def is_killed(judge, mutation):
    """Whether a required case fails under a mutation."""
    places = {(mutation.module, mutation.owner if mutation.is_function else None)}
    try:
        with laboratory(), applied(mutation):
            return judge.first_failure(mutation.equation, places) is not None
    except Exception:  # the changed file cannot even be loaded
        return True


def survivor(mutation):
    """Return the record of a mutation that no case notices."""
    reason = EQUIVALENT.get(mutation.id, "")
    return {"id": mutation.id, "change": mutation.description, "reason": reason}


def matrix(judge, progress=lambda text: None):
    """Return the whole summary."""
    survivors = []
    for mutation in mutations():
        progress(mutation.id)
        if not is_killed(judge, mutation):
            survivors.append(survivor(mutation))
    total = len(mutations())
    return {"total": total, "killed": total - len(survivors), "survivors": survivors}


def committed():
    """Return the summary in the file."""
    return json.loads(MATRIX.read_text(encoding="utf-8"))


def main():
    made = matrix(Judge(), lambda id: print(f"\r{id:<79.79}", end="", flush=True))
    MATRIX.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    print(f"\r{made['killed']} of {made['total']} mutations are killed".ljust(80))


if __name__ == "__main__":
    main()
