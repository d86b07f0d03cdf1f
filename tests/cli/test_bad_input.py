"""Mistakes of users: one line with file or option and field, exit code 2, nothing left behind."""

import gc
import json
import os
import re
import shutil
import signal
import sys
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref import limits
from p4dgs_ref.__main__ import main
from p4dgs_ref.cli.parser import parser
from p4dgs_ref.output import PART, locked
from p4dgs_ref.report import figures
from p4dgs_ref.scenes.files import MAX_JSON_BYTES
from p4dgs_ref.training import presets
from p4dgs_ref.training.fit import MAX_CHECKPOINT_BYTES, fit, load_checkpoint
from p4dgs_ref.training.fit import run as run_training
from tests import ROOT
from tests.sampling import few

from .conftest import command, subcommands, tree


@pytest.fixture(scope="module")
def original(scene, tmp_path_factory):
    """A folder with a scene, a run of it, a file, and damaged versions of these."""
    place = tmp_path_factory.mktemp("original")
    shutil.copytree(scene, place / "scene")
    shutil.copytree(ROOT / "tiny_scenes/twocams", place / "two")
    (place / "run").mkdir()
    data = p4.encode(fit(p4.load_scene(place / "scene"), "smoke", 0, folder=place / "run").model())
    files = {
        **dict.fromkeys(("good.p4dgs", "run.p4dgs", "report/scene.p4dgs"), data),
        "cut.p4dgs": data[:-5],
        **dict.fromkeys(("text",), b"not what you think\n"),
        "report/metrics.json": b"{}",
        "run_cut/checkpoint.npz": (place / "run" / "checkpoint.npz").read_bytes()[:-50],
    }
    for name, content in files.items():
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_bytes(content)
    lines = [f"property float {axis}" for axis in "xyz"]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 2", *lines, "end_header\n"]
    (place / "scene.ply").write_bytes("\n".join(lines).encode() + bytes(24))
    return place


@pytest.fixture
def place(original, tmp_path, monkeypatch):
    """A copy of `original` to work in."""
    shutil.copytree(original, tmp_path / "place")
    monkeypatch.chdir(tmp_path / "place")
    return tmp_path / "place"


def edit_frame(**fields):
    """A change of fields of the second training frame."""

    def edit(place):
        file = place / "scene/transforms_train.json"
        data = json.loads(file.read_text(encoding="utf-8"))
        data["frames"][1].update(fields)
        file.write_text(json.dumps(data), encoding="utf-8")

    return edit


def rewrite(file, change):
    return lambda place: (place / "scene" / file).write_text(
        change((place / "scene" / file).read_text(encoding="utf-8")), encoding="utf-8"
    )


READING = (
    "demo {} -o out --preset smoke --quiet",
    "train {} -o new/run --preset smoke --quiet",
    "evaluate good.p4dgs {} -o out",
    "render good.p4dgs -o out --scene {}",
)


def named(cases):
    """The cases for `parametrize`, each with its first text as its id."""
    return [
        pytest.param(*case.values, marks=case.marks, id=case.values[0] or "nothing")
        for case in cases
    ]


# What every command says alike; tests/scenes has what else can be wrong in a scene.
SCENES = [
    (
        "no file",
        lambda place: [file.unlink() for file in (place / "scene").glob("*.json")],
        ("transforms_train.json", "missing"),
    ),
    (
        "not JSON",
        rewrite("transforms_train.json", lambda text: text[:-9]),
        ("transforms_train.json", "line 1", "JSON"),
    ),
    (
        "damaged image",
        lambda place: (place / "scene/train/r_1.png").write_bytes(b"\x89PNG"),
        ("r_1.png", "a picture of RGB"),
    ),
    (
        "unknown effect",
        lambda place: (place / "scene/scene.json").write_text(
            '{"effects": ["rotation", "teleport"]}', encoding="utf-8"
        ),
        ("scene.json: effects", "teleport", "translation"),
    ),
    (
        "an integer of 5,000 digits",
        rewrite("transforms_train.json", lambda text: text.replace("0.7", "9" * 5000)),
        ("transforms_train.json",),
    ),
    (
        "a name of 20 MB",
        edit_frame(file_path="a" * 20_000_000),
        ("transforms_train.json: frames[1].file_path: no picture", "aaa.png"),
    ),
    (
        "a name of two lines in red",
        edit_frame(file_path="./train/a\nb\x1b[31m\x9b\u202e\r"),
        ("train.json: frames[1].file_path", "\\x1b[31m\\x9b\\u202e", "control characters"),
    ),
    (
        "an effect in red",
        lambda place: (place / "scene/scene.json").write_text(
            '{"effects": ["\\u001b[31m"]}', encoding="utf-8"
        ),
        ("scene.json: effects", "\\x1b[31m"),
    ),
    (
        "a list for an object of NeRF-DS",
        lambda place: (place / "two/metadata.json").write_text("[1]", encoding="utf-8"),
        ("metadata.json", "a JSON object"),
    ),
]


@pytest.mark.parametrize("name, mistake, words", named(few(SCENES, 8)))
def test_mistakes_in_scenes(place, refused, name, mistake, words):
    mistake(place)
    for line in READING:
        refused(line.format("two" if "NeRF-DS" in name else "scene"), words)


LINES = [
    ("", ("COMMAND",)),
    ("train scene -o new --preset smoke --points text", ("text", ".npy, .ply")),
    ("fly", ("fly", "demo")),
    ("train scene", ("-o",)),
    ("demo --fast", ("--fast",)),
    ("demo nowhere -o new", ("nowhere", "bouncing")),
    ("demo text -o new", ("text", "folder")),
    ("demo --preset huge", ("huge", "tiny")),
    ("demo --seed -1", ("--seed", "-1")),
    ("demo --set nonsense", ("'nonsense'", "presets")),
    ("demo --set anchor=3", ("'anchor'", "presets")),
    ("demo --set anchors=-3", ("'anchors'", "from 1 to 1e+18")),
    ("train scene -o new --preset smoke --set anchors=10000000000000", ("'anchors'", "at most")),
    (f"demo --set anchors={'9' * 5000}", ("'anchors'", "like 200")),
    (f"demo --seed {'9' * 5000}", ("--seed", "whole number")),
    ("demo --set 'k=\x1b[31m'", ("'k'",)),
    ("train 'a\x1b[31mb' -o new", ("a\\x1b[31mb", "no such folder")),
    ("encode 'a\nb\x1b[31m' -o new/x.p4dgs", ("a\\nb\\x1b[31m/checkpoint.npz",)),
    ("demo '--a\nb\x1b[31m'", ("unrecognized", "a\\nb\\x1b[31m")),
    ("decode 'a\nb' -o new", ("a\\nb: No such file",)),
    ("decode good.p4dgs -o 'text/a\nb'", ("text/a\\nb: expected a writable",)),
    ("oracle check 'a\nb'", ("a\\nb: expected a folder",)),
    ("grade 'a\nb'", ("a\\nb: not a folder", "classroom")),
    ("train scene -o new --downscale 9", ("transforms_train.json", "downscale 9", "12x8")),
    ("train scene -o new --downscale 0", ("--downscale", "'0'")),
    ("demo scene -o text/out --preset smoke --quiet", ("text/out", "expected a writable folder")),
    (
        "demo scene -o /proc/out/deep --preset smoke --quiet",
        ("/proc/out/deep", "expected a writable folder"),
    ),
    ("train scene -o run --preset smoke", ("checkpoint.npz", "--resume")),
    ("train scene -o new --preset smoke --resume", ("new/checkpoint.npz", "No such file")),
    ("train scene -o run --preset tiny --resume", ("checkpoint.npz", "'preset.name'")),
    (
        "train scene -o run --preset smoke --set lr_f=1,1 --resume",
        ("checkpoint.npz", "'preset.lr_f'"),
    ),
    ("train scene -o run --preset smoke --seed 1 --resume", ("checkpoint.npz", "'seed'")),
    ("train scene -o run --preset smoke --downscale 2 --resume", ("checkpoint.npz", "'scene'")),
    ("train bouncing -o run --preset smoke --resume", ("checkpoint.npz", "'effects'")),
    ("encode run_cut -o new/x.p4dgs", ("run_cut/checkpoint.npz", "damaged")),
    (
        "train scene -o run_cut --preset smoke --resume --quiet",
        ("run_cut/checkpoint.npz", "damaged"),
    ),
    ("encode nowhere -o x.p4dgs", ("nowhere/checkpoint.npz", "No such file", "train SCENE")),
    ("encode text -o x.p4dgs", ("text/checkpoint.npz", "Not a directory")),
    ("encode run -o scene", ("scene", "file")),
    ("encode run -o text/x.p4dgs", ("text", "expected a writable folder")),
    *(
        (f"{command} {file}{rest}", (file, *words))
        for command, rest in (
            ("inspect", ""),
            ("decode", " -o new"),
            ("render", " -o new"),
            ("evaluate", " scene -o new"),
            ("view good.p4dgs", " -o new.html"),
        )
        for file, words in (
            ("/dev/zero", ("a folder, pipe or device",)),
            ("text", ("not a P-4DGS file",)),
            ("nowhere.p4dgs", ("No such file",)),
            ("scene", ("a folder, pipe or device",)),
            ("cut.p4dgs", ("container", "length")),
        )
    ),
    ("encode /dev/zero -o x", ("/dev/zero/checkpoint.npz", "Not a directory")),
    ("simulate /dev/zero -o out", ("/dev/zero", "a device")),
    ("train scene -o out --points /dev/zero", ("/dev/zero", ".npy, .ply")),
    ("oracle check /dev/zero", ("/dev/zero: expected a folder",)),
    ("grade /dev/zero", ("/dev/zero: not a folder", "classroom")),
    ("decode good.p4dgs -o text", ("text", "expected a writable folder")),
    ("evaluate good.p4dgs nowhere", ("nowhere", "packaged")),
    ("render good.p4dgs -o new --size -3", ("--size", "-3")),
    ("render good.p4dgs -o new --frames 0", ("--frames", "from 1 to 10000")),
    ("render good.p4dgs -o new --scene nowhere", ("nowhere", "packaged")),
    ("render good.p4dgs -o new --distance nan", ("--distance", "nan")),
    ("render good.p4dgs -o new --elevation 90", ("--elevation",)),
    *(
        (f"render good.p4dgs -o new --scene scene --{name} 4", (f"--{name}: cannot be combined",))
        for name in ("azimuth", "frames")
    ),
    (
        "render good.p4dgs -o new --scene scene --size 4 --frames 2",
        ("--size, --frames: cannot be combined with --scene",),
    ),
    ("render good.p4dgs -o new --downscale 4", ("--downscale: expected only together with",)),
    ("render good.p4dgs -o run --frames 1", ("run: ", "expected a new or empty folder")),
    ("render scene.ply -o new", ("scene.ply: ", "container")),
    ("simulate text -o new", ("text", "JSON")),
    (
        "simulate scene/transforms_train.json -o new",
        ("transforms_train.json", "camera_angle_x", "unknown field"),
    ),
    ("simulate scene -o new", ("scene", "directory")),
    ("stability --json=yes", ("--json",)),
    ("effects scene --apply", ("--apply", "--suggest")),
    ("encode run -o text", ("text: ", "another kind")),
    ("encode run -o run/checkpoint.npz", ("checkpoint.npz", "an input")),
    ("encode run_cut -o run/checkpoint.npz", ("run/checkpoint.npz: ", "another kind")),
    ("view good.p4dgs run.p4dgs -o run.p4dgs", ("run.p4dgs: an input of this command",)),
    ("effects static --suggest --apply", ("packaged",)),
    ("view good.p4dgs -o cut.p4dgs", ("cut.p4dgs: ", "another kind")),
    ("demo scene -o report --preset smoke", ("report/metrics.json: exists", "another")),
]


@pytest.mark.posix("has no devices in folders, and other words for errors")
@pytest.mark.parametrize("line, words", named(few(LINES, 40)))
def test_mistakes_on_the_command_line(original, refused, monkeypatch, line, words):
    monkeypatch.chdir(original)  # not a copy: nothing is written
    refused(line, words)


# A file that is too large, by one byte, and a command that would read it.
LARGE = {
    "train bouncing -o new --preset smoke --points x.ply": ("x.ply", limits.MAX_FILE_BYTES),
    "train bouncing -o new --preset smoke --points x.npy": ("x.npy", limits.MAX_FILE_BYTES),
    "encode . -o new": ("checkpoint.npz", MAX_CHECKPOINT_BYTES),
    "train bouncing -o . --preset smoke --resume": ("checkpoint.npz", MAX_CHECKPOINT_BYTES),
    "demo . -o new": ("transforms_train.json", MAX_JSON_BYTES),
}


@pytest.mark.parametrize("line", LARGE)
def test_files_beyond_their_limits_are_not_read(tmp_path, run, monkeypatch, line):
    monkeypatch.chdir(tmp_path)
    name, most = LARGE[line]
    with open(name, "wb") as file:
        file.truncate(most + 1)  # without blocks on the disk
    code, out, err = run(line)
    assert (code, out) == (2, "") and f"{name}: larger than {most} bytes; expected" in err
    assert err.count("\n") == 1 and os.listdir() == [name]


# Every command that writes files into a folder.
INTO_A_FOLDER = (
    "demo scene --preset smoke --quiet -o taken",
    "train scene --preset smoke --quiet -o taken",
    "decode good.p4dgs -o taken",
    "render good.p4dgs --frames 1 --size 4 -o taken",
    "evaluate good.p4dgs scene -o taken",
    "simulate scene.json -o taken",
    "oracle export taken",
    "accuracy -o taken",
    "stability -o taken",
    "effects scene -o taken",
    "classroom taken",
    "grade course/student -o taken",
)


@pytest.mark.posix("a locked folder holds the locked file")
def test_no_two_commands_write_into_one_folder(place, refused):
    shutil.copy(ROOT / "tiny_scenes/static/scene.json", place)
    Path("taken").mkdir()
    with locked("taken"):
        for line in INTO_A_FOLDER:
            refused(line, ("taken: another process is writing to it",))


def test_what_is_checked_is_checked_under_the_lock(place, monkeypatch, run):
    """Another command that ends between the check and the lock would be overwritten."""

    @contextmanager
    def late(folder):
        with locked(folder):
            Path(folder, "manifest.txt").write_text("of another command", encoding="utf-8")
            yield

    monkeypatch.setattr("p4dgs_ref.output.locked", late)
    for line in ("render good.p4dgs --frames 1 -o new", "oracle export new", "classroom new"):
        code, out, err = run(line)
        assert (code, out) == (2, "") and "new" in err, line
        assert os.listdir("new") == ["manifest.txt"]
        shutil.rmtree("new")


def test_a_command_that_is_stopped_at_its_end_says_that_all_is_written(place, monkeypatch, capsys):
    replace = os.replace

    def interrupted(*names):
        signal.raise_signal(signal.SIGTERM)
        monkeypatch.setattr(os, "replace", replace)
        replace(*names)

    for line in ("classroom new", "oracle export vectors"):
        monkeypatch.setattr(os, "replace", interrupted)
        assert main(line.split()) == 130
        folder = line.split()[-1]
        assert capsys.readouterr().err == f"p4dgs-ref: stopped; all files are in {folder}\n"
        assert len(os.listdir(folder)) >= 3 and not list(Path(folder).glob(".p4*"))


def test_no_argument_may_be_empty_or_contain_nul(capsys):
    every = subcommands(parser())
    for one in [*every.values(), *subcommands(every["oracle"]).values()]:
        for argument in one._actions:
            if argument.nargs != 0:
                for text in ("", "a\0b"):
                    with pytest.raises(SystemExit, match="2"):
                        one.parse_args([*argument.option_strings[-1:], text])
                    said = capsys.readouterr().err
                    assert re.search(rf"(expected|invalid choice).*{re.escape(repr(text))}", said)


def test_no_test_views():
    scene = p4.Scene("only", p4.load_scene("bouncing", downscale=8).train[:1])
    for split in ("test", "val", "name"):
        with pytest.raises(ValueError, match=f"only: split '{split}'.*no views"):
            p4.evaluate(None, scene, split=split)


def test_a_grid_that_no_file_of_its_anchors_can_hold_is_refused_before_training():
    """The decoder's rule: a large grid of which few anchors change next to nothing is too cheap."""
    large = dict(grid_3d=(256,), grid_2d=(), table_3d=2**24, F=1)
    with pytest.raises(ValueError, match="grid_3d.*with 20 anchors, or a smaller grid"):
        presets.choose("smoke", {**large, "anchors": 20})
    presets.choose("smoke", {**large, "anchors": 2**18})


def test_learning_rate_that_explodes(place, run, monkeypatch):
    monkeypatch.setattr("p4dgs_ref.training.fit.run", partial(run_training, save_every=0))
    for rate in ("lr_d", "lr_c"):  # such rates are refused
        monkeypatch.setitem(presets.REQUIREMENTS, rate, ("any", lambda ends: True))

    def failed(line):
        code, _, err = run(f"{line} --preset smoke --quiet")
        assert code == 1 and err.count("\n") == 1
        return err.removeprefix("p4dgs-ref: iteration ")

    before = sorted(place.rglob("*"))
    found = failed("train scene -o new --set lr_d=1e30,1e30")
    assert found.startswith("16: equation '") and "[0, 0] is" in found
    arrays, values = load_checkpoint(place / "new")
    assert values["iteration"] == 16
    assert all(np.isfinite(a).all() for a in arrays.values() if a.dtype.kind == "f")
    shutil.rmtree(place / "new")
    failed("demo scene -o new/deep --set lr_d=1e30,1e30")
    found = failed("demo scene -o new --set lr_c=1e38,1e38")
    assert found.startswith("1: equation 'color', its 'mlp', forward: y[0, 0] is inf")
    assert sorted(place.rglob("*")) == before


def test_a_folder_of_another_training_is_refused_before_any_work(place, run, monkeypatch):
    """Not only after the scene was read and the training estimated."""
    monkeypatch.setattr("p4dgs_ref.cli.job.load", None)
    code, _, err = run("train scene -o run --preset smoke")
    assert code == 2 and "run/checkpoint.npz: exists; --resume" in err and err.count("\n") == 1
    code, _, err = run("demo scene -o report --preset smoke")
    assert code == 2 and "report/metrics.json: exists; delete it" in err and err.count("\n") == 1


@pytest.mark.usefixtures("undrawn")
def test_effects_are_suggested_where_none_are_listed_and_a_training_begins(place, capsys):
    shutil.copytree("scene", "listed")
    Path("listed/scene.json").write_text('{"effects": []}', encoding="utf-8")
    for line, count in (("scene -o new", 1), ("scene -o run --resume", 0), ("listed -o other", 0)):
        assert command(f"train {line} --preset smoke --quiet") == 0
        err = capsys.readouterr().err
        hint = "effects scene --suggest --apply --downscale 1`"
        assert err.count(hint) == count and "2 training views" in err


def test_out_of_memory(place, run, monkeypatch):
    def full(*arguments, **named):
        raise MemoryError("8 TiB for an array")

    monkeypatch.setattr("p4dgs_ref.training.fit.run", full)
    before = sorted(place.rglob("*"))
    code, _, err = run("demo scene -o new --preset smoke --quiet")
    assert (code, err) == (1, "p4dgs-ref: 8 TiB for an array\n")
    assert sorted(place.rglob("*")) == before


def test_a_bug_is_no_mistake_of_the_user(place, run, monkeypatch):
    """Only errors that the package itself defines are told in one line."""

    def wrong(*arguments):
        raise ValueError("operands could not be broadcast")

    monkeypatch.setattr("p4dgs_ref.report.inspect.ledger", wrong)
    with pytest.raises(ValueError, match="broadcast"):
        run("inspect good.p4dgs")


def link_to_a_pipe(path):
    os.mkfifo(path.with_suffix(".pipe"))
    path.symlink_to(path.with_suffix(".pipe").name)


ODD = {
    "pipe": lambda path: os.mkfifo(path),
    "folder": os.mkdir,
    "link": link_to_a_pipe,
}
WRITING = {
    "encode run -o {}/x.p4dgs": "x.p4dgs",
    "evaluate good.p4dgs scene -o {}": "comparison.png",
    "decode good.p4dgs -o {}": "model.json",
    "train scene -o {} --preset smoke --resume --quiet": "training.csv",
}


@pytest.mark.posix("has no pipes in folders")
@pytest.mark.parametrize("kind", few(ODD, 1))
def test_outputs_that_are_no_files(place, run, kind):
    """Something else in the place of a file that would be written stays as it is."""
    shutil.copytree(place / "run", place / kind)
    for name in WRITING.values():
        ODD[kind](place / kind / name)

    def nodes():
        found = {path: os.lstat(path) for path in place.rglob("*")}
        return {path: (node.st_mode, node.st_rdev) for path, node in found.items()}

    before = nodes()
    for line, name in WRITING.items():
        code, _, err = run(line.format(kind))
        assert code == 2 and err.count("\n") == 1, err
        assert f"{kind}/{name}: expected a regular file or an unused name, found" in err
    assert nodes() == before


# The file at which a disk is full that takes no file of more than a thousand bytes.
FULL = {
    "demo scene -o out --preset smoke --quiet": "out/checkpoint.npz",
    "train scene -o out --preset smoke --quiet": "out/checkpoint.npz",
    "encode run -o out/x": "out/x",
    "decode good.p4dgs -o out": "out/model.npz",
    "render good.p4dgs -o out --frames 1 --size 64": "out/t_000.png",
    "render good.p4dgs -o out --frames 40 --size 6": "out/motion.gif",
    "evaluate good.p4dgs scene -o out": "out/comparison.png",
    f"simulate {ROOT}/tiny_scenes/static/scene.json -o out": "out/scene.json",
    "view good.p4dgs -o out/x.html": "out/x.html",
}


@pytest.mark.posix("has no limit of a file's size")
@pytest.mark.parametrize("line", few(FULL, 2))
def test_a_full_disk_names_the_file(original, run, monkeypatch, line):
    import resource

    monkeypatch.chdir(original)
    ignored = []  # what files say that are dropped before they are closed
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    figures.new_figure()  # keeps a list of fonts, which is longer
    before, (_, most) = tree(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, most))
    try:
        code, out, err = run(line)
        gc.collect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    assert (code, out, ignored) == (2, "", []) and err.startswith("p4dgs-ref: ")
    assert err.endswith(f"{FULL[line]}: File too large\n") and PART not in err
    assert tree() == before


STRANGE = "s$$\x1b[2J\udcff"  # bytes that are no UTF-8 come as such characters


@pytest.mark.parametrize(
    "line",
    few(
        [
            f"train '{STRANGE}' -o 'r\x1b[2J' --preset smoke --set stage_ends=1,2,3,5",
            f"evaluate 'g\x1b[2J' '{STRANGE}' -o 'r\x1b[2J'",
            f"demo '{STRANGE}' -o 'r\x1b[2J' --preset smoke --quiet --set stage_ends=1,2,3,5",
            "encode run -o 'r\x1b[2J/x\x1b[2J'",
            "render 'g\x1b[2J' -o 'r\x1b[2J/new' --frames 1 --size 4",
        ],
        2,
    ),
    ids=lambda line: line.split()[0],
)
def test_names_reach_the_terminal_without_their_control_characters(place, run, line):
    """Nor does a name of a scene mean mathematics in a figure's title, or end a long command."""
    (place / "scene").rename(place / STRANGE)
    (place / "good.p4dgs").rename(place / "g\x1b[2J")
    code, out, err = run(line)
    assert code == 0 and out and (out + err).replace("\n", "").isprintable()
    assert line.startswith("evaluate") or "r\\x1b[2J" in out
