"""The pictures of the packaged scenes can be drawn again, and twocams holds what it promises."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.load import packaged_folder
from p4dgs_ref.scenes.simulator.description import read_description
from p4dgs_ref.scenes.simulator.trace import trace
from tests.sampling import few
from tests.workshop import tiny_scenes, two_cameras


@pytest.mark.parametrize("name", few(["orientation", "figure", "twocams"], 0, 1))
def test_committed_scenes_can_be_drawn_again(name, tmp_path):
    """Another NumPy may round the last bit of a pixel or of a number otherwise."""
    assert not tiny_scenes.main([name, "-o", str(tmp_path)])
    new, old = tmp_path / name, packaged_folder() / name
    files, committed = (
        {path.relative_to(place) for path in place.rglob("*") if path.is_file()}
        for place in (new, old)
    )
    assert files == committed
    for file in files:
        if file.suffix == ".png":
            difference = iio.imread(new / file).astype(int) - iio.imread(old / file).astype(int)
            assert np.abs(difference).max() <= 1, file
        elif file.suffix == ".npy":
            np.testing.assert_allclose(np.load(new / file), np.load(old / file), atol=1e-5)
        else:
            assert rounded(new / file) == rounded(old / file), file


def rounded(file):
    """The text of a JSON file with numbers as far as another NumPy has the same digits."""
    return json.dumps(
        json.loads(file.read_text(encoding="utf-8"), parse_float=lambda s: round(float(s), 9))
    )


def test_twocams_is_read_as_it_was_drawn():
    description, scene = read_description(two_cameras.SOURCE), load_scene("twocams")
    eyes = two_cameras.cameras(description)
    for views, eye in ((scene.train, eyes["left"]), (scene.test, eyes["right"])):
        for view in views:
            for field, value in vars(eye).items():
                computed = getattr(view.camera, field)
                np.testing.assert_allclose(computed, value, atol=1e-12, err_msg=field)
        drawn = trace(description, eye, views[5].time)
        wanted = drawn[..., :3] * drawn[..., 3:] + 1 - drawn[..., 3:]
        np.testing.assert_allclose(views[5].image, wanted, atol=0.51 / 255)
        assert views[5].alpha is None
    assert [view.time for view in scene.train] == [i / 47 for i in range(48)]
    assert [view.time for view in scene.test] == [i / 47 for i in range(2, 48, 4)]
    left, right = (eyes[side].center - description.cameras.target for side in ("left", "right"))
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert np.degrees(np.arccos(cosine)) == pytest.approx(4.53, abs=0.01)
