"""The simulator: closed forms, conventions, the packaged scenes, mistakes in scene.json."""

import copy
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref.output import OutputError
from p4dgs_ref.scenes import SIMULATOR_EFFECTS, load_scene
from p4dgs_ref.scenes.load import packaged_folder
from p4dgs_ref.scenes.simulator import place_cameras, simulate, trace
from p4dgs_ref.scenes.simulator.bodies import ball_hit, box_hit, capsule_hit, capsule_normal, poses
from p4dgs_ref.scenes.simulator.description import read_description
from p4dgs_ref.splatting.camera import look_at
from tests.sampling import few
from tests.scenes.refusals import refuse

SPHERE = {"name": "ball", "shape": {"kind": "sphere", "radius": 0.5}, "color": [0.8, 0.4, 0.2]}
BOX = {"name": "box", "shape": {"kind": "box", "half": [0.4, 0.3, 0.2]}, "color": [0.1, 0.3, 0.5]}
FULL = {
    "title": "everything at once",
    "resolution": [10, 8],
    "lens": {"fl_x": 12, "fl_y": 11, "cx": 5, "cy": 4},
    "effects": list(SIMULATOR_EFFECTS),
    "cameras": {"kind": "scattered", "train": 3, "test": 2, "radius": 3, "elevation": [10, 60]},
    "light": {"kind": "sun", "direction": [-1, -0.5, -2], "ambient": 0.4},
    "bodies": [
        {
            **SPHERE,
            "specular": {"strength": 0.5, "exponent": 5},
            "texture": {"kind": "checker", "color": [0, 0.2, 0.1], "cell": 0.3},
            "motion": [
                {"kind": "line", "by": [0.3, 0, 0]},
                {"kind": "pulse", "amount": 0.2},
                {"kind": "spin", "axis": [1, 1, 0], "degrees": 90},
            ],
        },
        {**BOX, "parent": "ball", "position": [0, 0.5, 0.1]},
    ],
}


def described(folder, **changes):
    """A scene.json of FULL with changes."""
    file = folder / "described.json"
    file.write_text(json.dumps({**FULL, **changes}), encoding="utf-8")
    return file


def changed(**changes):
    return read_description({**copy.deepcopy(FULL), **changes})


def test_rays_parallel_to_faces_and_axes():
    box, capsule = (
        changed(bodies=[{**SPHERE, "shape": shape}]).bodies[0].shape
        for shape in (
            {"kind": "box", "half": [1, 1, 1]},
            {"kind": "capsule", "start": [0, 0, -1], "end": [0, 0, 1], "radius": 0.5},
        )
    )
    down = np.array([[0.0, 0, -2]])
    for hit, shape, eye, distance in (
        (box_hit, box, (0.3, -0.2, 5.0), 2.0),
        (box_hit, box, (1.3, -0.2, 5.0), np.inf),
        (capsule_hit, capsule, (0.0, 0.0, 5.0), 1.75),
        (capsule_hit, capsule, (0.6, 0.0, 5.0), np.inf),
    ):
        assert hit(shape, np.array(eye), down)[0] == distance


def one_ball(effects, light=None, t=0.0, position=(0.0, 0.0, 4.0), **body):
    """The ball seen from above; the row and column of the centre are integers."""
    eye = look_at(position, (0, 0, 0), 40, 40, 21, 21, up=(0, 1, 0))
    light = light or {"kind": "sun", "direction": [0, 0, -1], "ambient": 0.3}
    return trace.trace(changed(bodies=[{**SPHERE, **body}], effects=effects, light=light), eye, t)


COLOR = np.array(SPHERE["color"])
# 60 degrees off the pole, as is the light that the pole mirrors.
SIDEWAYS = {"kind": "sun", "direction": [-math.sqrt(3), 0, -1], "ambient": 0.3}
BELOW = {"kind": "point", "position": [0, 0, -9], "ambient": 0.3}
LAMP = {"kind": "point", "position": [0, math.sqrt(3), 1.5], "ambient": 0}  # 60 degrees off, too
POLE = [  # effects, light, strength and exponent of the highlight, color, relative error
    (["diffuse"], SIDEWAYS, (0, 1), COLOR * (0.3 + 0.7 * 0.5), 2e-3),
    (["diffuse", "specular"], BELOW, (0.5, 1), COLOR * 0.3, 1e-7),
    (["specular", "view_color"], SIDEWAYS, (0.2, 3), COLOR + 0.2 * 0.5**3, 1e-2),
    (["diffuse"], LAMP, (0, 1), COLOR * 0.5, 1e-2),
]


@pytest.mark.parametrize("effects, light, gloss, want, rtol", POLE)
def test_lambert_and_phong_at_the_pole(effects, light, gloss, want, rtol):
    specular = {"strength": gloss[0], "exponent": gloss[1]}
    lit = one_ball([*effects, "background"], light, specular=specular)[10, 10]
    np.testing.assert_allclose(lit, [*want, 1], rtol=rtol)


@pytest.mark.parametrize(
    "effects, follows", [(["specular"], False), (["specular", "view_color"], True)]
)
def test_the_highlight_follows_the_viewer_only_with_view_color(effects, follows):
    """Under a light overhead the highlight is at the pole, or half-way from it to the viewer."""
    position = np.array([2.4, 0, 3.2])
    plain, shiny = (
        one_ball(
            ["background", *some], position=position, specular={"strength": 0.2, "exponent": 30}
        )
        for some in ([], effects)
    )
    v, u = np.unravel_index((shiny - plain)[..., :3].sum(axis=2).argmax(), (21, 21))
    halfway = np.array([0, 0, 1.0]) + follows * position / 4
    eye = look_at(position, (0, 0, 0), 40, 40, 21, 21, up=(0, 1, 0))
    X, Y, Z = eye.R @ (0.5 * halfway / np.linalg.norm(halfway)) + eye.T
    assert abs(u - (40 * X / Z + 10)) <= 0.51 and abs(v - (40 * Y / Z + 10)) <= 0.51


@pytest.mark.parametrize(
    "move, t, want",
    [
        ({"kind": "line", "by": [0.5, 0, -0.2]}, 0.5, (0.25, 0, -0.1)),
        ({"kind": "bounce", "height": 0.6, "period": 0.5}, 0.25, (0, 0, 0.6)),
        ({"kind": "bounce", "height": 0.6, "period": 0.5, "phase": 0.5}, 0.125, (0, 0, 0.3)),
        ({"kind": "arc", "center": [-1, 0, 0], "degrees": 90, "period": 1}, 0.25, (-1, 1, 0)),
    ],
)
def test_translations(move, t, want):
    body = changed(bodies=[{**SPHERE, "motion": [move]}]).bodies
    pose = poses(body, ("translation",), t)["ball"]
    np.testing.assert_allclose(pose.T, want, atol=1e-12)
    np.testing.assert_allclose(pose.R, np.eye(3))
    assert not poses(body, ("rotation", "scaling"), t)["ball"].T.any()


def test_limbs_are_carried_by_their_parents_but_do_not_inherit_scale():
    quarter = {"kind": "spin", "axis": [0, 0, 1], "degrees": 90}
    bodies = changed(
        bodies=[
            {**SPHERE, "motion": [quarter, {"kind": "pulse", "amount": 0.5, "phase": 0.25}]},
            {
                **BOX,
                "parent": "ball",
                "position": [1, 0, 0],
                "motion": [{"kind": "swing", "axis": [0, 1, 0], "degrees": 90, "phase": 0.25}],
            },
        ]
    ).bodies
    ball, box = poses(bodies, SIMULATOR_EFFECTS, 1.0).values()
    np.testing.assert_allclose([ball.scale, box.scale], [1.5, 1])
    # The quarter turn of the parent takes x to y; the turn of the child first takes z to x.
    np.testing.assert_allclose(box.T, (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(box.R @ [0, 0, 1], (0, 1, 0), atol=1e-12)


def test_occlusion_and_its_absence():
    below = {**SPHERE, "name": "below", "position": [0, 0, -1.2], "color": [0.1, 0.5, 0.7]}
    eye = look_at((0, 0, 4), (0, 0, 0), 40, 40, 21, 21, up=(0, 1, 0))
    for bodies in ([SPHERE, below], [below, SPHERE]):
        hidden, added = (
            trace.trace(changed(bodies=bodies, effects=effects), eye, 0)[10, 10]
            for effects in (["occlusion", "background"], ["background"])
        )
        np.testing.assert_allclose(hidden, [0.8, 0.4, 0.2, 1])
        np.testing.assert_allclose(added, [0.9, 0.9, 0.9, 1])


def test_cameras_survive_the_way_through_the_file(tmp_path):
    calls = []
    file = described(tmp_path)
    simulate(file, tmp_path / "out", progress=lambda *call: calls.append(call))
    assert calls == [(i, 5) for i in range(1, 6)]
    description, scene = read_description(FULL), load_scene(tmp_path / "out", (0, 0, 0))
    for split, views in (("train", scene.train), ("test", scene.test)):
        for (eye, t), view in zip(place_cameras(description, split), views, strict=True):
            assert view.time == t
            for field, value in vars(eye).items():
                np.testing.assert_allclose(
                    getattr(view.camera, field), value, atol=1e-12, err_msg=field
                )
            drawn = trace.trace(description, eye, t)
            np.testing.assert_allclose(view.image, drawn[..., :3] * drawn[..., 3:], atol=1.1 / 255)
            np.testing.assert_allclose(view.alpha, drawn[..., 3], atol=0.51 / 255)


SCENES = ("bouncing", "figure", "glossy", "static", "orientation", "orbit")


@pytest.mark.parametrize("name", few(SCENES, 2))
def test_views_times_and_sizes_of_a_packaged_scene(name):
    readme = (packaged_folder() / "README.md").read_text(encoding="utf-8")
    scene = load_scene(name)
    assert (len(scene.train), len(scene.test)) == (48, 10)
    assert (scene.train[0].time, scene.train[-1].time) == (0, 1)
    assert not {view.time for view in scene.train} & {view.time for view in scene.test}
    assert 0.1 < np.mean([np.mean(view.alpha > 0.5) for view in scene.train + scene.test]) < 0.45
    centers = [view.camera.center for view in scene.train]
    steps = [np.linalg.norm(b - a) for a, b in zip(centers, centers[1:])]
    assert max(steps) < 1.2 if name == "orbit" else min(steps) > 1.2
    size = sum(file.stat().st_size for file in (packaged_folder() / name).rglob("*.*"))
    row = next(line for line in readme.splitlines() if line.startswith(f"| {name} |"))
    assert row.endswith(f"| {size:,} |"), f"tiny_scenes/README.md: {name} has {size:,} bytes"


def test_the_packaged_scenes_stay_small():
    assert sum(file.stat().st_size for file in packaged_folder().rglob("*.*")) < 2_500_000


def test_an_orbit_moves_the_training_camera_alone_as_it_says():
    cameras = {**FULL["cameras"], "kind": "orbit", "turns": 0.5, "train": 5}
    orbit, scattered = changed(cameras=cameras), changed()
    azimuths = [
        math.atan2(*camera.center[[1, 0]]) / math.pi for camera, _ in place_cameras(orbit, "train")
    ]
    np.testing.assert_allclose(np.unwrap(azimuths, period=2), np.linspace(0, 1, 5), atol=1e-12)
    for (one, _), (other, _) in zip(*(place_cameras(s, "test") for s in (orbit, scattered))):
        np.testing.assert_array_equal(one.center, other.center)


def test_nothing_is_left_of_a_drawing_that_stops(tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    place = tmp_path / "new"
    with pytest.raises(KeyboardInterrupt):
        simulate(described(tmp_path), place / "out", progress=stop)
    assert not place.exists()
    simulate(described(tmp_path), place / "out")
    before = {file: file.read_bytes() for file in place.rglob("*.*")}
    with pytest.raises(KeyboardInterrupt):
        simulate(described(tmp_path, effects=[]), place / "out", progress=stop)
    assert {file: file.read_bytes() for file in place.rglob("*.*")} == before


def ball_with(**fields):
    return {"bodies": [{**SPHERE, **fields}]}


MISTAKES = [
    ({"efects": []}, "scene: unknown field", "efects"),
    ({"effects": ["wind"]}, "scene: effects", "wind"),
    ({"resolution": [64, 6.5]}, "scene: resolution", "integers"),
    (
        {"light": {"kind": "sun", "direction": [0, 0, 0], "ambient": 0.1}},
        "scene: light.direction",
        "not zero",
    ),
    ({"light": {"kind": "lamp"}}, "scene: light.kind", "sun, point"),
    ({"bodies": []}, "scene: bodies", "at least one"),
    (ball_with(parent="box"), "scene: bodies[0]: name", "listed before"),
    (ball_with(color=[0, 0, 1.5]), "scene: bodies[0].color", "1.5]; expected numbers"),
    (ball_with(position=[0, 0, math.inf]), "scene: bodies[0].position", "inf"),
    (ball_with(shape={"kind": "sphere"}), "scene: bodies[0].shape.radius", "one number"),
    (
        ball_with(motion=[{"kind": "line", "by": [0, 0, 1], "height": 2}]),
        "scene: bodies[0].motion[0]",
        "unknown field ['height']",
    ),
]


@pytest.mark.parametrize("change, place, expected", MISTAKES, ids=[row[1] for row in MISTAKES])
def test_mistakes_in_a_description(change, place, expected):
    message = refuse([expected], read_description, {**FULL, **change})
    assert message.startswith(place)


def test_descriptions_in_files(tmp_path):
    file, taken = tmp_path / "scene.json", tmp_path / "taken"
    refuse(["scene.json: missing"], simulate, file, tmp_path / "out")
    file.write_text(json.dumps({**FULL, "light": {"kind": "lamp"}}), encoding="utf-8")
    refuse(["scene.json: light.kind: 'lamp'"], simulate, file, tmp_path / "out")
    file.write_text(json.dumps(FULL), encoding="utf-8")
    simulate(file, tmp_path / "new" / "out")
    assert (tmp_path / "new" / "out" / "scene.json").read_text(encoding="utf-8") == json.dumps(FULL)
    assert len(load_scene(tmp_path / "new" / "out").train) == 3
    taken.write_text("", encoding="utf-8")
    with pytest.raises(OutputError, match="taken: expected a writable folder"):
        simulate(file, taken)


def test_a_capsule_without_a_length_is_a_ball():
    point, away = np.array([0.1, 0.2, 0.3]), np.array([[0.0, 0.0, 1.0], [0.3, 0.1, 0.9]])
    capsule = SimpleNamespace(start=point, end=point, radius=0.5)
    eye = np.array([0.0, 0.0, -4.0])
    hit = capsule_hit(capsule, eye, away)
    assert np.allclose(hit, ball_hit(eye, away, point, 0.5))
    place = eye + hit[:1, None] * away[:1]
    assert np.allclose(capsule_normal(capsule, place), (place - point) / 0.5)
