"""Calls in two processes give the results of one, and no process is left behind."""

import multiprocessing
import os
import time

import pytest

from p4dgs_ref.lab.processes import in_processes
from p4dgs_ref.training.watch import NotFinite
from tests import processes


def place(seconds):
    """A task that takes some time and says where it ran."""
    time.sleep(seconds)
    return seconds, os.getpid()


def explode(task):
    raise NotFinite(f"iteration {task}: f_a[3, 1] is nan")


UNGUARDED = """
from p4dgs_ref.lab.processes import in_processes
print(list(in_processes(abs, [1, 2], 2)))
"""


@pytest.mark.slow
def test_a_script_that_a_worker_would_run_again_is_told_so(tmp_path):
    (tmp_path / "script.py").write_text(UNGUARDED, encoding="utf-8")
    lines = processes.run(tmp_path / "script.py").stderr.splitlines()
    # The last of the lines that are ours: multiprocessing may warn of semaphores after it.
    said = [line for line in lines if line.startswith("ChildProcessError: ")][-1]
    assert lines[0].startswith("Traceback") and "__main__" in said
    assert said.startswith("ChildProcessError: a worker process ended before its work")


@pytest.mark.slow
def test_no_process_is_left_behind():
    before = set(multiprocessing.active_children())
    results, start = in_processes(place, [0.0, 300.0, 300.0], 2), time.monotonic()
    assert next(results)[0] == 0.0
    assert set(multiprocessing.active_children()) - before
    results.close()  # as Ctrl-C does
    with pytest.raises(NotFinite, match=r"^iteration 7: f_a\[3, 1\] is nan$"):
        list(in_processes(explode, [7, 8], 2))
    assert set(multiprocessing.active_children()) <= before
    assert time.monotonic() - start < 150
