"""Scenes: the conventions of the loader, its messages, scenes from arrays."""

import json
import math
import os
import shutil
import struct
import zlib
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.scenes import MODEL_EFFECTS, Scene, load_scene, packaged_scenes
from p4dgs_ref.splatting.camera import look_at
from tests.scenes.refusals import refuse

WIDTH, HEIGHT = 12, 8


def pose(azimuth=0.3, elevation=0.5, radius=4.0):
    """A camera-to-world matrix in Blender's axes, from spherical angles."""
    back = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0])
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, np.cross(back, right), back, radius * back], axis=1)
    return c2w


def write_folder(
    folder,
    width=WIDTH,
    height=HEIGHT,
    extension="",
    head=None,
    splits=("train", "test"),
):
    """Write a folder in the layout of the published D-NeRF scenes; returns its pictures by name."""
    rng, pictures = np.random.default_rng(7), {}
    for split in splits:
        (folder / split).mkdir(parents=True)
        frames = []
        for i in range(3):
            name = f"./{split}/r_{i:03d}"
            pictures[name[2:]] = rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
            iio.imwrite(folder / f"{name}.png", pictures[name[2:]])
            frames.append(
                {
                    "file_path": name + extension,
                    "rotation": 0.02,
                    "time": i / 2,
                    "transform_matrix": pose(azimuth=i).tolist(),
                }
            )
        (folder / f"transforms_{split}.json").write_text(
            json.dumps({**({"camera_angle_x": 0.69} if head is None else head), "frames": frames}),
            encoding="utf-8",
        )
    return pictures


@pytest.fixture
def folder(tmp_path):
    write_folder(tmp_path / "scene")
    return tmp_path / "scene"


def edit(folder, change, name="transforms_train.json"):
    data = json.loads((folder / name).read_text(encoding="utf-8"))
    change(data)
    (folder / name).write_text(json.dumps(data), encoding="utf-8")


def test_a_folder_in_the_published_layout(tmp_path):
    pictures = write_folder(tmp_path / "jumping", 80, 80, splits=("train", "val", "test"))
    scene = load_scene(tmp_path / "jumping")
    assert (len(scene.train), len(scene.test), scene.name) == (3, 3, "jumping")
    assert scene.effects == MODEL_EFFECTS and [view.time for view in scene.test] == [0, 0.5, 1]
    assert [view.name for view in scene.test] == ["test/r_000", "test/r_001", "test/r_002"]
    view = scene.train[1]
    assert view.image.dtype == view.alpha.dtype == np.float32
    np.testing.assert_allclose(view.alpha, pictures["train/r_001"][..., 3] / 255, atol=1e-6)
    np.testing.assert_allclose(view.camera.center, pose(azimuth=1)[:3, 3], atol=1e-12)


@pytest.mark.parametrize(
    "extension, background, color",
    [
        (".png", {"background": (0, 0, 0)}, (0, 0, 0)),
        ("", {}, (1, 1, 1)),
        ("", {"background": (0.2, 0.9, 0.4)}, (0.2, 0.9, 0.4)),
    ],
)
def test_composited_over_the_background(tmp_path, extension, background, color):
    pictures = write_folder(tmp_path / "scene", extension=extension)
    scene = load_scene(str(tmp_path / "scene"), **background)
    np.testing.assert_allclose(scene.background, np.float32(color))
    camera = scene.test[2].camera
    f = WIDTH / 2 / math.tan(0.69 / 2)  # the angle spans the width; pixels are square
    np.testing.assert_allclose([camera.f_x, camera.f_y, camera.c_x, camera.c_y], [f, f, 5.5, 3.5])
    picture = pictures["test/r_002"] / 255
    want = picture[..., :3] * picture[..., 3:] + np.array(color) * (1 - picture[..., 3:])
    np.testing.assert_allclose(scene.test[2].image, want, atol=1e-6)


def test_downscale_averages_boxes_of_premultiplied_colour(tmp_path):
    pictures = write_folder(tmp_path / "scene")
    view = load_scene(tmp_path / "scene", background=(0, 0, 0), downscale=4).train[0]
    for row, column in np.ndindex(HEIGHT // 4, WIDTH // 4):
        box = pictures["train/r_000"][4 * row : 4 * row + 4, 4 * column : 4 * column + 4] / 255
        found = [*view.image[row, column], view.alpha[row, column]]
        wanted = sum(np.append(p[:3] * p[3], p[3]) for p in box.reshape(-1, 4)) / 16
        np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("w, h", [(24, 16), (25, 17), (6, 4), (12, 8)])
def test_pictures_of_another_size_than_the_file_says(tmp_path, w, h):
    """Focal lengths and the principal point are pixels of w x h, whatever the pictures have."""
    x, y = w / WIDTH, h / HEIGHT
    square = {"fl_x": 20.0 * x, "cx": 5.0 * x, "cy": 4.5 * y, "w": w, "h": h}
    for folder, head in {"square": square, "other": {**square, "fl_y": 30.0 * y}}.items():
        write_folder(tmp_path / folder, head=head)
        camera = load_scene(tmp_path / folder, downscale=2).train[0].camera
        found = camera.f_x, camera.f_y, camera.c_x, camera.c_y, camera.width, camera.height
        f_y = head.get("fl_y", head["fl_x"]) / y / 2
        np.testing.assert_allclose(found, (10, f_y, 2, 1.75, 6, 4), rtol=1e-14)


IDENTITY = np.eye(4)[:3].tolist()
OFF = {"k3": 0, "is_fisheye": False, "mask": None, "rolling_shutter": [0, 0], "shift": IDENTITY}
NAMED = {"aabb_scale": 16, "from_na": True, "depth": "a.png", "matrix": [[0, 1]], "huge": 10**400}
NAMED |= {"long": [1.0] * 10**5}  # no square of this side is made


def test_a_field_is_used_or_off_or_named_in_one_line(folder, recwarn):
    """Other programs write a lens without distortion in many words, some of them in each frame."""
    plain = load_scene(folder).train[1].camera
    edit(folder, lambda data: data.update(OFF, camera_model="OPENCV"))
    edit(folder, lambda data: [f.update(OFF) for f in data["frames"]])
    edit(folder, lambda data: data["frames"][1].update(file_path=".\\train\\r_001.png"))
    view = load_scene(folder).train[1]
    np.testing.assert_equal(vars(view.camera), vars(plain))
    assert view.name == "train/r_001" and not recwarn.list
    edit(folder, lambda data: data.update(camera_angle_y=0.5))
    assert load_scene(folder).train[1].camera.f_y == HEIGHT / 2 / math.tan(0.25)
    edit(folder, lambda data: data.update(NAMED))
    edit(folder, lambda data: data["frames"][1].update(sharpness=2))
    with pytest.warns(UserWarning) as told:
        load_scene(folder)
    names = ", ".join(map(repr, sorted([*NAMED, "sharpness"])))
    line = f"{folder / 'transforms_train.json'}: these fields are ignored: {names}"
    assert [str(one.message) for one in told] == [line]


def test_a_frame_may_have_a_lens_of_its_own(folder):
    edit(folder, lambda data: data["frames"][1].update(camera_angle_x=0.5, cx=5))
    first, own, _ = (view.camera for view in load_scene(folder).train)
    assert (own.c_x, own.f_x) == (4.5, WIDTH / 2 / math.tan(0.25)) and first.c_x == 5.5


def test_effects_listed_in_the_folder(folder):
    listed = json.dumps({"effects": ["specular", "occlusion", "rotation"]})
    (folder / "scene.json").write_text(listed, encoding="utf-8-sig")  # with a mark, as on Windows
    scene = load_scene(folder)
    assert scene.effects == ("rotation", "occlusion")  # the model's, in the order of the list
    assert not scene.background.any()  # no `background`: black, the neutral input


def in_file(**fields):
    """A change of fields outside the frames."""
    return lambda data: data.update(fields)


def in_frame(**fields):
    """A change of fields of the second frame."""
    return lambda data: data["frames"][1].update(fields)


def change_matrix(rows):
    return in_frame(transform_matrix=rows)


def with_entry(i, j, value):
    matrix = pose()
    matrix[i, j] = value
    return matrix.tolist()


MISTAKES = [
    ("no frames", lambda d: d.pop("frames"), ("frames", "list")),
    ("frame of text", lambda d: d["frames"].insert(1, "r_001"), ("frames[1]", "a dict")),
    (
        "no file_path",
        lambda d: d["frames"][1].pop("file_path"),
        ("frames[1].file_path: missing", "a text"),
    ),
    (
        "absent picture",
        in_frame(file_path="./train/r_9"),
        ("frames[1].file_path", "r_9.png"),
    ),
    ("time missing", lambda d: d["frames"][1].pop("time"), ("frames[1].time: missing", "[0, 1]")),
    (
        "no matrix",
        lambda d: d["frames"][1].pop("transform_matrix"),
        ("frames[1].transform_matrix", "shape [4, 4]"),
    ),
    (
        "matrix NaN",
        change_matrix(with_entry(0, 3, math.nan)),
        ("frames[1].transform_matrix", "[-1e+06, 1e+06]"),
    ),
    ("last row", change_matrix(with_entry(3, 0, 1.0)), ("frames[1].transform_matrix", "last row")),
    (
        "scaled",
        change_matrix((pose() * [1.01, 1.01, 1.01, 1]).tolist()),
        ("frames[1].transform_matrix", "rotation"),
    ),
    (
        "mirrored",
        change_matrix((pose() * [-1, 1, 1, 1]).tolist()),
        ("frames[1].transform_matrix", "+1"),
    ),
    (
        "matrix of texts",
        change_matrix([[str(entry) for entry in row] for row in pose().tolist()]),
        ("frames[1].transform_matrix", "shape [4, 4]"),
    ),
    (
        "a camera at 2e6",
        change_matrix(with_entry(2, 3, -2e6)),
        ("frames[1].transform_matrix", "1e+06"),
    ),
    (
        "a picture above the folder",
        in_frame(file_path="../secret"),
        ("frames[1].file_path", "outside", "picture in the folder"),
    ),
    (
        "a picture through a link",
        in_frame(file_path="link"),
        ("frames[1].file_path", "outside"),
    ),
    (
        "a picture that is a pipe",
        in_frame(file_path="pipe"),
        ("frames[1].file_path", "no picture"),
    ),
    (
        "a name with a zero byte",
        in_frame(file_path="train/r_001\0"),
        ("frames[1].file_path", "control characters"),
    ),
    ("no angle", lambda d: d.pop("camera_angle_x"), ("camera_angle_x", "missing")),
    ("angle 4", in_file(camera_angle_x=4), ("camera_angle_x", "4; expected", "3.14159")),
    ("fl_y huge", in_file(fl_y=10**400), ("fl_y", "1e+09]")),
    *(
        (f"{name} {value}", in_file(**{name: value}), (name, *words))
        for name, value, *words in (
            ("w", 24, "24x8", "12x8 pixels"),
            ("h", 9, "w, h, cx, cy: 12x9", "12x8 pixels"),
            ("fl_x", 20, "camera_angle_x: 0.69; expected 0.582914", "fl_x"),
            ("k3", -1e-9, "-1e-09; expected 0", "undistort"),
            ("is_fisheye", True, "True", "undistort"),
            ("camera_model", "OPENCV_FISHEYE", "'OPENCV_FISHEYE'", "PINHOLE", "OPENCV"),
            ("cx", 12.5, "12x8, 12.5, 4; expected", "12x8 pixels, and a point inside"),
        )
    ),
    ("k4 of a frame", in_frame(k4=0.1), ("frames[1].k4: 0.1; expected 0",)),
]


@pytest.mark.posix("has no pipes in folders")
@pytest.mark.parametrize("change, words", [pytest.param(*row[1:], id=row[0]) for row in MISTAKES])
def test_mistakes_in_a_transforms_file(folder, change, words):
    shutil.copy(folder / "train" / "r_000.png", folder.parent / "secret.png")
    (folder / "link.png").symlink_to(folder.parent / "secret.png")
    os.mkfifo(folder / "pipe.png")
    edit(folder, change)
    refuse(("transforms_train.json", *words), load_scene, folder)


def test_pictures_inside_the_folder_by_any_way(folder):
    """An absolute path, a detour and a link are fine as long as they stay inside."""
    (folder / "link.png").symlink_to("train/r_000.png")
    ways = (str(folder / "train/r_000.png"), "test/../train/r_000", "link", "./train/r_000.png")
    want = load_scene(folder).train[0].image
    for way in ways:
        edit(folder, lambda data, way=way: data["frames"][1].update(file_path=way))
        np.testing.assert_array_equal(load_scene(folder).train[1].image, want)
    (folder.parent / "another name").symlink_to(folder.name)  # the folder itself may be a link
    assert len(load_scene(folder.parent / "another name").train) == 3


def make_large(path):
    """3 GB that take no place on the disk."""
    os.truncate(os.open(path, os.O_CREAT | os.O_RDWR), 3 << 30)


@pytest.mark.posix("has no pipes in folders")
@pytest.mark.parametrize("name", ["transforms_train.json", "transforms_test.json", "scene.json"])
@pytest.mark.parametrize(
    "make, words",
    [
        (lambda path: os.mkfifo(path), "directory, a device"),
        (os.mkdir, "directory, a device"),
        (make_large, "larger than"),
    ],
)
def test_a_json_that_is_no_file(folder, name, make, words):
    (folder / name).unlink(missing_ok=True)
    make(folder / name)
    refuse((name, words), load_scene, folder)


def chunk(kind, data):
    """A chunk of a PNG file."""
    crc = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)


@pytest.mark.parametrize(
    "side, words",
    [
        (13_300, "(13300, 13300, 4) numbers; expected a picture of at most"),
        (100_000, ""),
        (2**31 - 1, ""),
    ],
)
def test_a_png_that_promises_many_pixels(folder, side, words, recwarn):
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(b"only a few")) + chunk(b"IEND", b"")
    (folder / "train" / "r_001.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + body)
    refuse(("frames[1].file_path", "r_001.png", "a picture", words), load_scene, folder)
    assert not recwarn.list


def text(name, content):
    return lambda folder: (folder / name).write_text(content, encoding="utf-8")


def effects(names):
    return text("scene.json", json.dumps({"effects": names}))


def picture(*shape, pixels=np.uint8(0), **kind):
    """Writes a picture in the place of one of the scene; `kind` is for Pillow."""
    pixels = np.broadcast_to(pixels, shape)
    return lambda folder: iio.imwrite(
        folder / "test" / "r_001.png", pixels, plugin="pillow", **kind
    )


nothing = text("notes.txt", "a file that nobody reads")
IN_THE_FOLDER = [
    (nothing, dict(path="nowhere"), ("nowhere", "bouncing")),
    (nothing, dict(downscale=0), ("downscale", "0")),
    (nothing, dict(downscale=9), ("frames[0]", "12x8", "at least downscale 9")),
    (effects(["wind"]), {}, ("scene.json", "effects", "wind", *MODEL_EFFECTS)),
    (effects(["rotation", "rotation"]), {}, ("scene.json", "effects", "each of them once")),
    (picture(HEIGHT, 6, 4), {}, ("test/r_001", "6x8", "12x8")),
    (
        picture(HEIGHT, WIDTH, 4, mode="CMYK", extension=".tif"),
        {},
        ("frames[1].file_path", "r_001.png", "pixels of kind CMYK; expected RGB"),
    ),
    (
        picture(HEIGHT, WIDTH, pixels=np.uint16(300)),
        {},
        ("r_001.png", "pixels of kind I", "grey of 8 bits"),
    ),
    (
        lambda folder: (folder / "test" / "r_001.png").write_bytes(b"\x89PNG\r\n\x1a\n and then"),
        {},
        ("transforms_test.json", "frames[1].file_path", "r_001.png", "a picture of RGB"),
    ),
    (text("transforms_test.json", '{"frames": ['), {}, ("transforms_test.json", "JSON")),
    (text("transforms_test.json", '{"frames": []}'), {}, ("transforms_test.json", "empty")),
]


@pytest.mark.parametrize("change, options, words", IN_THE_FOLDER)
def test_mistakes_in_the_folder(folder, change, options, words):
    change(folder)
    options = {**options, "path": folder / options.get("path", "")}
    refuse(words, load_scene, **options)


def test_a_picture_for_which_memory_is_too_small_is_not_called_broken(folder, monkeypatch):
    def full(*arguments, **settings):
        raise MemoryError("12 GiB")

    monkeypatch.setattr("p4dgs_ref.scenes.files.iio.imopen", full)
    with pytest.raises(MemoryError, match="12 GiB"):
        load_scene(folder)


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_grey_pictures_are_read(folder, background):
    grey, alpha = np.random.default_rng(1).integers(0, 256, (2, HEIGHT, WIDTH), dtype=np.uint8)
    over = np.where(alpha > 127, grey / 255, background)
    for pixels, want in (
        (grey, grey / 255),
        (alpha > 127, 1.0 * (alpha > 127)),
        (np.stack([grey, np.where(alpha > 127, np.uint8(255), np.uint8(0))], axis=2), over),
    ):
        picture(*pixels.shape, pixels=pixels)(folder)
        image = load_scene(folder, background=[background] * 3).test[1].image
        np.testing.assert_allclose(image, np.stack([want] * 3, axis=2), atol=1e-6)


def test_packaged_names_and_paths(tmp_path, monkeypatch):
    assert {"bouncing", "figure", "glossy", "static", "orientation", "orbit"} <= set(
        packaged_scenes()
    )
    monkeypatch.chdir(tmp_path)
    packaged = load_scene("static")
    assert (len(packaged.train), len(packaged.test), packaged.effects) == (
        48,
        10,
        ("occlusion", "background"),
    )
    write_folder(tmp_path / "static")
    assert len(load_scene("static").train) == 3  # a path that exists wins over a name


def arrays(n=5, channels=3):
    rng = np.random.default_rng(3)
    cameras = [look_at([3, i - 2.0, 1], [0, 0, 0], 10, 11, WIDTH, HEIGHT) for i in range(n)]
    return rng.uniform(size=(n, HEIGHT, WIDTH, channels)), cameras, np.linspace(0, 1, n)


def test_scene_from_arrays():
    images, cameras, times = arrays(channels=4)
    scene = Scene.from_arrays(
        images, cameras, times, test=[1, 3], effects=["background"], background=(0.5, 0, 1)
    )
    assert [view.name for view in scene.test] == ["images[1]", "images[3]"] and len(
        scene.train
    ) == 3
    assert (
        scene.effects == ("background",)
        and scene.source is None
        and scene.test[0].camera is cameras[1]
    )
    want = images[3][..., :3] * images[3][..., 3:] + np.array([0.5, 0, 1]) * (
        1 - images[3][..., 3:]
    )
    np.testing.assert_allclose(scene.test[1].image, want, atol=1e-6)
    eight_bit = Scene.from_arrays((images[..., :3] * 255).astype(np.uint8), cameras, times)
    assert eight_bit.train[0].image.dtype == np.float32 and eight_bit.train[0].alpha is None
    single = Scene.from_arrays(images[:1], cameras[:1], [0.0])
    late = replace(single.train[0], time=2)
    refuse(("arrays: images[0]: time", "[0, 1]"), replace, single, train=(late,))


IMAGES, CAMERAS, TIMES = arrays()
IN_ARRAYS = [
    (dict(cameras=CAMERAS[:4]), ("images, cameras, times", "5, 4 and 5")),
    (dict(times=[0, 0, math.nan, 0, 0]), ("images[2]: time", "nan")),
    (dict(test=[0, 5]), ("test[1]", "5", "[0, 4]")),
    (dict(test=range(5)), ("train", "at least one")),
    (dict(images=IMAGES * 255), ("images[0]", "[0, 1]")),
    (dict(images=IMAGES[..., 0]), ("images[0]", "(H, W, 3)")),
    (dict(images=[*IMAGES[:4], IMAGES[4][:4]]), ("images[4]", "same for all")),
    (dict(images=IMAGES[:, :6]), ("images[0]", "camera", "12x8")),
    *(
        (dict(cameras=[replace(CAMERAS[0], **change), *CAMERAS[1:]]), ("images[0]: camera", word))
        for word, change in (
            ("rotation", dict(R=2 * np.eye(3))),
            ("R", dict(R=np.eye(4))),
            ("T", dict(T=np.full(3, np.nan))),
            ("f_x", dict(f_x=-1.0)),
            ("f_y", dict(f_y=1e300)),
            ("c_x", dict(c_x=-1e300)),
            ("c_y", dict(c_y=math.nan)),
        )
    ),
]


@pytest.mark.parametrize("change, words", IN_ARRAYS)
def test_mistakes_in_arrays(change, words):
    given = {**dict(images=IMAGES, cameras=CAMERAS, times=TIMES), **change}
    refuse(words, Scene.from_arrays, **given)
