"""Captures as they lie: transforms.json alone, a lens, sizes that N does not divide, EXIF."""

import json
import math
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.effects import MOTION
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.files import box_filter, turned, warn_once
from p4dgs_ref.splatting.camera import look_at
from tests.scenes.refusals import refuse
from tests.scenes.test_scenes import pose

WIDTH, HEIGHT = 90, 160
LENS = {"k1": 0.2, "k2": -0.03, "p1": 0.02, "p2": -0.01}
HEAD = {"fl_x": 120.0, "fl_y": 130.0, "cx": 94.0, "cy": 155.0, "w": 2 * WIDTH, "h": 2 * HEIGHT}
ENDINGS = (".png", ".PNG", ".jpg", ".JPG", ".jpeg", ".JPEG")


def smooth(u, v):
    """A picture [H, W, 3] of slow waves, at pixels from the corner."""
    return np.stack([0.5 + 0.4 * np.sin(u / (9 + i) + v / (13 - i)) for i in range(3)], axis=-1)


def straight():
    """The picture as a lens without distortion shows it."""
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    return smooth(u, v)


def bent():
    """The picture as the lens of the capture shows it: a Newton step by step for every pixel."""
    f, c = np.array([60.0, 65.0]), np.array([47.0, 77.5])  # of pictures half as large as w x h
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    seen = (np.stack([u, v], axis=-1) - c) / f
    at = seen.copy()
    for _ in range(100):
        x, y = at[..., 0], at[..., 1]
        r2 = x * x + y * y
        radial = 1 + LENS["k1"] * r2 + LENS["k2"] * r2 * r2
        x_d = x * radial + 2 * LENS["p1"] * x * y + LENS["p2"] * (r2 + 2 * x * x)
        y_d = y * radial + 2 * LENS["p2"] * x * y + LENS["p1"] * (r2 + 2 * y * y)
        at += 0.5 * (seen - np.stack([x_d, y_d], axis=-1))
    u, v = np.moveaxis(at * f + c, -1, 0)
    return smooth(u, v)


def capture(folder, picture, count=17, **head):
    """A capture of one picture that stands in many places, in no order; without times."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(count):
        name = f"./images/{i:04d}{ENDINGS[i % 6]}"
        iio.imwrite(folder / name, picture, **({} if "n" in name[-2:].lower() else {"quality": 98}))
        matrix = pose(azimuth=i).tolist()
        frames.append({"file_path": name, "sharpness": i + 1, "transform_matrix": matrix})
    frames = [frames[5 * i % count] for i in range(count)]
    described = {"aabb_scale": 16, **HEAD, **head, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(described), encoding="utf-8")
    return folder


def as_bytes(picture):
    return np.rint(picture * 255).astype(np.uint8)


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    return capture(tmp_path_factory.mktemp("captures") / "toy", as_bytes(bent()), **LENS)


def read(folder, **options):
    """The scene, and what was told of while it was read."""
    with pytest.warns(UserWarning) as told:
        scene = load_scene(folder, **options)
    return scene, [str(one.message) for one in told]


def psnr(a, b):
    return -10 * math.log10(np.mean((a - b) ** 2))


def test_a_capture_as_it_lies(toy):
    scene, told = read(toy)
    names = [f"images/{i:04d}{ENDINGS[i % 6]}".removesuffix(".png") for i in range(17)]
    assert [view.name for view in scene.test] == names[::8]
    assert [view.name for view in scene.train] == [n for i, n in enumerate(names) if i % 8]
    assert {view.time for view in scene.train + scene.test} == {0}
    assert scene.effects == ("view_color", "view_geometry", "occlusion", "background")
    unread, still = told
    assert (
        unread == f"{toy / 'transforms.json'}: fields that are not read: 'aabb_scale', 'sharpness'"
    )
    assert still == f"{toy}: no picture has a time: all times are 0, and nothing moves"
    np.testing.assert_allclose(scene.train[4].camera.center, pose(azimuth=5)[:3, 3], atol=1e-12)


def test_the_lens_of_a_capture_is_straightened(toy):
    """Away from the border, where the picture ends before the straight one does."""
    scene, _ = read(toy)
    inside = np.s_[30:-30, 15:-15]
    for view in scene.test:
        camera = view.camera
        assert (camera.f_x, camera.f_y, camera.c_x, camera.c_y) == (60, 65, 46.5, 77)
        assert psnr(bent()[inside], straight()[inside]) < 26
        assert psnr(view.image[inside], straight()[inside]) > 40


def test_a_cut_out_body_keeps_its_colour_where_a_lens_is_straightened(tmp_path):
    """The colour of transparent pixels, here black, is not mixed into the edge."""
    picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    picture[:, : WIDTH // 2] = 255, 0, 0, 255
    folder = capture(tmp_path / "cut_out", as_bytes(straight()), 2, **LENS)
    for file in (folder / "images").iterdir():
        file.write_bytes(iio.imwrite("<bytes>", picture, extension=".png"))
    view = read(folder)[0].train[0]
    assert np.any((view.alpha > 0.2) & (view.alpha < 0.8))
    np.testing.assert_allclose(view.image[..., 0], 1, atol=1e-6)  # red, over white
    np.testing.assert_allclose(view.image[..., 1], 1 - view.alpha, atol=1e-6)


def test_sizes_that_downscale_does_not_divide_are_cropped(toy):
    """Less than N pixels go, and a point in the world stays where the picture shows it."""
    full, small = (read(toy, downscale=n)[0].train[3] for n in (1, 7))
    assert small.image.shape == (HEIGHT // 7, WIDTH // 7, 3)
    np.testing.assert_allclose(small.image, box_filter(full.image[:154, :84], 7), atol=1e-6)
    point = np.array([0.3, -0.2, 0.1])
    pixels = []
    for camera in (full.camera, small.camera):
        X, Y, Z = camera.R @ point + camera.T
        pixels.append(
            [camera.f_x * X / Z + camera.c_x + 0.5, camera.f_y * Y / Z + camera.c_y + 0.5]
        )
    np.testing.assert_allclose(pixels[0], 7 * np.array(pixels[1]), rtol=1e-12)
    with pytest.warns(UserWarning):
        refuse(("90x160 pixels", "at least downscale 91"), load_scene, toy, downscale=91)


def test_where_transforms_json_stands_beside_those_of_d_nerf(tmp_path):
    """Those of D-NeRF are read, and one of two is missing."""
    folder = capture(tmp_path / "both", as_bytes(straight()), 3)
    (folder / "transforms_train.json").write_bytes((folder / "transforms.json").read_bytes())
    words = "transforms_test.json", "missing", "a capture with transforms.json"
    with pytest.warns(UserWarning, match="transforms_train.json: fields that are not read"):
        refuse(words, load_scene, folder)
    (folder / "transforms_train.json").unlink()
    assert len(read(folder)[0].train) == 2


def test_times_of_a_capture(tmp_path):
    """Where one frame has a time, all need one; then things may move."""
    folder = capture(tmp_path / "timed", as_bytes(straight()), 5)
    file = folder / "transforms.json"
    data = json.loads(file.read_text(encoding="utf-8"))
    for frame in data["frames"][:4]:
        frame["time"] = 0.5
    file.write_text(json.dumps(data), encoding="utf-8")
    with pytest.warns(UserWarning):
        refuse(("frames[4].time: missing; expected one number in [0, 1]",), load_scene, folder)
    data["frames"][4]["time"] = 0
    file.write_text(json.dumps(data), encoding="utf-8")
    scene, told = read(folder)
    assert {*MOTION} < {*scene.effects} and len(told) == 1
    assert sorted(view.time for view in scene.train + scene.test) == [0, 0.5, 0.5, 0.5, 0.5]


PIXELS = np.arange(6).reshape(2, 3, 1).repeat(3, axis=2)
# What a viewer shows for each value of Orientation, by the corners of EXIF 2.3.
TURNED = {
    1: [[0, 1, 2], [3, 4, 5]],
    2: [[2, 1, 0], [5, 4, 3]],
    3: [[5, 4, 3], [2, 1, 0]],
    4: [[3, 4, 5], [0, 1, 2]],
    5: [[0, 3], [1, 4], [2, 5]],
    6: [[3, 0], [4, 1], [5, 2]],
    7: [[5, 2], [4, 1], [3, 0]],
    8: [[2, 5], [1, 4], [0, 3]],
}


@pytest.mark.parametrize("orientation", [None, 0, 9, "6", *TURNED])
def test_orientation(orientation):
    wanted = TURNED.get(orientation, PIXELS[..., 0].tolist())
    assert turned(PIXELS, orientation)[..., 1].tolist() == wanted


def with_orientation(pixels, value):
    """A JPEG with the field Orientation of EXIF, made by hand."""
    jpeg = iio.imwrite("<bytes>", pixels, extension=".jpg", quality=98)
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01" + bytes([0, value, 0, 0])
    exif = b"Exif\0\0MM\0*\0\0\0\x08\x00\x01" + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]


@pytest.mark.parametrize("grey", [False, True])
def test_a_photograph_is_turned_as_a_viewer_turns_it(tmp_path, grey):
    """A mirrored one, too; w and h are those of the picture as it is seen."""
    upright = as_bytes(straight())
    folder = capture(tmp_path / "turned", upright, 9)
    stored = np.ascontiguousarray(upright.swapaxes(0, 1)[:, ::-1])  # 8 in TURNED turns it back
    for value, pixels in ((8, stored), (5, upright.swapaxes(0, 1))):
        pixels = np.ascontiguousarray(pixels[..., 0] if grey else pixels)
        (folder / "images/0002.jpg").write_bytes(with_orientation(pixels, value))
        image = read(folder)[0].train[1].image
        assert psnr(image, upright[..., :1] / 255 if grey else upright / 255) > 30


def test_premultiplied_colours_get_one_line(tmp_path):
    rng = np.random.default_rng(0)
    alpha = rng.uniform(size=(HEIGHT, WIDTH, 1))
    color = np.broadcast_to([0.9, 0.4, 0.2], (HEIGHT, WIDTH, 3))
    for name, pixels, lines in (
        ("straight", np.dstack([color, alpha]), 0),
        ("premultiplied", np.dstack([color * alpha, alpha]), 1),
        ("opaque", np.dstack([color * 0.1, np.ones_like(alpha)]), 0),
    ):
        folder = capture(tmp_path / name, as_bytes(straight()), 1)
        for i in range(3):
            iio.imwrite(folder / f"images/{i}.png", as_bytes(pixels))
        data = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
        data["frames"] = [
            {**data["frames"][0], "file_path": f"images/{i}", "time": 0} for i in range(3)
        ]
        (folder / "transforms.json").write_text(json.dumps(data), encoding="utf-8")
        warn_once.cache_clear()
        _, told = read(folder, downscale=2)
        begin = f"{folder / 'transforms.json'}: in the partly"
        assert len([line for line in told if line.startswith(begin)]) == lines


def test_progress_is_told_before_every_picture(toy):
    calls = []
    read(toy, progress=lambda *call: calls.append(call))
    assert calls == [(i, 17) for i in range(17)]


@pytest.mark.parametrize("target", [(0, 0, 0), (5, -3, 2)])
def test_the_point_that_cameras_look_at(target):
    scene = load_scene("static", downscale=8)
    away = np.random.default_rng(0).normal(size=(9, 3))
    views = [
        replace(v, camera=replace(v.camera, R=c.R, T=c.T))
        for v, place in zip(scene.train, away)
        for c in [look_at(target + 4 * place, target, 10, 10, 8, 8)]
    ]
    np.testing.assert_allclose(replace(scene, train=views).center, target, atol=1e-9)
    # Of cameras that look alike, the point of their common axis that is nearest to the origin.
    alike = replace(scene, train=[views[0]] * 3).center
    np.testing.assert_allclose(alike @ views[0].camera.R[2], 0, atol=1e-9)
