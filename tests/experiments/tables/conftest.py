"""One small scene, and each study done once on it by a few steps of training."""

import dataclasses

import pytest

import p4dgs_ref as p4
from p4dgs_ref.lab.tables import ablate, compare, curve, methods

from .shared import CURVE, FEW, OTHERS, STORAGES


@pytest.fixture(scope="session")
def scene():
    whole = p4.load_scene("bouncing", downscale=8)
    return dataclasses.replace(whole, test=whole.test[:2])


@pytest.fixture(scope="session")
def compared(scene, tmp_path_factory):
    """The folder and the result of a comparison of two seeds."""
    folder = tmp_path_factory.mktemp("compare")
    tasks = compare.plan([scene], folder, OTHERS, 2, 4)
    methods.make_missing(tasks)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "TURNS", 1)
        return folder, compare.collect(tasks, folder)


@pytest.fixture(scope="session")
def ablated(scene, tmp_path_factory):
    """The folder and the result of an ablation."""
    folder = tmp_path_factory.mktemp("ablate")
    tasks = ablate.plan(scene, folder, 1, 12)
    methods.make_missing(tasks)
    return folder, ablate.collect(tasks, folder)


@pytest.fixture(scope="session")
def drawn(scene, tmp_path_factory):
    """The folder, tasks and result of a small curve; its third training was killed half-way."""
    folder = tmp_path_factory.mktemp("curve")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curve, "SIZES", FEW)
        patch.setattr(curve, "STORAGES", STORAGES)
        tasks = curve.plan([scene], folder, *CURVE.values())
    trained = [task for task in tasks if task == task.trained]
    methods.make_missing(trained[:3])
    trained[2].record.unlink()
    kept = {task.path: task.path.stat().st_mtime_ns for task in trained[:3]}
    methods.make_missing(tasks)
    changed = [path for path, time in kept.items() if path.stat().st_mtime_ns != time]
    assert changed == [trained[2].path]
    return folder, tasks, curve.collect(tasks, folder)
