"""Rooms run in the order of the house, so that the first failure is near the break.

`--share 1/2` and `--share 2/2` divide the chosen tests between two processes. The last line of a
failing run names the seed that drew what takes turns in the slow lane.
"""

import os
import signal
from pathlib import Path

import pytest

import p4dgs_ref
from tests import processes
from tests.sampling import SEED

# Before NumPy loads, as every command does it: processes that a test starts inherit the settings,
# and with other kernels or another number of BLAS threads the last digits differ.
p4dgs_ref.prepare()
os.environ["PYTHONPATH"] = processes.PATHS
# A shell starts what runs in its background with SIGINT ignored, which tests of Ctrl-C must not be.
signal.signal(signal.SIGINT, signal.default_int_handler)


# Folders and files of this folder; all others follow.
HOUSE = ("equations", "splatting", "test_output.py", "scenes", "training", "codec")
HOUSE += ("report", "viewer", "oracle", "test_lessons.py", "lab", "cli", "tutorials")


def pytest_addoption(parser):
    help_text = "run only the I-th of N equal shares of the chosen tests"
    parser.addoption("--share", metavar="I/N", default="1/1", help=help_text)


def pytest_report_header():
    return f"package: {p4dgs_ref.__file__}"


@pytest.hookimpl(trylast=True)  # after the line that counts the failures
def pytest_unconfigure(config):
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter and {"failed", "error"} & reporter.stats.keys():
        reporter.write_line(f"P4DGS_TEST_SEED={SEED} drew what takes turns in the slow lane")


@pytest.hookimpl(trylast=True)  # after -m and -k have chosen
def pytest_collection_modifyitems(config, items):
    if not hasattr(os, "fork"):  # Windows
        for item in items:
            if mark := item.get_closest_marker("posix"):
                item.add_marker(pytest.mark.skip(reason=f"Windows: {mark.args[0]}"))
    part, parts = map(int, config.getoption("--share").split("/"))
    if not 1 <= part <= parts:
        raise pytest.UsageError("--share: expected I/N with I from 1 to N")
    places = {room: i for i, room in enumerate(HOUSE)}
    top = Path(__file__).parent
    items.sort(key=lambda item: places.get(item.path.relative_to(top).parts[0], len(HOUSE)))
    # Neighbours take about as long as each other, so the shares take turns.
    kept = items[part - 1 :: parts]
    chosen = set(kept)
    config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
    items[:] = kept


@pytest.fixture(scope="session")
def trained():
    """One short training a session, for tests that only read it: scene, trainer, model and data.

    It is done when the first of them asks for it. A hundred iterations through all four stages, on
    a scene that moves, leave a model with masked children, learned networks and a grid. Its arrays
    refuse to be written. `p4.decode(trained.data)` is the model in the file.
    """
    from types import SimpleNamespace

    from p4dgs_ref.training.fit import fit

    scene, stages = p4dgs_ref.load_scene("bouncing"), (20, 30, 60, 100)
    trainer = fit(scene, "smoke", 0, anchors=60, stage_ends=stages)
    model = trainer.model()
    networks = [a for pair in model.networks.values() for arrays in pair for a in arrays]
    for array in (trainer.parameters.vector, *model.anchors, *networks, *model.grids):
        array.flags.writeable = False
    data = p4dgs_ref.encode(model)
    return SimpleNamespace(scene=scene, trainer=trainer, model=model, data=data)


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made, but to draw one takes a second: their files are empty here."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **how: None)


@pytest.fixture(scope="session")
def right_reference():
    """Skip a test that changes code and asks where, if the unchanged code is wrong already.

    The vectors of the equations are asked once a session.
    """
    # By name, so that this file stays where the paper's rooms stand alone.
    checker = pytest.importorskip("p4dgs_ref.oracle.checker")
    answers = pytest.importorskip("tests.oracle.answers")
    report = checker.check_port(answers.Port(), ["L1"])
    if not report.ok:
        pytest.skip(f"the unchanged code is wrong in {report.first.id}: mend this first")
