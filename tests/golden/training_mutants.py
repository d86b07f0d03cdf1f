"""Which one-token mutations of the training do its published steps notice?

`python -m tests.golden.training_mutants` prints a table in a few minutes: of every function that
the steps call, how many of its mutations make a case of `training`, `training_whole` or `trace`
fail, within the published bounds and within 64 eps S for comparison, and which make none fail.
"""

import importlib
import inspect
import sys
from collections import Counter
from operator import attrgetter

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.compare import compare
from tests.golden.kill_matrix import Judge, laboratory
from tests.golden.mutate import applied, mutations_of

ROOM = "p4dgs_ref.training."
FILES = "parameters", "density", "trainer", "objective"
SUBJECTS = "training", "training_whole", "trace"
NARROW = 64  # eps S: the largest bound that these cases had
# What happens before the first step; the state that it leaves is given here.
BEFORE = {"random_layers", "Trainer.__init__", "Trainer.begin", "Trainer.next_view"}
BEFORE |= {"MAX_MOMENT_BYTES", "ROWS"}  # how much is kept, and an order that nothing depends on


def cases():
    """Return the published steps."""
    return [case for key in SUBJECTS for case in published.cases(key)]


def called():
    """Return the code of all functions of the training that the steps call."""
    codes = set()

    def note(frame, event, _):
        if event == "call" and frame.f_globals.get("__name__", "").startswith(ROOM):
            codes.add(frame.f_code)

    sys.setprofile(note)
    try:
        for case in cases():
            Judge.answer(None, case)
    finally:
        sys.setprofile(None)
    return codes


def mutations():
    """Return every mutation of a constant or of a function that the steps call."""
    codes, found = called(), []
    for name in FILES:
        module = importlib.import_module(ROOM + name)
        for mutation in mutations_of(ROOM + name, ""):
            owner = attrgetter(mutation.owner)(module)
            is_called = not mutation.is_function or inspect.unwrap(owner).__code__ in codes
            if is_called and mutation.owner not in BEFORE:
                found.append(mutation)
    return found


def noticed(mutation):
    """Return whether the published bounds notice a mutation, and whether NARROW ones do."""
    is_wrong = is_far = False
    try:
        with laboratory(), applied(mutation):
            for case in cases():
                bounds, got = case.tolerance("float64"), Judge.answer(None, case)
                is_wrong |= bool(compare(case.tensors, got, bounds))
                is_far |= bool(compare(case.tensors, got, {**bounds, "eps_S": NARROW}))
                if is_wrong:
                    break
    except Exception:  # a changed program may fail in any way
        return True, True
    return is_wrong, is_far


def main():
    total, within, narrowly, lost = Counter(), Counter(), Counter(), []
    for mutation in mutations():
        owner = mutation.id.rpartition(":")[0].rpartition(":")[0]
        today, narrow = noticed(mutation)
        total[owner] += 1
        within[owner] += today
        narrowly[owner] += narrow
        if not today:
            lost.append(f"{mutation.id}: {mutation.description}")
        print(f"\r{mutation.id:<79.79}", end="", file=sys.stderr, flush=True)
    print(f"{'function':<44} mutations  noticed  within {NARROW} eps S")
    for owner, count in [*total.items(), ("all", total.total())]:
        rows = (c.total() if owner == "all" else c[owner] for c in (within, narrowly))
        print(f"{owner:<44} {count:9}  {next(rows):7}  {next(rows):15}")
    print("\n".join(["", "not noticed:", *lost]))


if __name__ == "__main__":
    main()
