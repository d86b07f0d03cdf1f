"""Outputs: whole files or none, nothing replaced that is no regular file, locks."""

import errno
import os
import signal
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref import output
from p4dgs_ref.output import (
    OutputError,
    locked,
    new_file,
    staged_folder,
    write_atomically,
)

SCENE = p4.load_scene("bouncing", downscale=16)


def device(path):
    try:
        os.mknod(path, 0o20600, os.makedev(1, 3))  # a node of our own, like /dev/null
    except (OSError, AttributeError):
        pytest.skip("only root may make a device node")


KINDS = {
    "pipe": lambda path: os.mkfifo(path),
    "device": device,
    "folder": os.mkdir,
    "link to itself": lambda path: path.symlink_to(path.name),
}


def write_file(path):
    with new_file(path):
        write_atomically(path, lambda file: file.write(b"new"))


def write_folder(path):
    with staged_folder(path.parent) as staging:
        (staging / "a first file").write_bytes(b"new")
        (staging / path.name).write_bytes(b"new")


@pytest.mark.posix("has no pipes and devices in folders")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("link", [False, True], ids=["itself", "through a link"])
@pytest.mark.parametrize("write", [write_file, write_folder])
def test_only_a_regular_file_is_replaced(tmp_path, kind, link, write):
    (tmp_path / "there").mkdir()
    (tmp_path / "out").mkdir()
    place = tmp_path / "there" / "x"
    KINDS[kind](place)
    named = tmp_path / "out" / "x" if link else place
    if link:
        named.symlink_to(place)
    before, names = os.lstat(place), sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match="x: expected a regular file or an unused") as said:
        write(named)
    assert "\n" not in str(said.value)
    for field in ("st_mode", "st_ino", "st_rdev"):
        assert getattr(os.lstat(place), field) == getattr(before, field)
    assert sorted(tmp_path.rglob("*")) == names


@pytest.mark.posix("replaces no file that is open")
@pytest.mark.parametrize("write", [write_file, write_folder])
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_is_written_through(tmp_path, write, exists):
    for name in ("there", "out"):
        (tmp_path / name).mkdir()
    target, named = tmp_path / "there" / "target", tmp_path / "out" / "x"
    if exists:
        target.write_bytes(b"old")
        held = open(target, "rb")
    (tmp_path / "out" / "second").symlink_to("../there/target")
    named.symlink_to("second")  # a link to a link
    write(named)
    assert named.is_symlink() and os.readlink(named) == "second"
    assert (tmp_path / "out" / "second").is_symlink()
    assert target.read_bytes() == b"new" and not target.is_symlink()
    if exists:
        assert held.read() == b"old"  # replaced, not overwritten
        held.close()
    assert [path.name for path in target.parent.iterdir()] == ["target"]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    place = tmp_path / "x"
    place.write_bytes(b"old")

    def half(file):
        file.write(b"ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(place, half)
    assert place.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_does_not_part_the_files_of_a_report(tmp_path, monkeypatch, number):
    replace, calls = os.replace, []

    def interrupted(*names):
        calls.append(names)
        if len(calls) == 1:
            signal.raise_signal(number)
        replace(*names)

    monkeypatch.setattr(os, "replace", interrupted)
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt, match=f"^; all files are in {tmp_path}$"):
        write_folder(tmp_path / "x")
    assert signal.getsignal(number) is before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a first file", "x"]


def test_folders_within_are_removed_where_another_file_cannot_be_written(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(OutputError, match="taken: expected a regular file"):
        with staged_folder(tmp_path) as staging:
            (staging / "streams").mkdir()
            (staging / "streams" / "first").write_bytes(b"new")
            (staging / "taken").write_bytes(b"longer")
    assert os.listdir(tmp_path) == ["taken"]


@pytest.mark.parametrize("held_since", ["before", "the last moment"])
def test_a_file_that_another_program_holds(tmp_path, monkeypatch, held_since):
    """Windows refuses to replace it, or to give it a name, even the one that it has."""
    replace = os.replace
    (tmp_path / "x").write_bytes(b"old")

    def refusing(file, target):
        if target == tmp_path / "x" and (held_since == "before" or file != target):
            raise PermissionError(errno.EACCES, "Permission denied", file, None, target)
        replace(file, target)

    monkeypatch.setattr(os, "replace", refusing)
    with pytest.raises(PermissionError) as caught:
        write_folder(tmp_path / "x")
    assert caught.value.filename == str(tmp_path / "x")
    others, says = ([], "") if held_since == "before" else (["a first file"], "; 1 of 2 files are")
    assert caught.value.strerror.startswith(f"Permission denied{says}")
    assert sorted(os.listdir(tmp_path)) == [*others, "x"]
    assert (tmp_path / "x").read_bytes() == b"old"


@pytest.mark.posix("has no limit of descriptors")
def test_without_descriptors_nothing_is_left_and_the_first_error_stays(tmp_path):
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        with pytest.raises(OSError) as caught, staged_folder(tmp_path / "out") as staging:
            (staging / "train").mkdir()
            (staging / "train" / "r_000.png").write_bytes(b"finished")
            os.close(next_one := os.dup(0))
            resource.setrlimit(resource.RLIMIT_NOFILE, (next_one, hard))
            open(staging / "metrics.json")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert caught.value.errno == errno.EMFILE and caught.value.filename.endswith("metrics.json")
    assert not list(tmp_path.iterdir())


def test_a_link_to_another_disk_is_written_through(tmp_path):
    memory = Path("/dev/shm")
    if not memory.is_dir() or memory.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("needs a second disk")
    with TemporaryDirectory(dir=memory) as there:
        (tmp_path / "x").symlink_to(Path(there) / "target")
        write_folder(tmp_path / "x")
        assert (Path(there) / "target").read_bytes() == b"new" and (tmp_path / "x").is_symlink()
        assert os.listdir(there) == ["target"]
    assert sorted(os.listdir(tmp_path)) == ["a first file", "x"]


def refuse_locks(*arguments):
    raise OSError(95, "Operation not supported")


LEARNS_NOTHING = pytest.mark.filterwarnings("ignore:scene bouncing")  # a training of few steps


@pytest.mark.posix("locks files with msvcrt, not folders with fcntl")
@LEARNS_NOTHING
@pytest.mark.parametrize("without", ["fcntl", "locks"])
def test_without_locks_everything_is_written(tmp_path, monkeypatch, without):
    if without == "fcntl":
        monkeypatch.setattr(output, "fcntl", None)
    else:
        monkeypatch.setattr(output.fcntl, "flock", refuse_locks)
    p4.train(SCENE, "smoke", folder=tmp_path, stage_ends=(1, 1, 1, 1))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["checkpoint.npz"]


@pytest.mark.posix("a locked folder holds the locked file")
@LEARNS_NOTHING
def test_two_trainings_in_one_folder(tmp_path):
    short = dict(preset="smoke", folder=tmp_path, stage_ends=(1, 2, 3, 4))
    with locked(tmp_path):
        for resume in (False, True):
            with pytest.raises(OutputError, match="another process is writing to it"):
                p4.train(SCENE, **short, resume=resume)
        with pytest.raises(OutputError, match="another process is writing to it"):
            write_folder(tmp_path / "x")
        assert not list(tmp_path.iterdir())
    first = p4.train(SCENE, **short)
    again = p4.train(SCENE, **short, resume=True)
    np.testing.assert_array_equal(first.anchors.f_a, again.anchors.f_a)
