"""Off means absent in the simulator too; and what the pictures that it draws say about the effects in them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.effects import MOTION
from p4dgs_ref.scenes import MODEL_EFFECTS, SIMULATOR_EFFECTS, Scene, load_scene
from p4dgs_ref.scenes.simulator import motion, trace
from p4dgs_ref.scenes.dnerf import packaged_folder
from p4dgs_ref.scenes.simulator.description import describe
from p4dgs_ref.scenes.simulator.simulate import place_cameras
from p4dgs_ref.studies import suggest
from tests.core.test_effects import EPS, SCENES, SEEN_BY, small_camera

STILL = {
    "line": {"by": [0, 0, 0]},
    "bounce": {"height": 0},
    "arc": {"degrees": 0},
    "swing": {"degrees": 0},
    "spin": {"degrees": 0},
    "pulse": {"amount": 0},
}
# what takes part in drawing an effect, and nothing else: (place, name)
CODE = {
    "translation": [(motion.MOTIONS, kind) for kind in ("line", "bounce", "arc")],
    "rotation": [(motion.MOTIONS, kind) for kind in ("swing", "spin")],
    "scaling": [(motion.MOTIONS, "pulse")],
    "view_geometry": [(motion, "facing")],
    "occlusion": [(trace, "nearest")],
    "texture": [(trace, "textured")],
    "diffuse": [(trace, "diffuse")],
    "specular": [(trace, "specular")],
}


def described(name, effects):
    data = json.loads((packaged_folder() / name / "scene.json").read_text())
    return {**data, "effects": list(effects)}


def simulated_effects(name):
    return json.loads((packaged_folder() / name / "scene.json").read_text())["effects"]


def with_neutral_input(data, effect):
    """The description with the effect's amplitude at zero."""
    bodies = []
    for body in data["bodies"]:
        body = dict(body)
        if effect in MOTION:
            body["motion"] = [
                {**m, **STILL[m["kind"]]} if motion.MOTIONS[m["kind"]][0] == effect else m
                for m in body.get("motion", ())
            ]
        elif effect == "texture" and "texture" in body:
            body["texture"] = {**body["texture"], "color": body["color"]}
        elif effect == "specular" and "specular" in body:
            body["specular"] = {**body["specular"], "strength": 0}
        elif effect == "view_geometry":
            body["faces_camera"] = False
        bodies.append(body)
    light = {**data["light"], "ambient": 1} if effect == "diffuse" else data["light"]
    return {**data, "bodies": bodies, "light": light}


def facing_bodies(data):
    """No packaged scene has a body that turns to the viewer; give the first one that ability, used or not."""
    return {**data, "bodies": [{**data["bodies"][0], "faces_camera": True}, *data["bodies"][1:]]}


def drawn(data, t=0.37, view=4):
    description = describe(data)
    camera = place_cameras(description, "train")[view][0]
    return trace.trace(description, small_camera(camera, 20), t)


@pytest.mark.parametrize(
    "effect", [e for e in SIMULATOR_EFFECTS if e not in ("view_color", "occlusion", "background")]
)
@pytest.mark.parametrize("name", SCENES)
def test_simulator_off_equals_the_neutral_input(name, effect):
    some = [e for e in simulated_effects(name) if e != effect]
    off, data = (
        drawn(facing_bodies(described(name, some))),
        facing_bodies(described(name, [*some, effect])),
    )
    on = drawn(with_neutral_input(data, effect))
    assert np.abs(off - on).max() <= 4 * EPS
    uses = {
        "texture": any("texture" in b for b in data["bodies"]),
        "diffuse": True,
        "view_geometry": True,
        "specular": any("specular" in b for b in data["bodies"]),
        **{
            e: any(
                motion.MOTIONS[m["kind"]][0] == e
                for b in data["bodies"]
                for m in b.get("motion", ())
            )
            for e in MOTION
        },
    }[effect]
    assert (np.abs(drawn(data) - off).max() > 1e-3) == uses


@pytest.mark.parametrize("name", SCENES)
def test_simulator_view_color_off_equals_a_viewer_straight_above(name, monkeypatch):
    shiny = {**described(name, {*simulated_effects(name), "specular"} - {"view_color"})}
    shiny["bodies"] = [
        {**body, "specular": {"strength": 0.5, "exponent": 3}} for body in shiny["bodies"]
    ]
    off = drawn(shiny)
    real, lit = trace.shade, {**shiny, "effects": [*shiny["effects"], "view_color"]}
    assert np.abs(drawn(lit) - off).max() > 1e-3
    monkeypatch.setattr(
        trace,
        "shade",
        lambda body, pose, x, viewer, light, effects: real(
            body, pose, x, x + trace.UP, light, effects
        ),
    )
    # x + UP - x loses digits of x: the direction is off by an ulp or two of x, and the lobe's slope is 0.5 * 3
    assert np.abs(drawn(lit) - off).max() <= 4 * EPS * (1 + 0.5 * 3)


@pytest.mark.parametrize("name", SCENES)
def test_simulator_occlusion_off_adds_what_each_body_alone_shows(name):
    description = describe(described(name, simulated_effects(name)))
    camera = small_camera(place_cameras(description, "train")[4][0], 20)
    rays, where = (
        trace.rays(camera),
        motion.poses(description.bodies, description.effects, 0.37, camera.center),
    )
    hits = [trace.hit(body, where[body.name], camera.center, rays) for body in description.bodies]

    def light(i, chosen):
        return np.random.default_rng(i).uniform(size=(len(rays), 3))[chosen]

    off, nothing = trace.sum_up(hits, light, len(rays)), np.full(len(rays), np.inf)
    alone = [
        trace.nearest([h if i == j else nothing for j, h in enumerate(hits)], light, len(rays))
        for i in range(len(hits))
    ]
    assert np.array_equal(off, sum(alone))
    assert not np.array_equal(off, trace.nearest(hits, light, len(rays))) or len(hits) == 1


@pytest.mark.parametrize("name", SCENES)
def test_simulator_background_off_is_black_and_not_asked_for(name, monkeypatch):
    some = [e for e in simulated_effects(name) if e != "background"]
    on = drawn(described(name, [*some, "background"]))
    covered, real = [], trace.develop
    monkeypatch.setattr(
        trace, "develop", lambda color, hit, camera: covered.append(hit) or real(color, hit, camera)
    )
    off = drawn(described(name, some))
    assert covered == [None] and np.all(off[..., 3] == 1)
    assert np.abs(off[..., :3] - on[..., :3] * on[..., 3:]).max() <= 4 * EPS


@pytest.mark.parametrize("effect", CODE)
@pytest.mark.parametrize("name", SCENES)
def test_simulator_does_not_call_what_is_off(name, effect, monkeypatch):
    calls = []

    def noted(function):
        return lambda *args: calls.append(function) or function(*args)

    for place, key in CODE[effect]:
        if isinstance(place, dict):
            monkeypatch.setitem(place, key, (effect, noted(place[key][1])))
        else:
            monkeypatch.setattr(place, key, noted(getattr(place, key)))
    some = [e for e in simulated_effects(name) if e != effect]
    drawn(facing_bodies(described(name, some)))
    assert not calls
    drawn(facing_bodies(described(name, [*some, effect])))
    assert bool(calls) == (
        effect in simulated_effects(name)
        or effect in ("diffuse", "view_geometry")
        or effect == "specular"
        and name in ("bouncing", "orbit", "glossy")
    )


# --- what the pictures say ----------------------------------------------------------------------------------------
def suggested(scene):
    return {row["effect"]: row for row in suggest.suggest(scene)}


@pytest.mark.parametrize("name", SCENES)
def test_suggestion_is_right_as_far_as_pictures_tell(name):
    """It never drops an effect that the scene lists, and what it adds it says that it merely keeps."""
    scene = load_scene(name)
    rows = suggested(scene)
    assert tuple(rows) == MODEL_EFFECTS
    moves = bool(set(MOTION) & set(scene.effects))
    assert all(rows[e]["called_for"] == moves for e in MOTION)
    for effect, row in rows.items():
        assert any(c.isdigit() for c in row["evidence"]) and "\n" not in row["evidence"]
        assert row["called_for"] or effect not in scene.effects, (effect, row["evidence"])
        if row["called_for"] and effect not in scene.effects:
            assert (
                "kept" in row["evidence"] or effect in MOTION and "cannot tell" in row["evidence"]
            ), row
    if not moves:
        assert {e for e, row in rows.items() if row["called_for"]} == set(scene.effects)


def still(**changes):
    """A variation of `static`, drawn anew: what it shows is known, and a list is not."""
    description = describe({**described("static", SIMULATOR_EFFECTS), **changes})
    posed = place_cameras(description, "train")
    return Scene.from_arrays(
        [np.rint(trace.trace(description, c, t) * 255).astype(np.uint8) for c, t in posed],
        [c for c, _ in posed],
        [t for _, t in posed],
    )


def bodies(**changes):
    return [{**body, **changes} for body in described("static", ())["bodies"]]


@pytest.mark.parametrize(
    "changes, effects",
    [
        ({}, set()),
        ({"bodies": bodies(specular={"strength": 0.7, "exponent": 6})}, {*MOTION, "view_color"}),
        (
            {"bodies": bodies(motion=[{"kind": "spin", "axis": [0, 0, 1], "degrees": 180}])},
            {*MOTION, *SEEN_BY},
        ),
        ({"bodies": bodies(motion=[{"kind": "line", "by": [0.1, 0, 0]}])}, {*MOTION, *SEEN_BY}),
        ({"bodies": bodies(motion=[{"kind": "pulse", "amount": 0.1}])}, {*MOTION, *SEEN_BY}),
        ({"bodies": bodies(faces_camera=True)}, {*MOTION, *SEEN_BY}),
    ],
)
def test_suggestion_on_variations_of_a_still_scene(changes, effects):
    """Two and a half pixels of motion, a tenth of the size, a highlight, a turn: each is seen."""
    rows = suggested(still(**changes))
    assert {e for e, row in rows.items() if row["called_for"]} == effects | {
        "occlusion",
        "background",
    }


def test_suggestion_at_one_time_and_without_alpha():
    scene = load_scene("bouncing")
    frozen = replace(scene, train=[replace(view, time=0.5) for view in scene.train])
    rows = suggested(frozen)
    assert (
        not any(rows[e]["called_for"] for e in MOTION) and "0.5" in rows["translation"]["evidence"]
    )
    assert rows["view_geometry"]["called_for"] and "kept" not in rows["view_geometry"]["evidence"]
    plain = replace(
        load_scene("static"),
        train=[replace(view, alpha=None) for view in load_scene("static").train],
    )
    assert not any(suggested(plain)[e]["called_for"] for e in (*MOTION, *SEEN_BY))
    filled = [
        replace(view, alpha=None, image=np.full_like(view.image, 0.5)) for view in scene.train
    ]
    rows = suggested(replace(scene, train=filled))
    assert (
        all("kept" in rows[e]["evidence"] for e in (*MOTION, *SEEN_BY))
        and not rows["background"]["called_for"]
    )
    black = replace(scene, effects=("occlusion",))
    assert not suggested(black)["background"]["called_for"]
