"""Trainings in two processes: the same results as in one, and no process is left behind."""

import multiprocessing
import os
import time

import pytest

from p4dgs_ref.cli import parser as cli
from p4dgs_ref.lab.tables import methods
from p4dgs_ref.report.jobs import in_processes
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.training.watch import NotFinite


def place(seconds):
    """A task that takes some time and says where it ran."""
    time.sleep(seconds)
    return seconds, os.getpid()


def refuse(task):
    raise LookupError(f"task {task}")


def explode(task):
    raise NotFinite(task, "f_a[3, 1] is nan")


@pytest.mark.slow
def test_an_overflow_in_another_process_keeps_its_message():
    with pytest.raises(NotFinite, match=r"^iteration 7: f_a\[3, 1\] is nan$"):
        list(in_processes(explode, [7, 8], 2))


@pytest.mark.slow
def test_two_processes_train_what_one_trains(tmp_path):
    scene, found = load_scene("bouncing", downscale=8), []
    for jobs in (1, 2):
        (tmp_path / str(jobs)).mkdir()
        task = methods.Task(scene, "p4dgs", 0, tmp_path / str(jobs), 6, {"anchors": 20})
        tasks = [task, task._replace(seed=1)]
        for row in in_processes(methods.make, tasks, jobs):
            row.pop("train_seconds")
            found.append((row, (tmp_path / str(jobs) / row["file"]).read_bytes()))
    assert found[:2] == found[2:] and found[0][0]["psnr_db"] != found[1][0]["psnr_db"]


def test_the_command_takes_all_cores():
    for command in ("accuracy", "effects static"):
        assert cli.parser().parse_args(command.split()).jobs == os.cpu_count()
        assert cli.parser().parse_args([*command.split(), "--jobs", "3"]).jobs == 3


@pytest.mark.slow
def test_results_keep_the_order_of_their_tasks():
    found = list(in_processes(place, [0.3, 0.0, 0.1], 2))
    assert [seconds for seconds, _ in found] == [0.3, 0.0, 0.1]
    assert os.getpid() not in {process for _, process in found}
    assert {process for _, process in in_processes(place, [0.0, 0.0], 1)} == {os.getpid()}


@pytest.mark.slow
def test_no_process_is_left_behind():
    before = set(multiprocessing.active_children())
    results, start = in_processes(place, [0.0, 300.0, 300.0], 2), time.monotonic()
    assert next(results)[0] == 0.0
    assert set(multiprocessing.active_children()) - before
    results.close()  # as Ctrl-C does
    with pytest.raises(LookupError, match="task 7"):
        list(in_processes(refuse, [7, 8], 2))
    assert set(multiprocessing.active_children()) <= before
    assert time.monotonic() - start < 150
