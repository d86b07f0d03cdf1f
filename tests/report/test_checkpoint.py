"""Edited checkpoints are refused in one line; good ones go on to the same bytes."""

import hashlib
import io
import json
import os
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.scenes.output import OutputError
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.checkpoint import CHECKPOINT, RunError, load
from p4dgs_ref.training.fit import fit, load_model

pytestmark = pytest.mark.filterwarnings("ignore:scene bouncing")  # nine steps learn nothing
# Seven of nine iterations, so that the box is fixed and a window is half full.
SETTINGS = ("stage_ends=2,4,6,9", "grow=reseed", "grow_from=1", "grow_every=3", "grow_until=5")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder after seven of nine iterations, its scene and its settings."""
    folder = tmp_path_factory.mktemp("run")
    scene = p4.load_scene("bouncing", downscale=8)
    changes = dict(setting.split("=") for setting in SETTINGS)

    class Stopped(Exception):
        pass

    def stop(trainer, *seen):
        if trainer.iteration == 8:
            raise Stopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("p4dgs_ref.training.fit.Progress", lambda stream: Reporter(stop))
        with pytest.raises(Stopped):
            fit(scene, "smoke", 0, folder=folder, save_every=0, **changes)
    assert load(folder)[1]["iteration"] == 7
    return folder, scene, changes


class Reporter:
    """A progress line that only calls a function."""

    def __init__(self, call):
        self.call = call

    def __call__(self, trainer, *seen):
        self.call(trainer, *seen)

    def close(self):
        pass


def write(path, arrays, values, save=np.savez, sealed=True):
    """Write a checkpoint, with the checksum of its archive or with 32 other bytes."""
    archive = io.BytesIO()
    text = np.frombuffer(json.dumps(values).encode(), np.uint8)
    save(archive, _values=text, **arrays)
    data = archive.getvalue()
    path.write_bytes(data + (hashlib.sha256(data).digest() if sealed else bytes(32)))


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
        arrays, values = load(path.parent)
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


def as_pipe(path):
    path.unlink()
    os.mkfifo(path)


def as_folder(path):
    path.unlink()
    path.mkdir()


def other_number(arrays, values):
    arrays["p/f_a"][0, 0] += 1


def other_version(arrays, values):
    values["version"] = 1


def other_fields(arrays, values):
    values["preset"]["time_net"] = []


def nothing(arrays, values):
    pass


# name: (the edit of the file, words of the message)
EDITS = {
    "a number": (edited(other_number, sealed=False), ("damaged or edited",)),
    "a checkpoint of version 1": (edited(other_version, sealed=False), ("damaged or edited",)),
    "compressed": (edited(nothing, save=np.savez_compressed, sealed=False), ("damaged",)),
    "another version": (edited(other_version), ("'version'", "version 1", "version 2")),
    "fields of another release": (edited(other_fields), ("'version'", "another release")),
    "cut in the middle": (changed_bytes(lambda data: data[: len(data) // 2]), ("damaged",)),
    "cut at the end": (changed_bytes(lambda data: data[:-1]), ("damaged",)),
    "a byte more": (changed_bytes(lambda data: data + b"x"), ("damaged",)),
    "empty": (changed_bytes(lambda data: b""), ("damaged",)),
    **{f"one bit at {share}": (one_bit(share), ("damaged",)) for share in (0, 0.01, 0.3, 0.99, 1)},
    "one array": (lambda path: np.save(open(path, "wb"), np.zeros(3)), ("not a checkpoint",)),
    "a pipe": (as_pipe, ("regular file",)),
    "a folder": (as_folder, ("regular file",)),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_checkpoint_is_refused(copied, run, capsys, name):
    edit, words = EDITS[name]
    edit(copied / CHECKPOINT)
    both_refuse(copied, run, words, capsys)


def test_a_good_checkpoint_goes_on_to_the_same_bytes(copied, run):
    whole = p4.encode(p4.train(run[1], "smoke", **run[2]))
    edited(nothing)(copied / CHECKPOINT)
    assert p4.encode(resume(copied, run).model()) == whole
    assert p4.encode(load_model(copied)[0]) == whole


def test_the_folder_of_another_training_is_refused(copied, run):
    for scene, preset, seed, field in (
        (p4.load_scene("static", downscale=8), "smoke", 0, "effects"),
        (replace(run[1], train=run[1].train[1:]), "smoke", 0, "scene"),
        (run[1], "tiny", 0, "preset.name"),
        (run[1], "smoke", 1, "seed"),
    ):
        with pytest.raises(RunError, match=f"field '{field}'"):
            fit(scene, preset, seed, folder=copied, resume=True, **run[2])
    with pytest.raises(RunError, match="field 'preset.lr_f'"):
        fit(run[1], "smoke", 0, folder=copied, resume=True, **run[2], lr_f=(0.1, 0.1))
    with pytest.raises(RunError, match="field 'settings.name'"):
        fit(run[1], "smoke", 0, EXACT, folder=copied, resume=True, **run[2])
