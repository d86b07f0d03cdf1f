"""Coded networks in training (B1): their bits, their scales, and when they begin."""

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.model import step_of_code
from p4dgs_ref.training import coded_networks
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import PRESETS, choose
from p4dgs_ref.training.trainer import Trainer

SHORT = dict(coded=True, network_ramp=4, lr_step=(0.02, 0.01), stage_ends=(2, 3, 5, 12))


def layout_of(shapes, rng):
    """Parameters with one network of these layers between other arrays, and their Layout."""
    arrays = {"x_a": np.zeros((3, 3))}
    for i, (I, J) in enumerate(shapes):
        arrays[f"psi_c.W{i}"] = rng.laplace(size=(I, J)) * rng.lognormal(size=J)
        arrays[f"psi_c.b{i}"] = rng.normal(size=J)
    arrays["grid.0"] = np.zeros((4, 2))
    p = Parameters(arrays, np.float64)
    return p, coded_networks.Layout(p, ["psi_c"])


def test_scales_are_row_times_column_over_tensor():
    p, layout = layout_of([(3, 5), (5, 2), (2, 0)], np.random.default_rng(0))
    n, floor = 4, 0.4
    expected = []
    for name in ("W0", "b0", "W1", "b1"):
        k = np.abs(p[f"psi_c.{name}"]).reshape(len(p[f"psi_c.{name}"]), -1)
        m = k.mean()
        for i in range(k.shape[0]):
            for j in range(k.shape[1]):
                row = (k[i].sum() + n * m) / (len(k[i]) + n)
                column = (k[:, j].sum() + n * m) / (len(k) + n)
                expected.append(max(row * column / m, floor))
    found = coded_networks.scales(p.vector[layout.part], layout)
    assert found == pytest.approx(np.array(expected), rel=1e-12)
    assert np.all(coded_networks.scales(0 * found, layout) == floor)


def test_networks_are_coded_from_stage_4_on_at_a_rising_price():
    trainer = Trainer(p4.load_scene("bouncing", downscale=4), choose("smoke", SHORT), seed=1)
    prices, moved = [], []
    while trainer.iteration < 12:
        fixed, before = trainer.fixed(), trainer.parameters["log_step"].copy()
        assert (fixed.coded is not None) == (trainer.iteration >= 5)
        prices.append(fixed.network_price if fixed.coded else None)
        trainer.step()
        moved.append(not np.array_equal(before, trainer.parameters["log_step"]))
    assert prices == [None] * 5 + [0, 0.25, 0.5, 0.75, 1, 1, 1]
    assert moved == [False] * 5 + [True] * 7
    codes = trainer.model().steps["psi_c"]
    steps = np.exp(trainer.parameters["log_step"])
    assert np.abs(np.log(step_of_code(codes[0][0]) / steps)).min() < 0.04


def test_only_the_coded_presets_have_steps():
    assert not any(p.coded for name, p in PRESETS.items() if name.startswith("paper"))
    trainer = Trainer(p4.load_scene("bouncing", downscale=4), choose("smoke"), seed=1)
    assert "log_step" not in trainer.parameters.arrays and trainer.layout is None
    assert trainer.model().steps is None and trainer.fixed().coded is None
