"""What the tests of the commands share: how a command is run, what is refused, a small scene."""

import argparse
import json
import shlex
import time
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli

WARNING = "p4dgs-ref: warning: "


def command(line):
    """The exit code of a command."""
    return cli.run(shlex.split(line), time.perf_counter())


def subcommands(command):
    """Return {name: parser} of what a command is divided into."""
    divided = (a for a in command._actions if isinstance(a, argparse._SubParsersAction))
    return {name: part for action in divided for name, part in action.choices.items()}


@pytest.fixture
def run(capsys):
    """Run a command in this process: its exit code, stdout, and its errors on stderr."""

    def run(line):
        try:
            code = command(line)
        except SystemExit as stopped:
            code = stopped.code
        out, err = capsys.readouterr()
        lines = err.splitlines(keepends=True)
        return code, out, "".join(line for line in lines if not line.startswith(WARNING))

    return run


def tree():
    """Every path below the current folder, with the bytes of every file."""
    paths = sorted(Path().rglob("*"))
    return {path: path.read_bytes() if path.is_file() else None for path in paths}


@pytest.fixture
def refused(run):
    """Check that a command ends with code 2 and one line with these words, and writes nothing."""

    def refused(line, words):
        before = tree()
        code, out, err = run(line)
        assert (code, out) == (2, ""), err
        assert err.startswith("p4dgs-ref: ") and err.endswith("\n") and err[:-1].isprintable(), err
        assert "Traceback" not in err and len(err) < 1500, err
        assert [word for word in words if word not in err] == [], err
        assert tree() == before

    return refused


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """A folder `scene` of 2 + 2 views of 12x8 pixels."""
    folder = tmp_path_factory.mktemp("small") / "scene"
    rng = np.random.default_rng(0)
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        frames = []
        for i in range(2):
            picture = rng.integers(0, 256, (8, 12, 4), dtype=np.uint8)
            iio.imwrite(folder / split / f"r_{i}.png", picture)
            pose = np.eye(4)
            pose[2, 3] = 4.0 + i
            file = {"file_path": f"./{split}/r_{i}", "time": float(i)}
            frames.append({**file, "transform_matrix": pose.tolist()})
        described = json.dumps({"camera_angle_x": 0.7, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(described, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def files(trained, tmp_path_factory):
    """A file named after its scene, as `demo` names it, and one of a scene without occlusion."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "bouncing.p4dgs").write_bytes(trained.data)
    static = p4.load_scene("static", downscale=8)
    with pytest.warns(UserWarning):
        model = p4.train(p4.Scene("sum", static.train, effects=()), "smoke")
    (folder / "sum.p4dgs").write_bytes(p4.encode(model))
    return folder
