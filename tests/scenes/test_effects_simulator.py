"""An effect that is off is absent from the simulator and equals its neutral input."""

from itertools import product

import numpy as np
import pytest

from p4dgs_ref.effects import MOTION
from p4dgs_ref.scenes.simulator import bodies, place_cameras, trace
from p4dgs_ref.scenes.simulator.description import read_description
from tests.sampling import few
from tests.training.effect_scenes import EPS, SCENES, described, simulated_effects, small_camera

STILL = {
    "line": {"by": [0, 0, 0]},
    "bounce": {"height": 0},
    "arc": {"degrees": 0},
    "swing": {"degrees": 0},
    "spin": {"degrees": 0},
    "pulse": {"amount": 0},
}
# the functions that draw an effect and nothing else: (place, name)
CODE = {
    "translation": [(bodies.MOTIONS, kind) for kind in ("line", "bounce", "arc")],
    "rotation": [(bodies.MOTIONS, kind) for kind in ("swing", "spin")],
    "scaling": [(bodies.MOTIONS, "pulse")],
    "occlusion": [(trace, "nearest")],
    "texture": [(bodies.TEXTURES, kind) for kind in ("checker", "stripes")],
    "diffuse": [(trace, "diffuse")],
    "specular": [(trace, "specular")],
}


def with_neutral_input(data, effect):
    """The description with the effect's amplitude at zero."""
    changed = []
    for body in data["bodies"]:
        body = dict(body)
        if effect in MOTION:
            body["motion"] = [
                {**m, **STILL[m["kind"]]} if bodies.MOTIONS[m["kind"]][0] == effect else m
                for m in body.get("motion", ())
            ]
        elif effect == "texture" and "texture" in body:
            body["texture"] = {**body["texture"], "color": body["color"]}
        elif effect == "specular" and "specular" in body:
            body["specular"] = {**body["specular"], "strength": 0}
        changed.append(body)
    light = {**data["light"], "ambient": 1} if effect == "diffuse" else data["light"]
    return {**data, "bodies": changed, "light": light}


def drawn(data, t=0.37, view=4):
    description = read_description(data)
    camera = place_cameras(description, "train")[view][0]
    return trace.trace(description, small_camera(camera, 14), t)


NEUTRAL = (*MOTION, "texture", "diffuse", "specular")


@pytest.mark.parametrize("name, effect", few(product(SCENES, NEUTRAL), 8))
def test_simulator_off_equals_the_neutral_input(name, effect):
    some = [e for e in simulated_effects(name) if e != effect]
    off, data = drawn(described(name, some)), described(name, [*some, effect])
    on = drawn(with_neutral_input(data, effect))
    assert np.abs(off - on).max() <= 4 * EPS
    uses = {
        "texture": any("texture" in b for b in data["bodies"]),
        "diffuse": True,
        "specular": any("specular" in b for b in data["bodies"]),
        **{
            e: any(
                bodies.MOTIONS[m["kind"]][0] == e
                for b in data["bodies"]
                for m in b.get("motion", ())
            )
            for e in MOTION
        },
    }[effect]
    assert (np.abs(drawn(data) - off).max() > 1e-3) == uses


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


@pytest.mark.parametrize("name, effect", few(product(SCENES, CODE), 8))
def test_simulator_does_not_call_what_is_off(name, effect, monkeypatch):
    calls = []

    def noted(function):
        return lambda *args: calls.append(function) or function(*args)

    for place, key in CODE[effect]:
        if isinstance(place, dict):
            entry = place[key]
            of_motion = isinstance(entry, tuple)
            watched = (effect, noted(entry[1])) if of_motion else noted(entry)
            monkeypatch.setitem(place, key, watched)
        else:
            monkeypatch.setattr(place, key, noted(getattr(place, key)))
    some = [e for e in simulated_effects(name) if e != effect]
    drawn(described(name, some))
    assert not calls
    drawn(described(name, [*some, effect]))
    assert bool(calls) == (
        effect in simulated_effects(name)
        or effect == "diffuse"
        or effect == "specular"
        and name in ("bouncing", "orbit", "glossy")
    )
