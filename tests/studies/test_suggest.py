"""What the pictures of a scene say about the effects in it."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.effects import MOTION
from p4dgs_ref.scenes import MODEL_EFFECTS, SIMULATOR_EFFECTS, Scene, load_scene, packaged_scenes
from p4dgs_ref.scenes.simulator import trace
from p4dgs_ref.scenes.simulator.description import describe
from p4dgs_ref.scenes.simulator.simulate import place_cameras
from p4dgs_ref.studies import suggest
from tests.core.effect_scenes import SEEN_BY, described


def suggested(scene):
    return {row["effect"]: row for row in suggest.suggest(scene)}


@pytest.mark.parametrize("name", packaged_scenes())
def test_suggestion_is_right_as_far_as_pictures_tell(name):
    """It keeps every effect that the scene lists, and says where it keeps one without evidence."""
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
    """A variation of the scene `static`, drawn anew, without a list of effects."""
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
    """A motion of two and a half pixels, a tenth of the size, a highlight, a turn: all are seen."""
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
