"""Captures as they lie: one file of views, missing pictures, a lens, sizes, EXIF, colours."""

import json
import math
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.effects import MOTION
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.files import box_filter
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
        unread == f"{toy / 'transforms.json'}: these fields are ignored: 'aabb_scale', 'sharpness'"
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


def rename(folder, old, *new):
    """Put the views of a transforms file into one or more files of other names."""
    text = (folder / old).read_text(encoding="utf-8")
    (folder / old).unlink()
    for name in new:
        (folder / name).write_text(text, encoding="utf-8")


TRAIN, TEST, VAL = (f"transforms_{split}.json" for split in ("train", "test", "val"))
CAPTURE = "transforms.json"


@pytest.mark.parametrize(
    "read_names, others",
    [
        ([CAPTURE], []),
        ([CAPTURE], [TEST]),
        ([TRAIN], []),
        ([TRAIN], [CAPTURE]),
        ([VAL], []),
        ([TRAIN, VAL], []),
        ([TRAIN, TEST], [VAL, CAPTURE]),
    ],
)
def test_which_files_say_what_is_trained_on(tmp_path, read_names, others):
    """One file alone is a capture, whatever its name; a validation split stands in for a test."""
    folder = capture(tmp_path / "clone", as_bytes(straight()), 9)
    rename(folder, CAPTURE, *read_names, *others)
    scene, told = read(folder)
    assert (len(scene.train), len(scene.test)) == ((9, 9) if read_names[1:] else (7, 2))
    lines = [line for line in told if "fields are ignored" in line]
    assert [line.partition(":")[0] for line in lines] == [str(folder / name) for name in read_names]


def test_without_views_to_train_on_the_missing_file_is_named(tmp_path):
    folder = capture(tmp_path / "clone", as_bytes(straight()), 3)
    rename(folder, CAPTURE, TEST, VAL)
    refuse((f"{TRAIN}: missing; expected JSON", "COLMAP"), load_scene, folder)


def test_a_transforms_file_names_its_folder(toy):
    scene, _ = read(toy / CAPTURE)
    assert (scene.name, scene.source) == ("toy", toy)


@pytest.mark.parametrize("missing, is_read", [(0, True), (4, True), (5, False), (9, False)])
@pytest.mark.parametrize("name", [CAPTURE, TRAIN])
def test_frames_of_a_capture_whose_picture_is_missing_are_left_out(
    tmp_path, name, missing, is_read
):
    """The first and every eighth of the pictures that exist are test views."""
    folder = capture(tmp_path / "sample", as_bytes(straight()), 9)
    rename(folder, CAPTURE, name)
    pictures = sorted((folder / "images").iterdir())
    for file in pictures[:missing]:
        file.unlink()
    said = f"{name}: {missing} of 9 frames have no picture in {folder}"
    if is_read:
        scene, told = read(folder)
        names = [f"images/{file.name}".removesuffix(".png") for file in pictures[missing:]]
        assert [view.name for view in scene.test] == names[::8]
        assert len(scene.train) == len(names) - len(names[::8])
        assert [said in line for line in told].count(True) == bool(missing)
    else:
        with pytest.warns(UserWarning, match="fields are ignored"):
            refuse((f"{said}; expected one for at least half",), load_scene, folder)


def test_a_picture_missing_in_two_splits_is_refused(tmp_path):
    folder = capture(tmp_path / "clone", as_bytes(straight()), 9)
    rename(folder, CAPTURE, TRAIN, TEST)
    (folder / "images/0003.JPG").unlink()
    with pytest.warns(UserWarning):
        refuse((TRAIN, "frames[6].file_path: no picture './images/0003.JPG'"), load_scene, folder)


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


def with_orientation(pixels, value):
    """A JPEG with the field Orientation of EXIF, made by hand."""
    jpeg = iio.imwrite("<bytes>", pixels, extension=".jpg", quality=98)
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01" + bytes([0, value, 0, 0])
    exif = b"Exif\0\0MM\0*\0\0\0\x08\x00\x01" + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]


@pytest.mark.parametrize("orientation", [0, 1, 3, 6, 8, 9])
def test_pictures_are_read_as_stored_whatever_their_orientation(tmp_path, orientation):
    """COLMAP's cameras belong to the stored pixels; one line says how many are not turned."""
    stored = as_bytes(straight())
    folder = capture(tmp_path / "phone", stored, 9)
    for name in ("0002.jpg", "0003.JPG"):
        (folder / "images" / name).write_bytes(with_orientation(stored, orientation))
    scene, told = read(folder)
    for view in scene.train[1:3]:
        assert psnr(view.image, stored / 255) > 30
    said = [line for line in told if "EXIF" in line]
    assert len(said) == (orientation in (3, 6, 8))
    if said:
        assert said[0].startswith(f"{folder}: 2 of 9 pictures have an EXIF orientation, which is")


def test_sizes_that_only_the_turned_picture_has_are_refused_with_the_word_exif(tmp_path):
    lying = np.ascontiguousarray(as_bytes(straight()).swapaxes(0, 1))
    folder = capture(tmp_path / "phone", lying, 3)
    words = "180x320", "expected the proportions of the picture, 160x90 pixels"
    with pytest.warns(UserWarning):
        message = refuse(words, load_scene, folder)
        assert "EXIF" not in message
    for file in (folder / "images").iterdir():
        file.write_bytes(with_orientation(lying, 6))
    with pytest.warns(UserWarning):
        refuse((*words, "as stored (EXIF orientation 6 is not applied)"), load_scene, folder)


@pytest.mark.parametrize(
    "head, words",
    [
        ({"cx": 0.5, "cy": 0.5}, ["principal point 0.25, 0.25; expected pixels of 90x160"]),
        ({"cx": 1.0, "cy": 0.5}, ["expected pixels of 90x160, not fractions of the sides"]),
        ({"k1": -3}, ["lens distortion -3, 0, 0: towards the corner", "undistort"]),
        ({"k1": -44.85, "k2": 1017}, ["lens distortion -44.85, 1017, 0:", "grows only 0.1"]),
        ({"k1": -0.3, "k2": 0.1}, []),  # of a wide lens
        ({"k1": 0.06, "k2": -0.08, "fl_x": 300.0, "fl_y": 300.0}, []),  # of a phone
    ],
)
def test_a_lens_in_other_units_or_that_folds_the_picture_is_refused(tmp_path, head, words):
    folder = capture(tmp_path / "roof", as_bytes(straight()), 3, **head)
    with pytest.warns(UserWarning):
        if words:
            refuse(["transforms.json: frames[", *words], load_scene, folder)
        else:
            load_scene(folder, downscale=10)


GRADIENT = np.linspace(0.1, 0.9, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH, 1)
BROWN = np.broadcast_to([0.9, 0.4, 0.2], (HEIGHT, WIDTH, 3))


@pytest.mark.parametrize(
    "color, alpha, is_told",
    [
        (BROWN, GRADIENT, False),
        (BROWN * GRADIENT, GRADIENT, True),
        (BROWN * 0.1 * GRADIENT, GRADIENT, True),
        (BROWN * 0.1, GRADIENT, False),  # a dark object
        (BROWN * 0.1, np.ones_like(GRADIENT), False),
    ],
)
def test_premultiplied_colours_get_one_line_in_every_folder(tmp_path, color, alpha, is_told):
    pixels = as_bytes(np.dstack([color, alpha]))
    for name in ("one", "two"):
        folder = capture(tmp_path / name, as_bytes(straight()), 3)
        for file in (folder / "images").glob("*.[pP]*"):
            file.write_bytes(iio.imwrite("<bytes>", pixels, extension=".png"))
        for _ in range(2):
            _, told = read(folder, downscale=2)
            said = [line for line in told if "expected straight alpha" in line]
            assert len(said) == is_told
            assert all(line.startswith(f"{folder}: 2 of 3 pictures have partly") for line in said)


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
