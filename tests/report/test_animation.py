"""The animation of the README shows what it says: traced truth, decoded picture, error."""

import imageio.v3 as iio
import numpy as np
import pytest
from matplotlib import colormaps

import p4dgs_ref as p4
from p4dgs_ref.report.evaluate import psnr
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.files import box_filter
from p4dgs_ref.scenes.load import DESCRIPTION, find_scene
from p4dgs_ref.scenes.simulator.description import read_description
from tests import ROOT
from tutorials.tools import animation, show

SIDE = 256


@pytest.fixture(scope="module")
def scene():
    return load_scene("bouncing")


@pytest.fixture(scope="module")
def description():
    return read_description(find_scene("bouncing") / DESCRIPTION)


@pytest.fixture(scope="module")
def committed():
    return iio.imread(ROOT / "tutorials" / "pictures" / "demo.gif")


def panels(frame):
    """The three pictures [SIDE, SIDE, 3] of a frame, in [0, 1]."""
    gap, rows = animation.GAP, slice(animation.HEAD, animation.HEAD + SIDE)
    lefts = [gap + i * (SIDE + gap) for i in range(3)]
    return [frame[rows, left : left + SIDE] / 255 for left in lefts]


def test_truth_is_that_of_the_scene(scene, description):
    view = scene.test[3]
    drawn = animation.truth(description, view.camera, view.time, scene.background)
    assert np.abs(drawn - view.image).max() <= 1.5 / 255  # another NumPy may round otherwise


def test_large_pictures_show_what_those_of_training_show(scene, description):
    model = p4.decode((ROOT / "tutorials" / "demo.p4dgs").read_bytes())
    view = scene.test[3]
    camera = show.enlarged(view.camera, animation.ENLARGED)
    large = (
        animation.truth(description, camera, view.time, scene.background),
        show.frame(model, view.camera, view.time, animation.ENLARGED),
    )
    small = view.image, model.render(view.camera, view.time)
    for picture, wanted in zip(large, small):
        assert psnr(box_filter(picture, animation.ENLARGED), wanted) > 40


def test_no_frame_has_the_time_of_a_training_view(scene, description):
    trained = {view.time for view in scene.train}
    assert not trained & {t for _, t in animation.views(description)}


@pytest.mark.slow
def test_committed_animation_shows_the_truth_and_is_near_it(scene, description, committed):
    posed = animation.views(description)
    assert len(committed) == 2 * len(posed) - 2
    for i in range(0, len(posed), 6):
        camera, t = posed[i]
        left, middle, _ = panels(committed[i])
        camera = show.enlarged(camera, animation.ENLARGED)
        true = animation.truth(description, camera, t, scene.background)
        assert psnr(left, true) > 44  # the colours of a GIF
        assert 27 < psnr(middle, true) < 30


@pytest.mark.slow
def test_the_same_model_gives_the_same_bytes(scene, tmp_path, monkeypatch):
    class Gray:
        """A model that draws the same gray everywhere."""

        background = scene.background

        def render(self, camera, t, settings):
            return np.full((camera.height, camera.width, 3), 0.5)

    monkeypatch.setattr(animation, "FRAMES", 2)
    for name in ("one.gif", "two.gif"):
        animation.write_animation(tmp_path / name, Gray())
    assert (tmp_path / "one.gif").read_bytes() == (tmp_path / "two.gif").read_bytes()
    left, middle, right = panels(iio.imread(tmp_path / "one.gif")[0])
    assert np.abs(middle - 0.5).max() < 0.04 < np.abs(left - 0.5).max()
    assert np.abs(right[0, 0] - colormaps["magma"](1.0)[:3]).max() < 0.02
