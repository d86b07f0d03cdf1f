"""Coded networks in training (B1): their bits, their scales, and when they begin."""

from functools import partial

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.beyond import networks, trainer
from p4dgs_ref.beyond.networks import step_of_code
from p4dgs_ref.designs import choose, trainer_of
from p4dgs_ref.training.parameters import Parameters
from tests.training.whole_gradient import SMALL, check, setting

SHORT = dict(is_coded=True, network_ramp=4, lr_step=(0.02, 0.01), stage_ends=(2, 3, 5, 12))


def layout_of(shapes, rng):
    """Parameters with one network of these layers between other arrays, and their Layout."""
    arrays = {"x_a": np.zeros((3, 3))}
    for i, (I, J) in enumerate(shapes):
        arrays[f"psi_c.W{i}"] = rng.laplace(size=(I, J)) * rng.lognormal(size=J)
        arrays[f"psi_c.b{i}"] = rng.normal(size=J)
    arrays["grid.0"] = np.zeros((4, 2))
    p = Parameters(arrays, np.float64)
    return p, networks.Layout(p, ["psi_c"])


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
    found = networks.scales(p.vector[layout.part], layout)
    assert found == pytest.approx(np.array(expected), rel=1e-12)
    assert np.all(networks.scales(0 * found, layout) == floor)


def test_networks_are_coded_from_stage_4_on_at_a_rising_price(monkeypatch):
    scene, prices, moved, real = p4.load_scene("bouncing", downscale=4), [], [], trainer.loss
    run = trainer_of(scene, choose("smoke", SHORT), seed=1)

    def loss(layout, price, *inputs):
        prices[-1] = price
        return real(layout, price, *inputs)

    monkeypatch.setattr(trainer, "loss", loss)
    while run.iteration < 12:
        before = run.parameters["log_step"].copy()
        prices.append(None)
        run.step()
        moved.append(not np.array_equal(before, run.parameters["log_step"]))
    assert prices == [None] * 5 + [0, 0.25, 0.5, 0.75, 1, 1, 1]
    assert moved == [False] * 5 + [True] * 7
    codes = run.model().steps["psi_c"]
    steps = np.exp(run.parameters["log_step"])
    assert np.abs(np.log(step_of_code(codes[0][0]) / steps)).min() < 0.04


def test_every_array_with_coded_networks(monkeypatch):
    """The errors of rounding are held, as straight-through assumes."""
    p, design, *others = setting(preset=choose(SMALL, {"is_coded": True}), kind=trainer, seed=2)
    layout, log_step = networks.Layout(p, design.layers()), p["log_step"].copy()
    loss = partial(trainer.loss, layout, 0.3)
    networks.rounded_networks(p, layout)
    steps = networks.steps_of(log_step)
    step, w = steps[layout.tensor], p.vector[layout.part]
    b = networks.scales(layout.rounded.vector / step, layout)
    error = np.rint(w / step) - w / step
    held = {  # scales carry no gradient, and steps move off their lattice
        (networks, "scales"): lambda k, layout: b,
        (networks, "steps_of"): lambda moved: steps * np.exp(moved - log_step),
        (np, "rint"): lambda k: k + error,
    }
    names = check(p, design, *others, monkeypatch=monkeypatch, loss=loss, held=held)
    assert set(names) == set(p.arrays)
