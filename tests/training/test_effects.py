"""An effect that is off is absent from the model and equals its neutral input.

Absent means: no call, no parameter, no state of the optimiser, no byte in the file.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from p4dgs_ref.codec.container import read_container
from p4dgs_ref.effects import MOTION
from p4dgs_ref.model import Anchors, predict
from p4dgs_ref.scenes import MODEL_EFFECTS
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import EXACT, FAST
from p4dgs_ref.training.initial import design_of, initial_parameters
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import SMOKE
from tests.equations.adjoint import close
from tests.sampling import few
from tests.training.effect_scenes import (
    EPS,
    SCENES,
    SEEN_BY,
    SHORT,
    listed,
    small_camera,
    small_scene,
    trained,
)


# --- what is off is absent ---
def weights_of(arrays, effect, d):
    """How many of the numbers in named arrays only this effect needs."""
    if effect in MOTION:
        trunk, head = len(SHORT.deformation), MOTION.index(effect)
        return sum(
            arrays[f"psi_d.{kind}{trunk + head}"].size
            for kind in "Wb"
            if f"psi_d.W{trunk}" in arrays
        )
    return sum(
        (len(arrays[f"{net}.W0"]) - d) * arrays[f"{net}.W0"].shape[1]
        for net in SEEN_BY.get(effect, ())
    )


@pytest.mark.parametrize("name, effect", few([*product(SCENES, MODEL_EFFECTS)], 4))
def test_off_is_absent_and_on_is_there(name, effect):
    for on in (False, True):
        trainer, data, calls = trained(name, effect, on)
        design, owns = trainer.design, effect in MOTION or effect in SEEN_BY
        for group in (trainer.parameters, trainer.adam.first, trainer.adam.second):
            assert (weights_of(group.arrays, effect, design.d) > 0) == (on and owns)
        assert set(trainer.adam.steps) == set(trainer.parameters.arrays)
        moves, sees = (bool(set(some) & set(design.effects)) for some in (MOTION, SEEN_BY))
        has_section = "deformation_mlp" in read_container(data)
        assert has_section == moves == any(n.startswith("psi_d") for n in trainer.networks)
        needs = {
            "deformation": moves,
            "deformed": moves,
            "positional_encoding": moves,
            "view": sees,
        }
        for key, needed in needs.items():
            assert (calls[key, "forward"] > 0) == needed, key
        for key in ("deformation", "deformed", "view"):
            assert calls[key, "forward"] == calls[key, "backward"], key
        assert any(trainer.scene.background) == ("background" in design.effects)


# --- off equals the neutral input ---
def random_build(effects, seed):
    """Random parameters in float64 in which every network contributes."""
    preset = replace(SMOKE, anchors=9, deformation_gain=1.0, feature_std=0.7, extent=0.6)
    design, rng = design_of(preset, effects), np.random.default_rng(seed)
    p = Parameters(initial_parameters(preset, design, rng).arrays, np.float64)
    p["O_a"][...] = rng.normal(size=p["O_a"].shape) * 0.5
    return design, p


def neutral(p, design, effect):
    """The same model with the effect and its neutral input.

    Heads of psi_d are zero, and so are the rows of networks that read the view.
    """
    arrays, rng = dict(p.arrays), np.random.default_rng(7)
    for net, layers in design.layers().items():
        for i, (rows, columns) in enumerate(layers):
            W, b = (arrays.get(f"{net}.{kind}{i}") for kind in "Wb")
            if W is None:  # the first effect of motion needs a trunk, which zero heads silence
                silent = i >= len(layers) - 3
                W, b = (
                    (0 if silent else 1) * rng.normal(size=(rows, columns)),
                    (not silent) * rng.normal(size=columns),
                )
            elif W.shape != (rows, columns):
                W = np.pad(W, [(0, rows - len(W)), (0, columns - W.shape[1])])
                b = np.pad(b, (0, columns - len(b)))
            arrays[f"{net}.W{i}"], arrays[f"{net}.b{i}"] = W, b
    return Parameters(arrays, np.float64)


def picture_and_gradients(p, design, view, background, bar):
    """The image, the gradients {name: gradient} for its cotangent, and the Gaussians."""
    networks = {name: p.network(name) for name in design.layers()}
    anchors = Anchors(
        p["x_a"],
        p["f_a"],
        np.exp(p["log_s"]),
        np.exp(p["log_l"]),
        p["O_a"],
        np.ones(p["O_a"].shape[:2], bool),
    )
    g, _, back = predict(design, networks, anchors, view.camera.center, view.time)
    (image, _, _), res = render.forward(
        g.x,
        g.s,
        g.r,
        g.alpha,
        g.color,
        small_camera(view.camera),
        background,
        EXACT,
        "occlusion" in design.effects,
    )
    bars = render.backward(res, bar)
    rows, nets = back(*(bars[key] for key in ("x", "s", "r", "alpha", "color")))
    gradients = {name: rows[name] for name in ("x_a", "f_a", "s_a", "l_a", "O_a")}
    for net, of_net in nets.items():
        for kind, key in (("W", "weights"), ("b", "biases")):
            gradients |= {f"{net}.{kind}{i}": a for i, a in enumerate(of_net[key])}
    return image, gradients, g


@pytest.mark.parametrize("name, effect", few([*product(SCENES, (*MOTION, *SEEN_BY))], 5))
def test_off_equals_the_neutral_input(name, effect):
    scene = small_scene(name)
    view = scene.train[5 + MODEL_EFFECTS.index(effect)]
    design, p = random_build(listed(scene.effects, effect, False), seed=len(name))
    full = replace(design, effects=listed(scene.effects, effect, True))
    camera = small_camera(view.camera)
    bar = np.random.default_rng(3).normal(size=(camera.height, camera.width, 3))
    off, ours, g = picture_and_gradients(p, design, view, scene.background, bar)
    on, theirs, _ = picture_and_gradients(
        neutral(p, full, effect), full, view, scene.background, bar
    )
    assert len(g.alpha) > 5 and np.ptp(off) > 0.1
    assert np.abs(off - on).max() <= 4 * EPS * (1 + np.abs(off).max())
    for key, value in ours.items():
        other = theirs[key][tuple(slice(n) for n in value.shape)]
        close(value, other, 1e-12, key)
        assert value.size == 0 or value.any() or key.startswith("psi_d"), key


@pytest.mark.parametrize(
    "settings", (EXACT, FAST._replace(dtype="float64", cut=1e-14)), ids=lambda s: s.name
)
@pytest.mark.parametrize("name", ["bouncing", "orientation"])
def test_without_occlusion_every_gaussian_is_as_if_alone(name, settings):
    """Without occlusion a picture over black is the sum of the pictures of single Gaussians."""
    scene, rng = small_scene(name), np.random.default_rng(11)
    camera, black = small_camera(scene.train[3].camera), np.zeros(3)
    n = 7
    r = rng.normal(size=(n, 4))
    splats = dict(
        x=rng.uniform(-0.5, 0.5, (n, 3)),
        s=rng.uniform(0.1, 0.4, (n, 3)),
        r=r / np.linalg.norm(r, axis=1, keepdims=True),
        alpha=rng.uniform(0.2, 0.9, n),
        color=rng.uniform(size=(n, 3)),
    )
    bar = rng.normal(size=(camera.height, camera.width, 3))

    def run(rows, occlusion):
        (image, _, _), saved = render.forward(
            **{key: a[rows] for key, a in splats.items()},
            camera=camera,
            background=black,
            settings=settings,
            occlusion=occlusion,
        )
        return image, render.backward(saved, bar)

    off, ours = run(slice(None), False)
    alone = [run([i], True) for i in range(n)]
    assert np.abs(off - sum(image for image, _ in alone)).max() <= 4 * EPS * max(off.max(), 1)
    for key in ("mean2d", *splats):
        close(ours[key], np.concatenate([bars[key] for _, bars in alone]), 1e-12, key)
    close(ours["background"], bar.sum(axis=(0, 1)), 1e-12, "background")
    both = run(slice(None), True)[0]
    assert np.abs(both - off).max() > 0.01, "the Gaussians must overlap, or nothing is tested"
