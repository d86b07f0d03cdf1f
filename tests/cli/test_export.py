"""`export-ply`: the picture of the model from the frozen view, the header, and mistakes."""

import json
import shlex
import time

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import EXACT
from tests.codec.models import read_gaussians


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A file named after its scene, as `demo` names it, and one of a scene without occlusion."""
    place = tmp_path_factory.mktemp("files")
    with pytest.warns(UserWarning):
        model = p4.train(p4.load_scene("bouncing", downscale=4), "smoke")
        (place / "bouncing.p4dgs").write_bytes(p4.encode(model))
        static = p4.load_scene("static", downscale=4)
        model = p4.train(p4.Scene("sum", static.train, effects=()), "smoke")
        (place / "sum.p4dgs").write_bytes(p4.encode(model))
    return place


@pytest.fixture
def place(original, tmp_path, monkeypatch):
    for file in original.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(line, capsys):
    try:
        code = cli.run(shlex.split(line), time.perf_counter())
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


def comments(path):
    head = path.read_bytes().split(b"\nend_header\n")[0].decode("ascii")
    return [line for line in head.splitlines() if line.startswith("comment ")]


def same_picture(path, model, view, t):
    """The Gaussians of a file, drawn from a view, are the model's picture, and from elsewhere not:
    the model's colours are others there."""
    _, s, _, alpha, *_ = gaussians = read_gaussians(path)
    assert np.all(s > 0) and np.all((alpha > 0) & (alpha < 1))
    occlusion = "occlusion" in model.design.effects

    def drawn(camera):
        inputs = *gaussians[:5], camera, model.background, EXACT, occlusion
        return render.forward(*inputs, keep=False)[0][0]

    np.testing.assert_allclose(
        drawn(view.camera), model.render(view.camera, t, EXACT), atol=2e-5, rtol=1e-5
    )


def test_the_file_shows_what_the_view_shows(place, capsys):
    model = p4.decode((place / "bouncing.p4dgs").read_bytes())
    scene = p4.load_scene("bouncing")
    code, out, err = run("export-ply bouncing.p4dgs --time 0.3 --camera 4", capsys)
    assert (code, err) == (0, "") and "bouncing.ply" in out and "test/r_004 of bouncing" in out
    same_picture(place / "bouncing.ply", model, scene.test[4], 0.3)
    with pytest.raises(AssertionError):  # of another time
        same_picture(place / "bouncing.ply", model, scene.test[4], 0.9)
    with pytest.raises(AssertionError):  # colours of another view
        same_picture(place / "bouncing.ply", model, scene.test[7], 0.3)
    line = "export-ply bouncing.p4dgs --time 1 --scene bouncing --split train -o deep/x.ply"
    code, out, _ = run(f"{line} --json", capsys)
    shown = json.loads(out)
    assert (code, shown["output"], shown["files"]) == (0, "deep/x.ply", 1)
    assert shown["gaussians"] == len(read_gaussians(place / "deep/x.ply").x)
    same_picture(place / "deep/x.ply", model, scene.train[0], 1.0)


def test_the_header_says_what_was_frozen(place, capsys):
    assert run("export-ply bouncing.p4dgs --time 0.25 --camera 4", capsys)[0] == 0
    x, y, z = p4.load_scene("bouncing").test[4].camera.center
    assert comments(place / "bouncing.ply") == [
        "comment bouncing, a P-4DGS model, frozen at time 0.25",
        f"comment frozen view: view test/r_004 of bouncing, camera at {x:.4g} {y:.4g} {z:.4g}",
        "comment of this view alone: colours",
        "comment background of the model: 1 1 1",
    ]
    assert run("export-ply sum.p4dgs -o sum.ply", capsys)[0] == 0
    assert comments(place / "sum.ply")[2:] == [
        "comment of this view alone: no attributes",
        "comment background of the model: 0 0 0",
        "comment the model adds up all light, a viewer hides what is behind",
    ]
    assert comments(place / "sum.ply")[0].endswith("frozen at time 0")


def test_all_times(place, capsys):
    model = p4.decode((place / "bouncing.p4dgs").read_bytes())
    code, out, _ = run("export-ply bouncing.p4dgs --all-times 3 --camera 1", capsys)
    assert code == 0 and "3 files" in out
    names = [file.name for file in sorted((place / "bouncing_ply").iterdir())]
    assert names == ["t_000.ply", "t_001.ply", "t_002.ply"]
    view = p4.load_scene("bouncing").test[1]
    for name, t in zip(names, (0, 0.5, 1)):
        same_picture(place / "bouncing_ply" / name, model, view, t)
    run("export-ply bouncing.p4dgs --all-times 2 --time 0.5 -o later", capsys)
    found = [comments(place / f"later/t_{i:03d}.ply")[0].split()[-1] for i in range(2)]
    assert found == ["0.5", "1"]


def test_a_held_camera_is_that_of_render(place, capsys):
    model = p4.decode((place / "bouncing.p4dgs").read_bytes())
    options = "--azimuth 100 --elevation 10 --distance 2"
    assert run(f"export-ply bouncing.p4dgs {options}", capsys)[0] == 0
    middle = (model.box[0].astype(float) + model.box[1]) / 2
    azimuth, elevation = np.radians([100, 10])
    outward = [np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]
    center = middle + 2 * np.cos(elevation) * np.array(outward)
    camera = p4.look_at(center, middle, 50.0, 50.0, 32, 32)
    view = p4.View("held", np.zeros((32, 32, 3)), None, camera, 0.0)
    same_picture(place / "bouncing.ply", model, view, 0.0)


@pytest.mark.parametrize(
    "line, words",
    [
        ("export-ply", "file"),
        ("export-ply lost.p4dgs", "lost.p4dgs"),
        ("export-ply bouncing.p4dgs --time 1.5", "--time"),
        ("export-ply bouncing.p4dgs --time soon", "--time"),
        ("export-ply bouncing.p4dgs --camera -1", "--camera"),
        ("export-ply bouncing.p4dgs --camera 10", "--camera 10: expected one of the views 0 ... 9"),
        ("export-ply bouncing.p4dgs --camera 0 --split val", "split 'val': no views"),
        ("export-ply bouncing.p4dgs --camera 0 --azimuth 3", "--azimuth: not allowed"),
        ("export-ply sum.p4dgs --camera 0", "sum: no such folder; expected"),
        ("export-ply bouncing.p4dgs --scene nowhere", "nowhere: no such folder"),
        ("export-ply bouncing.p4dgs --all-times 0", "--all-times"),
        ("export-ply bouncing.p4dgs --fov 30", "--fov"),
        ("export-ply bouncing.p4dgs -o .", ".: expected a regular file"),
        ("export-ply bouncing.p4dgs -o /proc/x/y.ply", "/proc/x: expected a folder"),
        ("export-ply bouncing.p4dgs --all-times 2 -o sum.p4dgs", "sum.p4dgs: expected a folder"),
        ("export-ply bouncing.p4dgs -o ''", "--output"),
    ],
)
def test_mistakes(place, capsys, line, words):
    before = sorted(place.rglob("*"))
    code, out, err = run(line, capsys)
    assert (code, out) == (2, "") and err.count("\n") == 1 and words in err, err
    assert sorted(place.rglob("*")) == before
