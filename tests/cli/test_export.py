"""`export-ply`: the picture of the model as the held camera sees it, and the header."""

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.report import figures
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


def test_the_file_shows_what_the_camera_sees(place, run):
    model = p4.decode((place / "bouncing.p4dgs").read_bytes())
    camera = figures.held_camera(model)
    code, out, err = run("export-ply bouncing.p4dgs --time 0.3")
    count = len(read_gaussians(place / "bouncing.ply").x)
    assert (code, out, err) == (0, f"bouncing.ply: {count} Gaussians\n", "")
    same_picture(place / "bouncing.ply", model, camera, 0.3)
    other = p4.load_scene("bouncing").test[7].camera
    for view, t in ((camera, 0.9), (other, 0.3)):  # another time; colours of another view
        with pytest.raises(AssertionError):
            same_picture(place / "bouncing.ply", model, view, t)
    assert run("export-ply bouncing.p4dgs --time 1 -o deep/x.ply")[0] == 0
    same_picture(place / "deep/x.ply", model, camera, 1.0)


def test_the_header_says_what_was_frozen(place, run):
    assert run("export-ply bouncing.p4dgs --time 0.25")[0] == 0
    model = p4.decode((place / "bouncing.p4dgs").read_bytes())
    x, y, z = figures.held_camera(model).center
    assert comments(place / "bouncing.ply") == [
        "comment bouncing, a P-4DGS model, frozen at time 0.25",
        f"comment colours as seen from {x:.4g} {y:.4g} {z:.4g}",
        "comment background of the model: 1 1 1",
        f"comment effects of the model: {' '.join(model.design.effects)}",
    ]
    assert run("export-ply sum.p4dgs -o sum.ply")[0] == 0
    assert comments(place / "sum.ply")[2:] == [
        "comment background of the model: 0 0 0",
        "comment effects of the model: none",
    ]
