"""Edited checkpoints are refused in one line; good ones go on to the same bytes."""

import io
import json
import os
import shutil
import time
import zipfile

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.scenes.output import OutputError
from p4dgs_ref.training.checkpoint import CHECKPOINT, RunError, load
from p4dgs_ref.training.fit import fit, load_model
from tests.sampling import few

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


def array(name, change):
    """An edit of one array, by a function of the array."""

    def edit(arrays, values):
        arrays[name] = change(arrays[name])

    return edit


def without(name):
    return lambda arrays, values: arrays.pop(name)


def extra(name, value):
    return lambda arrays, values: arrays.update({name: np.asarray(value)})


def every(change):
    """An edit of all arrays of numbers."""

    def edit(arrays, values):
        for name, old in arrays.items():
            if old.dtype.kind == "f":
                arrays[name] = change(old)

    return edit


def value(field, new):
    """An edit of one JSON value, new or a function of the old one; `a.b` is b inside of a."""

    def edit(arrays, values):
        *above, last = field.split(".")
        for name in above:
            values = values[name]
        values[last] = new(values[last]) if callable(new) else new

    return edit


def no_value(field):
    return lambda arrays, values: values.pop(field)


def filled_with(number):
    return lambda a: np.full_like(a, number)


def at_corner(number):
    def change(a):
        a.flat[-1] = number
        return a

    return change


NAN, INF = float("nan"), float("inf")
HUGE_INTEGER = 10**400
# name: (the edit, the words of the message)
EDITS = {
    "one row less": (array("p/f_a", lambda a: a[:-1]), ("p/f_a", "shape")),
    "one row more": (array("m/x_a", lambda a: np.vstack([a, a[:1]])), ("m/x_a", "shape")),
    "one axis more": (array("p/x_a", lambda a: a[None]), ("p/x_a", "shape")),
    "a scalar": (array("p/log_s", lambda a: a.ravel()[0]), ("p/log_s", "shape")),
    "no anchors": (array("mask", lambda a: a[:0]), ("mask", "one row for each anchor")),
    "a mask of another k": (array("mask", lambda a: a[:, :-1]), ("mask", "shape")),
    "a flat mask": (array("mask", np.ravel), ("mask", "one row for each anchor")),
    "weights transposed": (array("p/psi_c.W2", np.transpose), ("p/psi_c.W2", "shape")),
    "float64": (array("p/O_a", np.float64), ("p/O_a", "float32")),
    "float16": (array("v/O_a", np.float16), ("v/O_a", "float32")),
    "integers": (array("p/f_a", np.int32), ("p/f_a", "float32")),
    "complex numbers": (array("p/f_a", lambda a: a + 1j * a), ("p/f_a", "float32", "complex64")),
    "complex numbers everywhere": (every(lambda a: a * 1j), ("float32", "complex")),
    "text": (array("p/f_a", lambda a: a.astype("U8")), ("p/f_a", "float32")),
    "the other byte order": (array("p/f_a", lambda a: a.astype(">f4")), ("p/f_a", "float32")),
    "a mask of numbers": (array("mask", np.uint8), ("mask", "bool")),
    "order of floats": (array("order", np.float64), ("order", "int64")),
    "NaN in a parameter": (array("p/f_a", at_corner(NAN)), ("p/f_a", "finite")),
    "infinity in a moment": (array("m/psi_d.W0", at_corner(INF)), ("m/psi_d.W0", "finite")),
    "NaN in the box": (array("box", at_corner(NAN)), ("box", "finite")),
    "1e300 in the statistics": (array("stat/gradient", filled_with(1e300)), ("stat/gradient",)),
    "1e300 everywhere": (every(lambda a: np.full(a.shape, 1e300)), ("float32",)),
    "infinity everywhere": (every(filled_with(INF)), ("finite",)),
    "a negative second moment": (array("v/x_a", at_corner(-1)), ("v/x_a", "negative")),
    "negative statistics": (array("stat/visits", at_corner(-1)), ("stat/visits", "negative")),
    "a negative view": (array("order", at_corner(-1)), ("order", "negative")),
    "a view twice": (array("order", at_corner(0)), ("order", "once")),
    "a view that is not there": (array("order", at_corner(1000)), ("order", "views of the scene")),
    "the box upside down": (array("box", lambda a: a[::-1]), ("box", "lower")),
    "no box": (without("box"), ("box", "got nothing")),
    "no parameter": (without("p/psi_s.b1"), ("p/psi_s.b1", "got nothing")),
    "no mask": (without("mask"), ("mask",)),
    "no order": (without("order"), ("order", "got nothing")),
    "no moments": (without("v/grid.0"), ("v/grid.0", "got nothing")),
    "no statistics": (without("stat/seen"), ("stat/seen", "got nothing")),
    "one parameter more": (extra("p/secret", np.zeros(3, np.float32)), ("p/secret", "no such")),
    "one array more": (extra("note", "hello"), ("note", "no such")),
    "an object": (extra("p/f_a", np.array([{}], object)), ("damaged",)),
    "iteration -5": (value("iteration", -5), ("iteration", "from 0 to the last")),
    "iteration 10": (value("iteration", 10), ("iteration", "from 0 to the last")),
    "iteration 3": (value("iteration", 3), ("box", "no such")),
    "iteration 6.0": (value("iteration", 6.0), ("iteration", "integer")),
    "iteration of text": (value("iteration", "6"), ("iteration", "integer")),
    "iteration true": (value("iteration", True), ("iteration", "integer")),
    "iteration huge": (value("iteration", HUGE_INTEGER), ("iteration", "integer")),
    "seed -1": (value("seed", -1), ("seed", "at least 0")),
    "seed NaN": (value("seed", NAN), ("seed", "integer")),
    "no effects": (value("effects", None), ("effects",)),
    "unknown effect": (value("effects", ["wind"]), ("effects", "each once")),
    "effect twice": (value("effects", lambda old: [*old, old[0]]), ("effects", "each once")),
    "effects in another order": (value("effects", lambda old: old[::-1]), ("effects", "order")),
    "one effect less": (value("effects", lambda old: old[1:]), ("psi_d",)),
    "background of text": (value("background", "white"), ("background", "three")),
    "background 2": (value("background", [0, 2, 0]), ("background", "[0, 1]")),
    "background of two": (value("background", [0, 1]), ("background", "three")),
    "no preset": (value("preset", None), ("preset", "fields")),
    "preset without a field": (value("preset", lambda old: {"name": "x"}), ("preset", "fields")),
    "preset with a number as name": (value("preset.name", 3), ("preset",)),
    "preset of another width": (value("preset.d", 5), ("f_a", "shape")),
    "preset of width NaN": (value("preset.d", NAN), ("'d'",)),
    "preset with a negative k": (value("preset.k", -2), ("'k'",)),
    "preset with stages of text": (value("preset.stage_ends", "soon"), ("'stage_ends'",)),
    "preset with stages backwards": (value("preset.stage_ends", [9, 6, 4, 2]), ("'stage_ends'",)),
    "preset with a huge layer": (value("preset.hidden", [2**14] * 8), ("numbers",)),
    "preset with a layer of lists": (value("preset.hidden", [[1]]), ("'hidden'",)),
    "settings of text": (value("settings", "fast"), ("settings",)),
    "one setting less": (value("settings", {"name": "fast"}), ("settings",)),
    "no steps": (value("steps", {}), ("steps",)),
    "steps in a list": (value("steps", [1, 2]), ("steps",)),
    "-1 steps": (value("steps.x_a", -1), ("steps",)),
    "more steps than iterations": (value("steps.x_a", 8), ("steps", "0 to ")),
    "steps of text": (value("steps.x_a", "many"), ("steps",)),
    "random state of another kind": (value("rng.bit_generator", "MT19937"), ("rng", "PCG64")),
    "random state null": (value("rng", None), ("rng",)),
    "random state too large": (value("rng.state.state", 2**200), ("rng",)),
    "random state without a part": (value("rng", lambda old: {**old, "state": {}}), ("rng",)),
    "history of text": (value("history", "long"), ("history", "rows")),
    "history with short rows": (value("history", [[1, 2]]), ("history", "7 numbers")),
    "history with text": (value("history", [["1"] * 7]), ("history", "7 numbers")),
    "history of huge numbers": (value("history", [[HUGE_INTEGER] * 7]), ("history",)),
    "longer history than training": (value("history", [[1.0] * 7] * 100), ("history",)),
    "one field less": (no_value("rng"), ("version", "another release")),
    "one field more": (lambda arrays, values: values.update(note=1), ("version",)),
    "another version": (value("version", 2), ("version 2",)),
    "version of text": (value("version", "1"), ("version",)),
}


def save(path, arrays, values, write=np.savez):
    text = np.frombuffer(json.dumps(values).encode(), np.uint8)
    write(path, _values=text, **arrays)


@pytest.fixture
def edited(run, tmp_path):
    """A function that copies the run and edits its checkpoint."""

    def edit(change=lambda arrays, values: None, write=np.savez):
        arrays, values = load(run[0])
        change(arrays, values)
        (tmp_path / "run").mkdir(exist_ok=True)
        save(tmp_path / "run" / CHECKPOINT, arrays, values, write)
        return tmp_path / "run"

    return edit


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
    if "views of the scene" not in words:  # encoding does not know the scene and needs no order
        code = cli.run(["encode", str(folder), "-o", str(folder / "x")], time.perf_counter())
        assert code == 2 and capsys.readouterr() == ("", f"p4dgs-ref: {message}\n")
    assert sorted((path, path.stat().st_mtime_ns) for path in folder.rglob("*")) == before


@pytest.mark.parametrize("edit", few(EDITS, 20))
def test_an_edited_checkpoint_is_refused(edited, run, capsys, edit):
    change, words = EDITS[edit]
    both_refuse(edited(change), run, words, capsys)


def rewritten(change):
    """An edit of the bytes of the file."""
    return lambda path: path.write_bytes(change(path.read_bytes()))


def npy_header(path):
    """Rewrite an array's header so that it promises 8 terabytes."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    parts["p/f_a.npy"] = file.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)


def as_pipe(path):
    path.unlink()
    os.mkfifo(path)


def as_folder(path):
    path.unlink()
    path.mkdir()


FILES = {
    "cut in the middle": rewritten(lambda data: data[: len(data) // 2]),
    "cut at the end": rewritten(lambda data: data[:-1]),
    "empty": rewritten(lambda data: b""),
    "one bit": rewritten(lambda data: data[:5000] + bytes([data[5000] ^ 1]) + data[5001:]),
    "one array, not an archive": lambda path: np.save(open(path, "wb"), np.zeros(3)),
    "an array of 8 TB": npy_header,
    "a pipe": as_pipe,
    "a folder": as_folder,
}


@pytest.mark.parametrize("damage", FILES)
def test_a_damaged_file_is_refused(edited, run, capsys, damage):
    folder = edited()
    FILES[damage](folder / CHECKPOINT)
    words = ("regular file",) if damage in ("a pipe", "a folder") else ("damaged",)
    both_refuse(folder, run, words, capsys)


def test_a_compressed_archive_is_refused(edited, run, capsys):
    bomb = extra("zeros", np.zeros(10**6))
    both_refuse(edited(bomb, np.savez_compressed), run, ("damaged",), capsys)


def test_a_good_checkpoint_goes_on_to_the_same_bytes(edited, run, tmp_path):
    whole = p4.encode(p4.train(run[1], "smoke", **run[2]))
    assert p4.encode(resume(edited(), run).model()) == whole
    assert p4.encode(load_model(tmp_path / "run")[0]) == whole
    # Fortran's order of the same numbers, as another program may write them, is the same state.
    folder = edited(every(np.asfortranarray))
    assert all(a.flags.c_contiguous for a in load(folder)[0].values())  # sums are added in place
    assert p4.encode(resume(folder, run).model()) == whole


def test_the_folder_of_another_scene_is_refused(edited, run):
    folder = edited()
    other = p4.load_scene("static", downscale=8)
    with pytest.raises(RunError, match="field 'effects'"):
        fit(other, "smoke", 0, folder=folder, resume=True, **run[2])
    other = p4.load_scene("figure", downscale=8)
    with pytest.raises(RunError, match="field '(scene|effects)'"):
        fit(other, "smoke", 0, folder=folder, resume=True, **run[2])
    with pytest.raises(RunError, match="field 'preset.name'"):
        fit(run[1], "tiny", 0, folder=folder, resume=True, **run[2])
    shutil.rmtree(folder)
