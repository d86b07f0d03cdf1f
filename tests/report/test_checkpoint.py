"""Edited checkpoints are refused in one line; good ones go on to the same bytes.

Whatever stops a training, resuming it gives the bytes of an uninterrupted one.
"""

import io
import json
import os
import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.output import OutputError
from p4dgs_ref.splatting.settings import EXACT, FAST
from p4dgs_ref.training import fit as training
from p4dgs_ref.training import objective
from p4dgs_ref.training.fit import CHECKPOINT, RunError, fit, load_checkpoint, load_model
from p4dgs_ref.training.parameters import Adam
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer
from tests.processes import start
from tests.sampling import few

pytestmark = pytest.mark.filterwarnings("ignore:scene bouncing")  # nine steps learn nothing
# Seven of nine iterations, so that the box is fixed and a window is half full.
SETTINGS = ("stage_ends=2,4,6,9", "grow=reseed", "grow_from=1", "grow_every=3", "grow_until=5")


def call_at(monkeypatch, owner, name, number, action):
    """Replace one call of a function, counted from 0, by `action(function, *arguments)`."""
    function, calls = getattr(owner, name), []

    def counted(*args):
        calls.append(None)
        return action(function, *args) if len(calls) == number + 1 else function(*args)

    monkeypatch.setattr(owner, name, counted)


def press(function, *args):
    """A call during which Ctrl-C is pressed."""
    signal.raise_signal(signal.SIGINT)
    return function(*args)


def half_step(step, adam, parameters, *rest):
    """A step of Adam that is stopped after it has moved the first half of the parameters."""
    before = parameters.vector.copy()
    step(adam, parameters, *rest)
    half = len(before) // 2
    parameters.vector[half:] = before[half:]
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder after seven of nine iterations, its scene and its settings."""
    folder = tmp_path_factory.mktemp("run")
    scene = p4.load_scene("bouncing", downscale=8)
    changes = dict(setting.split("=") for setting in SETTINGS)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        call_at(patch, Adam, "step", 7, half_step)
        fit(scene, "smoke", 0, folder=folder, save_every=0, **changes)
    assert load_checkpoint(folder)[1]["iteration"] == 7
    return folder, scene, changes


def write(path, arrays, values, save=np.savez, sealed=True):
    """Write a checkpoint, with the checksum of its archive or with 32 other bytes."""
    archive = io.BytesIO()
    save(archive, values=json.dumps(values), **arrays)
    data = archive.getvalue()
    path.write_bytes(data + (training.checksum(data) if sealed else bytes(32)))


@pytest.fixture
def copied(run, tmp_path):
    """A copy of the run's folder."""
    shutil.copytree(run[0], tmp_path / "run")
    return tmp_path / "run"


def resume(folder, run):
    return fit(run[1], "smoke", 0, folder=folder, resume=True, **run[2])


def both_refuse(folder, run, words, capsys):
    """Resuming and encoding both stop with the same line, and change nothing."""
    before = sorted((path, path.stat().st_mtime_ns) for path in folder.rglob("*"))
    with pytest.raises((RunError, OutputError)) as caught:
        resume(folder, run)
    message = str(caught.value)
    assert "\n" not in message and str(folder / CHECKPOINT) in message
    assert [word for word in words if word not in message] == [], message
    code = cli.run(["encode", str(folder), "-o", str(folder / "x")], time.perf_counter())
    assert code == 2 and capsys.readouterr() == ("", f"p4dgs-ref: {message}\n")
    assert sorted((path, path.stat().st_mtime_ns) for path in folder.rglob("*")) == before


def edited(change, **options):
    """An edit of the arrays and the JSON values."""

    def edit(path):
        arrays, values = load_checkpoint(path.parent)
        change(arrays, values)
        write(path, arrays, values, **options)

    return edit


def changed_bytes(change):
    """An edit of the bytes of the file."""
    return lambda path: path.write_bytes(change(path.read_bytes()))


def one_bit(share):
    """An edit of the bit that stands at a share of the file."""

    def change(data):
        at = int(share * (len(data) - 1))
        return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]

    return changed_bytes(change)


def of_another_release(path):
    content = load_checkpoint(path.parent)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "RELEASE", b"checkpoint 3, other fields")
        write(path, *content)


def replaced(make):
    """An edit that puts something else in place of the file."""

    def edit(path):
        path.unlink()
        make(path)

    return edit


def other_number(arrays, values):
    arrays["p/f_a"][0, 0] += 1


def zeros():
    """The bytes of an array as NumPy writes one."""
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


# name: (the edit of the file, words of the message)
EDITS = {
    "a number": (edited(other_number, sealed=False), ("edited",)),
    "of another release": (of_another_release, ("another release",)),
    "cut in the middle": (changed_bytes(lambda data: data[: len(data) // 2]), ("damaged",)),
    "empty": (changed_bytes(lambda data: b""), ("damaged",)),
    **{f"one bit at {share}": (one_bit(share), ("damaged",)) for share in (0, 0.3, 1)},
    "one array": (changed_bytes(lambda data: zeros()), ("expected a checkpoint",)),
    "a pipe": (replaced(lambda path: os.mkfifo(path)), ("regular file",)),
    "a folder": (replaced(os.mkdir), ("regular file",)),
}


@pytest.mark.posix("has no pipes in folders")
@pytest.mark.parametrize("name", EDITS)
def test_an_edited_checkpoint_is_refused(copied, run, capsys, name):
    edit, words = EDITS[name]
    edit(copied / CHECKPOINT)
    both_refuse(copied, run, words, capsys)


def test_a_good_checkpoint_goes_on_to_the_same_bytes(copied, run):
    whole = p4.encode(p4.train(run[1], "smoke", **run[2]))
    edited(lambda *_: None)(copied / CHECKPOINT)
    assert p4.encode(resume(copied, run).model()) == whole
    assert p4.encode(load_model(copied)[0]) == whole


def test_a_state_stays_as_it_is_when_a_training_goes_on_from_it(run):
    """So that several can go on from one, here one whose children are all masked at once."""
    folder, scene, changes = run
    arrays, values = load_checkpoint(folder)
    trainer = Trainer(scene, choose("smoke", {**changes, "mask_from": 0, "min_opacity": 1e9}))
    trainer.restore(arrays, values)
    trainer.run()
    assert trainer.iteration == 9 and not trainer.mask.any()
    again = load_checkpoint(folder)
    assert values == again[1] and all(np.array_equal(a, again[0][n]) for n, a in arrays.items())


def test_the_folder_of_another_training_is_refused(copied, run):
    first, *others = run[1].train
    negative = replace(first, image=1 - first.image)
    for given, changes, field in (
        ((p4.load_scene("static", downscale=8), "smoke", 0), {}, "effects"),
        ((replace(run[1], train=[negative, *others]), "smoke", 0), {}, "scene"),
        ((run[1], "tiny", 0), {}, "preset.name"),
        ((run[1], "smoke", 1), {}, "seed"),
        ((run[1], "smoke", 0), {"lr_f": (0.1, 0.1)}, "preset.lr_f"),
        ((run[1], "smoke", 0, EXACT), {}, "settings"),
        ((run[1], "smoke", 0, FAST, np.zeros((3, 9)).T), {}, "points"),  # column by column
    ):
        with pytest.raises(RunError, match=f"field '{field}'"):
            fit(*given, folder=copied, resume=True, **run[2], **changes)


# Every stage, re-seeding and masking, so that a checkpoint has to carry everything.
LIVELY = dict(
    preset="smoke",
    seed=5,
    stage_ends=(12, 20, 40, 60),
    grow="reseed",
    grow_from=5,
    grow_every=10,
    grow_until=35,
    mask_from=45,
    min_opacity=0.2,
)
SCAFFOLD = {
    **LIVELY,
    "grow": "scaffold",
    "min_opacity": 0.1,
    "gradient_threshold": 1e-6,
    "voxel": 0.02,
    "stage_ends": (12, 20, 40, 50),
}


@pytest.fixture(scope="module")
def scene():
    return p4.load_scene("bouncing", downscale=4)


KINDS = {"reseed": LIVELY, "scaffold": SCAFFOLD}


@pytest.fixture(scope="module", params=few(KINDS, 1))
def whole(request, scene):
    """Settings, and the bytes and the history of an uninterrupted training."""
    settings = KINDS[request.param]
    trainer = fit(scene, **settings)
    assert trainer.mask.any() and not trainer.mask.all()
    return settings, p4.encode(trainer.model()), trainer.history


@pytest.fixture
def interruptible():
    """Set Python's own handler of Ctrl-C; a training must put back what it found."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def go_on(scene, settings, folder):
    trainer = fit(scene, **settings, folder=folder, resume=True)
    assert p4.encode(load_model(folder)[0]) == p4.encode(trainer.model())
    return p4.encode(trainer.model()), trainer.history


def stopped(monkeypatch, call, scene, settings, folder, save_every):
    """The iteration of the checkpoint that a training leaves if it is stopped within one call."""
    call_at(monkeypatch, *call)
    with pytest.raises(KeyboardInterrupt):
        fit(scene, **settings, folder=folder, save_every=save_every)
    monkeypatch.undo()
    return load_checkpoint(folder)[1]["iteration"]


@pytest.mark.parametrize("at", few([30, 7, 45], 1))
@pytest.mark.parametrize("save_every", few([0, 1000], 1))
def test_stopped_inside_a_step(scene, whole, tmp_path, monkeypatch, at, save_every):
    settings, *want = whole
    call = Adam, "step", at, half_step
    found = stopped(monkeypatch, call, scene, settings, tmp_path, save_every)
    assert found == (at if save_every == 0 else 0)
    assert [*go_on(scene, settings, tmp_path)] == want


@pytest.mark.parametrize("at", few([25, 0, -1], 1))
def test_ctrl_c_waits_for_the_end_of_the_step(
    scene, whole, tmp_path, monkeypatch, interruptible, at
):
    settings, *want = whole
    at %= settings["stage_ends"][-1]
    call = objective, "loss", at, press
    assert stopped(monkeypatch, call, scene, settings, tmp_path, 1000) == at + 1
    assert [*go_on(scene, settings, tmp_path)] == want


def test_ctrl_c_after_the_last_step_stops_too(scene, tmp_path, monkeypatch, interruptible):
    call = os, "replace", 1, press  # 0 is the first checkpoint, 1 the last
    assert stopped(monkeypatch, call, scene, LIVELY, tmp_path, 1000) == 60


def test_killed_in_the_middle_of_a_checkpoint(scene, whole, tmp_path, monkeypatch):
    settings, *want = whole

    def killed(*args):
        raise KeyboardInterrupt

    call = os, "replace", 20, killed
    assert stopped(monkeypatch, call, scene, settings, tmp_path, 0) == 19
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]
    assert [*go_on(scene, settings, tmp_path)] == want


OPTIONS = "--preset smoke --seed 2 --downscale 4 --set grow=reseed --set stage_ends=20,30,60,120"
# The command line with a checkpoint after every iteration.
EAGER = """
import sys
from functools import partial
from p4dgs_ref import prepare
prepare()
from p4dgs_ref.__main__ import main
from p4dgs_ref.training import fit
fit.run = partial(fit.run, save_every=0)
sys.exit(main())
"""


def stop_at(iteration, process, run, how):
    """Send a signal to a training at a checkpoint; its exit code and what it says at its end."""
    deadline = time.monotonic() + 40
    while not (run / CHECKPOINT).exists() or load_checkpoint(run)[1]["iteration"] < iteration:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(how)
    return process.communicate(timeout=60)[1], process.returncode


@pytest.mark.slow
def test_interrupted_then_killed_then_resumed(tmp_path):
    """In other processes, with the option that the interrupted one names."""
    train, run = (
        ("-c", EAGER, "train", "bouncing", *OPTIONS.split(), "-o"),
        tmp_path / "b run",
    )
    uninterrupted = start(*train, "a run", "--quiet", cwd=tmp_path)
    first = start(*train, "b run", cwd=tmp_path)
    err, code = stop_at(25, first, run, signal.SIGINT)
    assert code == 130 and "Traceback" not in err
    assert err.endswith("the same command with --resume continues\n")
    again = start(*train, "b run", "--resume", cwd=tmp_path)
    assert stop_at(70, again, run, signal.SIGKILL)[1] == -signal.SIGKILL
    assert 70 <= load_checkpoint(run)[1]["iteration"] < 120
    for process in (uninterrupted, start(*train, "b run", "--resume", cwd=tmp_path)):
        assert process.communicate(timeout=120) and process.returncode == 0
    files = [p4.encode(load_model(tmp_path / name)[0]) for name in ("a run", "b run")]
    assert files[0] == files[1]
    for name in ("training.csv", "training.png"):
        assert (tmp_path / "a run" / name).read_bytes() == (run / name).read_bytes()
