"""Scenes in the layout of HyperNeRF and NeRF-DS: what every field means, and every mistake."""

import json
import math
import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.load import read_points_for
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer
from tests.scenes.refusals import refuse

WIDTH, HEIGHT = 16, 12
CENTER, SCALE = np.array([0.5, -2.0, 7.0]), 0.25
POINTS = np.random.default_rng(1).uniform(-1, 1, (20, 3)) / SCALE + CENTER
LEFT = [f"{i:06d}_left" for i in range(4)]
RIGHT = [f"{i:06d}_right" for i in range(4)]


def orientation(i):
    """A rotation from the world to a camera."""
    a, b = 0.3 + i, 0.4 * i
    turn = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, math.cos(b), math.sin(b)], [0, -math.sin(b), math.cos(b)]])
    return tilt @ turn


def lens(i, **changes):
    return {
        "orientation": orientation(i).tolist(),
        "position": (CENTER + [0.1 * i, 4, -3]).tolist(),
        "focal_length": 20.0 + i,
        "principal_point": [7.0, 6.5],
        "skew": 0.0,
        "pixel_aspect_ratio": 1.25,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": [WIDTH, HEIGHT],
        **changes,
    }


def write(file, value):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(value), encoding="utf-8")


def edit(file, **fields):
    """Change fields of a JSON file; None removes one."""
    data = {**json.loads(file.read_text(encoding="utf-8")), **fields}
    file.write_text(
        json.dumps({name: value for name, value in data.items() if value is not None}),
        encoding="utf-8",
    )


def write_pictures(folder, ratio, width, height):
    rng = np.random.default_rng(ratio)
    (folder / f"rgb/{ratio}x").mkdir(parents=True)
    pictures = {}
    for name in LEFT + RIGHT:
        pictures[name] = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        iio.imwrite(folder / f"rgb/{ratio}x/{name}.png", pictures[name])
    return pictures


@pytest.fixture
def folder(tmp_path):
    """A folder as NeRF-DS has them; its pictures are in rgb/1x only."""
    folder = tmp_path / "bell"
    write_pictures(folder, 1, WIDTH, HEIGHT)
    write(folder / "scene.json", {"scale": SCALE, "center": CENTER.tolist(), "near": 0.1})
    write(folder / "dataset.json", {"ids": LEFT + RIGHT, "train_ids": LEFT, "val_ids": RIGHT})
    metadata = {}
    for i, name in enumerate(LEFT + RIGHT):
        metadata[name] = {"warp_id": 99 - i, "time_id": 2 * (i % 4), "camera_id": i // 4}
        write(folder / f"camera/{name}.json", lens(i))
    metadata["a view that no split lists"] = {"time_id": 1000}
    write(folder / "metadata.json", metadata)
    np.save(folder / "points.npy", POINTS.astype(np.float32))
    return folder


def test_views_of_nerf_ds(folder):
    scene = load_scene(folder)
    assert [view.name for view in scene.train] == LEFT
    assert [view.name for view in scene.test] == RIGHT
    for views in (scene.train, scene.test):
        assert [view.time for view in views] == [0, 2 / 6, 4 / 6, 1]
    view = scene.test[1]
    picture = iio.imread(folder / f"rgb/1x/{view.name}.png") / 255
    np.testing.assert_allclose(view.image, picture, atol=1e-7)
    assert view.alpha is None and view.image.dtype == np.float32
    camera = view.camera
    assert (camera.f_x, camera.f_y, camera.c_x, camera.c_y) == (25.0, 31.25, 6.5, 6.0)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(camera.R, orientation(5))
    np.testing.assert_allclose(camera.center, SCALE * np.array([0.5, 4, -3]), atol=1e-12)
    np.testing.assert_allclose(scene.points, (POINTS - CENTER) * SCALE, atol=1e-6)


def test_a_point_of_the_files_lands_where_the_files_say(folder):
    """Its pixel counts from the corner of the full picture, so a picture of half the size has half
    of that, and our coordinates half a pixel less."""
    write_pictures(folder, 2, WIDTH // 2, HEIGHT // 2)
    file = json.loads((folder / f"camera/{LEFT[2]}.json").read_text(encoding="utf-8"))
    point = np.array(file["position"]) + orientation(2).T @ [0.3, -0.2, 4.0]
    u = file["focal_length"] * 0.3 / 4 + file["principal_point"][0]
    v = file["focal_length"] * file["pixel_aspect_ratio"] * -0.2 / 4 + file["principal_point"][1]
    for downscale in (1, 2, 4):
        camera = load_scene(folder, downscale=downscale).train[2].camera
        X, Y, Z = camera.R @ ((point - CENTER) * SCALE) + camera.T
        found = camera.f_x * X / Z + camera.c_x, camera.f_y * Y / Z + camera.c_y
        np.testing.assert_allclose(found, (u / downscale - 0.5, v / downscale - 0.5), atol=1e-12)


def test_which_pictures_are_read(folder):
    full = load_scene(folder).train[0].image
    averaged = full.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(load_scene(folder, downscale=2).train[0].image, averaged, atol=1e-6)
    half = write_pictures(folder, 2, WIDTH // 2, HEIGHT // 2)[LEFT[0]] / 255
    np.testing.assert_array_equal(load_scene(folder).train[0].image, full)
    np.testing.assert_allclose(load_scene(folder, downscale=2).train[0].image, half, atol=1e-7)
    quarter = half.reshape(HEIGHT // 4, 2, WIDTH // 4, 2, 3).mean(axis=(1, 3))
    shutil.rmtree(folder / "rgb/1x")  # downloads of HyperNeRF may begin with 2x
    (folder / "rgb/masks").mkdir()
    for downscale, image in ((1, half), (2, quarter)):
        view = load_scene(folder, downscale=downscale).train[0]
        np.testing.assert_allclose(view.image, image, atol=1e-6)
        assert view.camera.f_x == 10 / downscale


DISTORTED = {
    "old name": {"tangential_distortion": None, "tangential": [0.04, -0.03]},
    "all": {
        "radial_distortion": [0.2, -0.1, 0.3],
        "tangential_distortion": [0.02, 0.05],
    },
}


@pytest.mark.parametrize("ratio", [1, 2])
@pytest.mark.parametrize("name", DISTORTED)
def test_pictures_of_a_distorting_lens_are_straightened(folder, name, ratio):
    """Bilinear resampling of a picture that rises linearly is exact."""
    shutil.rmtree(folder / "rgb")
    width, height = WIDTH // ratio, HEIGHT // ratio
    write_pictures(folder, ratio, width, height)
    ramp = np.zeros((height, width, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = 10 * np.arange(width), 10 * np.arange(height)[:, None]
    iio.imwrite(folder / f"rgb/{ratio}x/{LEFT[1]}.png", ramp)
    file = folder / f"camera/{LEFT[1]}.json"
    edit(file, **DISTORTED[name])
    view = load_scene(folder).train[1]
    data = {"radial_distortion": [0] * 3, **json.loads(file.read_text(encoding="utf-8"))}
    k = data["radial_distortion"]
    p_1, p_2 = data.get("tangential_distortion", data.get("tangential"))
    f, (c_x, c_y) = data["focal_length"], data["principal_point"]
    row, column = np.indices((height, width))
    x, y = (ratio * (column + 0.5) - c_x) / f, (ratio * (row + 0.5) - c_y) / (1.25 * f)
    r = np.hypot(x, y)
    stretch = 1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6
    x_d = x * stretch + 2 * p_1 * x * y + p_2 * (r**2 + 2 * x**2)
    y_d = y * stretch + 2 * p_2 * x * y + p_1 * (r**2 + 2 * y**2)
    u = (f * x_d + c_x) / ratio - 0.5
    v = (1.25 * f * y_d + c_y) / ratio - 0.5
    wanted = np.stack([np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)], axis=-1)
    np.testing.assert_allclose(view.image[..., :2], 10 * wanted / 255, atol=1e-6)
    straight = f / ratio, c_x / ratio - 0.5
    np.testing.assert_allclose((view.camera.f_x, view.camera.c_x), straight, rtol=1e-12)


def test_splits_of_scenes_that_test_interpolation(folder):
    names = LEFT + RIGHT
    edit(folder / "dataset.json", train_ids=names, val_ids=[])
    scene = load_scene(folder)
    assert [view.name for view in scene.train] == names[::4]
    assert [view.name for view in scene.test] == names[2::4]
    edit(folder / "dataset.json", val_ids=None)
    assert [view.name for view in load_scene(folder).test] == names[2::4]


def test_scenes_without_time_id_count_times_by_warp_id(folder):
    metadata = {name: {"warp_id": 3 * i} for i, name in enumerate(LEFT + RIGHT)}
    write(folder / "metadata.json", metadata)
    scene = load_scene(folder)
    assert [view.time for view in scene.train] == [0, 3 / 21, 6 / 21, 9 / 21]
    assert scene.test[-1].time == 1
    write(folder / "metadata.json", {name: {"time_id": 0, "warp_id": 3} for name in LEFT + RIGHT})
    assert {view.time for view in load_scene(folder).train} == {0}


def test_photographs_are_found_by_any_ending(folder):
    for name, ending in zip(LEFT, (".jpg", ".JPG", ".jpeg", ".PNG")):
        file = folder / f"rgb/1x/{name}.png"
        pixels = iio.imread(file)
        file.unlink()
        iio.imwrite(file.with_suffix(ending), pixels // 8 * 0 + 77)
    for view in load_scene(folder).train:
        np.testing.assert_allclose(view.image, 77 / 255, atol=2 / 255)


def test_points_of_colmap_are_named_where_points_are_missing(folder):
    (folder / "points.npy").unlink()
    refuse(("points.npy: missing", "model_converter"), load_scene, folder)


def test_a_folder_of_both_layouts_is_of_d_nerf(folder):
    write(folder / "transforms_train.json", {})
    refuse(["transforms_train.json: frames"], load_scene, folder)


def test_anchors_start_from_the_points(folder, tmp_path):
    scene, preset = load_scene(folder), choose("smoke", {"voxel": "0.001"})
    wanted = np.unique(np.round((POINTS - CENTER) * SCALE, 3), axis=0)
    started = Trainer(scene, preset).parameters["x_a"]
    np.testing.assert_allclose(started, wanted, atol=2e-3)
    np.save(tmp_path / "few.npy", POINTS[:3])
    others = read_points_for(scene.source, tmp_path / "few.npy")
    np.testing.assert_allclose(others, (POINTS[:3] - CENTER) * SCALE, atol=1e-12)
    assert len(Trainer(scene, preset, points=others).parameters["x_a"]) == 3
    static = load_scene("static")
    np.testing.assert_array_equal(read_points_for(static.source, tmp_path / "few.npy"), POINTS[:3])


VIEW = f"camera/{LEFT[1]}.json"
MISTAKES = [
    ("scene.json", {"scale": None}, ("scene.json: scale", "one number")),
    ("scene.json", {"scale": 1e8}, ("scene.json: scale", "camera or point beyond 1e+06")),
    ("scene.json", {"center": [0, 0, math.nan]}, ("scene.json: center", "shape [3]")),
    ("dataset.json", {"train_ids": "all"}, ("dataset.json: train_ids", "a list")),
    (
        "dataset.json",
        {"val_ids": ["../bell"]},
        ("metadata.json: ../bell", "missing; expected a dict"),
    ),
    ("dataset.json", {"train_ids": []}, ("dataset.json", "train_ids and val_ids")),
    ("dataset.json", {"train_ids": [*LEFT, LEFT[0]]}, ("train_ids", "each of them once")),
    ("dataset.json", {"val_ids": [], "ids": LEFT[:2]}, ("dataset.json", "at least three ids")),
    ("dataset.json", {"val_ids": LEFT}, ("dataset.json", "that share no view")),
    ("metadata.json", {LEFT[1]: {}}, (f"{LEFT[1]}.time_id: missing", "integer")),
    ("metadata.json", {LEFT[1]: {"time_id": -1}}, (f"{LEFT[1]}.time_id", "-1", "[0, ")),
    (VIEW, {"orientation": (2 * np.eye(3)).tolist()}, (f"{VIEW}: orientation", "rotation")),
    (VIEW, {"position": [1, 2]}, (f"{VIEW}: position", "shape [3]")),
    (VIEW, {"focal_length": -5}, (f"{VIEW}: focal_length", "one number in [1e-09")),
    (VIEW, {"skew": 0.1}, (f"{VIEW}: skew", "[0, 0]")),
    (VIEW, {"tangential_distortion": [1]}, (f"{VIEW}: tangential_distortion", "shape [2]")),
    (VIEW, {"image_size": [17, 12]}, (f"rgb/1x/{LEFT[1]}", "16x12", "1/1 of image_size")),
]


@pytest.mark.parametrize("file, fields, words", MISTAKES)
def test_mistakes_in_a_file(folder, file, fields, words):
    edit(folder / file, **fields)
    refuse(words, load_scene, folder)


MISSING = [
    ("dataset.json", ("transforms_train.json", "missing", "D-NeRF", "dataset.json")),
    ("metadata.json", ("metadata.json", "missing", "NeRF-DS")),
    ("scene.json", ("scene.json", "missing", "NeRF-DS")),
    ("points.npy", ("points.npy", "missing")),
    (VIEW, (VIEW, "missing", LEFT[1])),
    ("rgb", ("rgb", "no pictures", "1x")),
    (f"rgb/1x/{LEFT[1]}.png", (f"rgb/1x/{LEFT[1]}.png", "no picture")),
]


@pytest.mark.parametrize("name, words", MISSING)
def test_files_that_are_missing(folder, name, words):
    shutil.move(folder / name, folder.parent)
    refuse(words, load_scene, folder)


def test_mistakes_in_the_folder(folder):
    refuse((f"rgb/1x/{LEFT[0]}", "16x12", "least downscale 13"), load_scene, folder, downscale=13)
    np.save(folder / "points.npy", POINTS[:, :2])
    refuse(("points.npy", "[A, 3]"), load_scene, folder)
    shutil.copy(folder / "scene.json", folder.parent / "secret.png")
    (folder / f"rgb/1x/{LEFT[1]}.png").unlink()
    (folder / f"rgb/1x/{LEFT[1]}.png").symlink_to(folder.parent / "secret.png")
    np.save(folder / "points.npy", POINTS)
    refuse((LEFT[1], "outside"), load_scene, folder)
