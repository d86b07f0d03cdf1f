"""What is known to differ on Windows, simulated: see lacking/sitecustomize.py."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli.parser import GROUPS
from p4dgs_ref.lab import classroom
from p4dgs_ref.oracle import published
from p4dgs_ref.scenes.files import read_points
from tests import ROOT, processes
from tests.oracle import answers

LACKING = Path(__file__).with_name("lacking")
STAGES = "--preset smoke --set stage_ends=1,2,3,4 --quiet"
# Every command with its shortest work.
SHORT = ["--version", "decode file.p4dgs -o arrays"]
SLOW = [
    "--help",
    "presets",
    f"demo bouncing {STAGES} -o report",
    f"train bouncing {STAGES} -o trained",
    f"train bouncing {STAGES} -o run --resume",
    "encode run -o run.p4dgs",
    "render file.p4dgs --frames 2 --size 16 -o frames",
    "view file.p4dgs -o page.html",
    "evaluate file.p4dgs bouncing --downscale 4 -o measured",
    "inspect file.p4dgs",
    "simulate scene.json -o drawn",
    "oracle list",
    "oracle equations",
    "oracle export exported",
    "oracle check --adapter '{python} vectors/example_adapter.py' --only offsets",
    "oracle check answers --only offsets",
    "stability --only H-R1 -o map",
    "effects bouncing -o counted",
    "effects bouncing --suggest --yes",
    "accuracy -o timed",
    "classroom room --only noise",
    "grade hand_in/* --classroom room",
]


@pytest.fixture(scope="module")
def made(trained, tmp_path_factory):
    """A folder with what the commands read."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "file.p4dgs").write_bytes(trained.data)
    (folder / "run").mkdir()
    with pytest.warns(UserWarning):
        p4.train(trained.scene, "smoke", folder=folder / "run", stage_ends=(1, 2, 3, 4))
    described = json.loads((ROOT / "tiny_scenes/bouncing/scene.json").read_text(encoding="utf-8"))
    described["resolution"] = [8, 8]
    described["cameras"].update(train=4, test=2)
    (folder / "scene.json").write_text(json.dumps(described), encoding="utf-8")
    shutil.copytree(published.FOLDER, folder / "vectors")
    (folder / "answers").mkdir()
    answers.write(folder / "answers", offsets=answers.right("offsets"))
    classroom.hand_out(folder / "room", ["offsets"])
    shutil.copytree(folder / "room" / "key", folder / "hand_in" / "anna")
    return folder


def run(line, cwd):
    """Run a command where all that Windows lacks is taken away."""
    variables = {
        "PYTHONPATH": os.pathsep.join([str(LACKING), processes.PATHS]),
        "PYTHONIOENCODING": "cp1252",
        # Files that are opened without an encoding are ASCII.
        **{"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    }
    words = shlex.split(line.format(python=shlex.quote(sys.executable)))
    return subprocess.run(
        [sys.executable, "-m", "p4dgs_ref", *words],
        cwd=cwd,
        env={**os.environ, **variables},
        capture_output=True,
        encoding="cp1252",
    )


def refused(done):
    """The only line that a refused command prints."""
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "warning" not in line]
    return line


@pytest.mark.posix("is simulated on Linux alone")
@pytest.mark.parametrize(
    "line", [*SHORT, *(pytest.param(line, marks=pytest.mark.slow) for line in SLOW)]
)
def test_every_command(made, tmp_path, line):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    done = run(line, tmp_path)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    if line.startswith("grade"):
        assert "10.0 of 10" in done.stdout, done.stdout
    left = [str(path) for path in tmp_path.rglob(".p4dgs-*")]
    assert not left, f"hidden files of output.py stay: {left}"


def test_no_command_is_missing():
    """A new command needs a line in SLOW."""
    asked = {line.split()[0] for line in SHORT + SLOW}
    assert {name for commands in GROUPS.values() for name in commands} - asked == set()


@pytest.mark.slow
def test_one_file_that_is_open_keeps_all_others(made, tmp_path):
    first = f"simulate {made}/scene.json -o drawn"
    assert run(first, tmp_path).returncode == 0
    before = {path: path.stat().st_ino for path in tmp_path.rglob("*")}
    with open(tmp_path / "drawn" / "train" / "r_003.png", "rb"):
        line = refused(run(first, tmp_path))
    assert "r_003.png: The process cannot access the file" in line
    assert {path: path.stat().st_ino for path in tmp_path.rglob("*")} == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "line, words",
    [
        ("encode run -o a:b.p4dgs", "syntax is incorrect"),
        ("decode file.p4dgs -o what?", "syntax is incorrect"),
        (f"train bouncing {STAGES} -o run --resume", "another process is writing to it"),
    ],
)
def test_refusals_are_one_line(made, tmp_path, line, words):
    import fcntl

    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    with open(tmp_path / "run" / ".p4dgs-lock", "wb") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)
        assert words in refused(run(line, tmp_path))


def with_line_ends_of_windows(file):
    file.write_bytes(file.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))


def test_texts_may_have_the_line_ends_of_windows(tmp_path):
    shutil.copytree(ROOT / "tiny_scenes" / "static", tmp_path / "scene")
    shutil.copytree(published.FOLDER, tmp_path / "vectors")
    classroom.hand_out(tmp_path / "room", ["offsets"])
    for pattern in ("scene/*.json", "vectors/*.json", "room/student/*"):
        for file in tmp_path.glob(pattern):
            with_line_ends_of_windows(file)
    one, other = p4.load_scene("static"), p4.load_scene(tmp_path / "scene")
    np.testing.assert_array_equal(one.train[0].image, other.train[0].image)
    assert one.effects == other.effects
    assert published.read_manifest(tmp_path / "vectors") == published.read_manifest()
    (student,) = classroom.grade(tmp_path / "room")["students"]
    assert student["equations"][0]["says"] == "not begun"
    head = "ply\nformat binary_little_endian 1.0\ncomment a\nelement vertex 1\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    data = head.replace("\n", "\r\n").encode() + np.float32([1, 2, 3]).tobytes()
    (tmp_path / "points.ply").write_bytes(data)
    np.testing.assert_array_equal(read_points(tmp_path / "points.ply"), [[1, 2, 3]])
