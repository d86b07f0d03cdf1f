"""`export-ply`: the picture of the model from the frozen view, and the header."""

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import EXACT
from tests.codec.models import read_gaussians


@pytest.fixture
def place(files, tmp_path, monkeypatch):
    for file in files.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def comments(path):
    head = path.read_bytes().split(b"\nend_header\n")[0].decode("ascii")
    return [line for line in head.splitlines() if line.startswith("comment ")]


def same_picture(path, model, camera, t):
    """The Gaussians of a file, drawn from a view, are the model's picture, and from elsewhere not:
    the model's colours are others there."""
    _, s, _, alpha, *_ = gaussians = read_gaussians(path)
    assert np.all(s > 0) and np.all((alpha > 0) & (alpha < 1))
    occlusion = "occlusion" in model.design.effects
    inputs = *gaussians[:5], camera, model.background, EXACT, occlusion
    drawn = render.forward(*inputs, keep=False)[0][0]
    np.testing.assert_allclose(drawn, model.render(camera, t, EXACT), atol=2e-5, rtol=1e-5)


def test_the_file_shows_what_the_view_shows(place, run):
    model = p4.decode((place / "bouncing.p4dgs").read_bytes())
    test = p4.load_scene("bouncing").test
    code, out, err = run("export-ply bouncing.p4dgs --time 0.3 --camera 4")
    assert (code, err) == (0, "") and "bouncing.ply" in out and "test/r_004 of bouncing" in out
    same_picture(place / "bouncing.ply", model, test[4].camera, 0.3)
    for view, t in ((4, 0.9), (7, 0.3)):  # of another time; colours of another view
        with pytest.raises(AssertionError):
            same_picture(place / "bouncing.ply", model, test[view].camera, t)
    code, out, _ = run("export-ply bouncing.p4dgs --time 1 --scene bouncing -o deep/x.ply")
    count = len(read_gaussians(place / "deep/x.ply").x)
    assert (code, out) == (
        0,
        f"deep/x.ply: {count} Gaussians, frozen for view test/r_000 of bouncing\n",
    )
    same_picture(place / "deep/x.ply", model, test[0].camera, 1.0)


def test_the_header_says_what_was_frozen(place, run):
    assert run("export-ply bouncing.p4dgs --time 0.25 --camera 4")[0] == 0
    scene = p4.load_scene("bouncing")
    effects, (x, y, z) = scene.effects, scene.test[4].camera.center
    assert comments(place / "bouncing.ply") == [
        "comment bouncing, a P-4DGS model, frozen at time 0.25",
        f"comment frozen view: view test/r_004 of bouncing, camera at {x:.4g} {y:.4g} {z:.4g}",
        "comment background of the model: 1 1 1",
        f"comment effects of the model: {' '.join(effects)}",
    ]
    assert run("export-ply sum.p4dgs -o sum.ply")[0] == 0
    assert comments(place / "sum.ply")[2:] == [
        "comment background of the model: 0 0 0",
        "comment effects of the model: none",
    ]
    assert comments(place / "sum.ply")[0].endswith("frozen at time 0")
