"""Mistakes in scene.json: one line that names the file, the field and what was expected."""

import json
import math

import pytest

from p4dgs_ref.scenes import SceneError, load_scene
from p4dgs_ref.scenes.output import OutputError
from p4dgs_ref.scenes.simulator import simulate
from tests.core.refusals import refuse

SPHERE = {"name": "ball", "shape": {"kind": "sphere", "radius": 0.5}, "color": [0.8, 0.4, 0.2]}
SMALL = {
    "title": "one ball",
    "resolution": [10, 8],
    "lens": {"fl_x": 12, "fl_y": 11, "cx": 5, "cy": 4},
    "cameras": {"kind": "scattered", "train": 3, "test": 2, "radius": 3, "elevation": [10, 60]},
    "light": {"kind": "sun", "direction": [-1, -0.5, -2], "ambient": 0.4},
    "bodies": [SPHERE],
}


def ball_with(**fields):
    return {"bodies": [{**SPHERE, **fields}]}


MISTAKES = [
    ({"efects": []}, "scene: unknown field", "efects"),
    ({"effects": ["wind"]}, "scene: effects", "wind"),
    ({"resolution": [64]}, "scene: resolution", "shape [2]"),
    ({"resolution": [64, 6.5]}, "scene: resolution", "integers"),
    (
        {"light": {"kind": "sun", "direction": [0, 0, 0], "ambient": 0.1}},
        "scene: light.direction",
        "not zero",
    ),
    ({"light": {"kind": "lamp"}}, "scene: light.kind", "sun, point"),
    ({"light": {"direction": [0, 0, 1]}}, "scene: light.kind", "sun, point"),
    ({"bodies": []}, "scene: bodies", "at least one"),
    ({"bodies": {}}, "scene: bodies", "list"),
    ({"bodies": [SPHERE, SPHERE]}, "scene: bodies[1].name", "taken"),
    (ball_with(parent="box"), "scene: bodies[0].parent", "listed before"),
    (ball_with(color=[0, 0, 1.5]), "scene: bodies[0].color", "1.5]; expected numbers"),
    (ball_with(color=[0, 0, math.nan]), "scene: bodies[0].color", "nan"),
    (ball_with(position=[0, 0, math.inf]), "scene: bodies[0].position", "inf"),
    (ball_with(faces_camera=1), "scene: bodies[0].faces_camera", "a bool"),
    (ball_with(name=3), "scene: bodies[0].name", "a text"),
    (ball_with(shape={"kind": "sphere"}), "scene: bodies[0].shape.radius", "a number"),
    (ball_with(shape={"kind": "cone"}), "scene: bodies[0].shape.kind", "sphere, box, capsule"),
    (
        ball_with(shape={"kind": "capsule", "start": [0, 0, 0], "end": [0, 0, 0], "radius": 1}),
        "scene: bodies[0].shape.end",
        "another point",
    ),
    (
        ball_with(motion=[{"kind": "line", "by": [0, 0, 1], "height": 2}]),
        "scene: bodies[0].motion[0]",
        "unknown field ['height']",
    ),
    (
        ball_with(motion=[{"kind": "line", "by": [0, 0, 10**400]}]),
        "scene: bodies[0].motion[0].by",
        "1e+06",
    ),
    (ball_with(specular=3), "scene: bodies[0].specular", "expected a dict"),
]


@pytest.mark.parametrize("change, place, expected", MISTAKES, ids=[row[1] for row in MISTAKES])
def test_mistakes_in_a_description(change, place, expected, tmp_path):
    message = refuse([expected], simulate, {**SMALL, **change}, tmp_path / "out")
    assert message.startswith(place)
    assert list(tmp_path.iterdir()) == []


def test_mistakes_in_a_description_file(tmp_path):
    file = tmp_path / "scene.json"
    with pytest.raises(SceneError, match="scene.json: missing"):
        simulate(file, tmp_path / "out")
    with pytest.raises(OutputError, match="taken: expected a folder that can be written to"):
        out = tmp_path / "taken"
        out.write_text("")
        simulate(SMALL, out)
    file.write_text(json.dumps({**SMALL, "light": {"kind": "lamp"}}))
    with pytest.raises(
        SceneError, match=r"scene.json: light.kind: 'lamp'; expected one of sun, point"
    ):
        simulate(file, tmp_path / "out")


def test_a_description_in_order_is_drawn_from_a_file(tmp_path):
    (tmp_path / "scene.json").write_text(json.dumps(SMALL))
    simulate(tmp_path / "scene.json", tmp_path / "new" / "out")
    assert (tmp_path / "new" / "out" / "scene.json").read_text() == json.dumps(SMALL)
    assert len(load_scene(tmp_path / "new" / "out").train) == 3
