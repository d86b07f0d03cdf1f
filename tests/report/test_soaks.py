"""Trainings from hard starts end finite, with a file that decodes to the quantised model."""

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer
from tests.sampling import few

EYES = ((1.5, -2.5, 1.0), (-0.4, 2.8, 0.6), (2.4, 1.1, -0.5))


def scene(images=None, times=(0.0, 0.5, 1.0), size=(9, 7), effects=None):
    """A scene of three views of a shaded ball, or of the given images."""
    width, height = size
    cameras = [
        look_at(eye, (0, 0, 0), 1.1 * width, 1.1 * width, width, height)
        for eye in EYES[: len(times)]
    ]
    y, x = np.mgrid[:height, :width]
    inside = np.clip(
        1 - ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (0.3 * height) ** 2, 0, 1
    )[:, :, None]
    ball = [1 - inside * (1 - np.array([0.9, 0.3, 0.2 + 0.2 * i])) for i in range(len(times))]
    return p4.Scene.from_arrays(images or ball, cameras, times, effects=effects)


def painted(value, n=3):
    return scene([np.full((7, 9, 3), value)] * n)


def put(name, values):
    """A change of a trainer that sets every row of a parameter."""

    def change(trainer):
        trainer.parameters[name][...] = values

    return change


def bias(network, value):
    def change(trainer):
        last = max(name for name in trainer.parameters.arrays if name.startswith(f"{network}.b"))
        trainer.parameters[last][...] = value

    return change


def masked(trainer):
    trainer.mask[...] = False


STARTS = {
    "anchor_on_the_camera": (
        scene(),
        dict(lr_x=(0.0, 0.0)),
        None,
        np.array([EYES[0], (0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.3)]),
    ),
    "all_transparent": (scene(), {}, bias("psi_alpha", -20.0), None),
    "all_masked": (scene(), {}, masked, None),
    "one_anchor": (scene(), {}, None, np.zeros((1, 3))),
    "a_thousand_coincident_anchors": (
        scene(),
        {},
        put("x_a", 0.25),
        np.random.default_rng(0).uniform(-1, 1, (1000, 3)),
    ),
    "zero_scales": (scene(), {}, put("log_s", -60.0), None),
    "huge_scales": (scene(), {}, put("log_s", 12.0), None),
    "behind_every_camera": (scene(), {}, put("x_a", np.array([0.0, -900, 0])), None),
    "lambda_rate_0": (scene(), dict(lambda_rate=0.0), None, None),
    "single_frame": (scene(times=(0.0,)), {}, None, None),
    "black": (painted(0.0), {}, None, None),
    "no_quaternion": (scene(), dict(upright=False), bias("psi_r", 0.0), None),
}


@pytest.mark.parametrize("name", few(STARTS, 5))
def test_a_hard_start_ends_finite_with_a_file(name):
    """From the first step to the decoded picture, NumPy's overflows and NaNs are errors."""
    data, changes, spoil, points = STARTS[name]
    trainer = Trainer(data, choose("smoke", changes), 3, points=points)
    if spoil:
        spoil(trainer)
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        while trainer.iteration < trainer.preset.iterations:
            check(trainer.step()[0])
        model = trainer.model()
        assert np.isfinite(trainer.parameters.vector).all() and trainer.iteration == 45
        decoded = decode(encode(model))
        assert all(map(np.array_equal, decoded.anchors, quantise(model).model.anchors))
        view = data.train[0]
        image = decoded.render(view.camera, view.time)
    assert image.shape == view.image.shape and np.isfinite(image).all()


def check(losses):
    assert all(np.isfinite(v) for v in losses)
