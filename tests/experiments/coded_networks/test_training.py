"""Networks that pay for their bits: the equation and its gradient, scales, and the training."""

import math

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import choose
from tutorials.experiments.coded_networks import networks, training, weight_bits
from tutorials.experiments.coded_networks.file import decode, encode
from tutorials.experiments.coded_networks.networks import step_of_code
from tutorials.experiments.coded_networks.training import Trainer


def weights_in_steps(k, b):
    """Weights k steps of 1/4 from the mean, in densities of scale b."""
    k, b = np.broadcast_arrays(np.array(k, float), np.array(b, float))
    return 0.25 * k, np.full(k.shape, 0.25), b.copy()


def test_bits_by_hand():
    w, step, b = weights_in_steps([0, 2, -2, 0.5], 0.8)
    bits, _ = weight_bits.forward(w, step, b)
    at_two = 1.5 / 0.8 / math.log(2) + 1 - math.log2(1 - math.exp(-1 / 0.8))
    edge = 1 - math.log2(1 - math.exp(-1 / 0.8))
    np.testing.assert_allclose(bits, [-math.log2(1 - math.exp(-0.625)), at_two, at_two, edge])
    bits, _ = weight_bits.forward(*weights_in_steps(range(-300, 301), 9.0))
    assert (2.0**-bits).sum() == pytest.approx(1, abs=1e-12)  # a distribution over the integers


@pytest.mark.parametrize(
    "k, b",
    [
        ([0, 1, -1, 2, -7, 40], 1.3),
        ([50, -50, 1000, -3e4], [0.4, 0.4, 1, 3]),
        ([0.1, 0.25, -3, 1e6], [1e3, 1e5, 1e9, 1e12]),
        ([0.502, -0.498], [0.3, 0.02]),
    ],
)
def test_the_gradient_is_the_adjoint_of_the_derivative(k, b):
    """The sum of bits_bar times J v is that of J^T bits_bar times v, with J v by differences."""
    rng, (w, step, b) = np.random.default_rng(0), weights_in_steps(k, b)
    v_w, v_step, bits_bar = (rng.normal(size=w.shape) for _ in range(3))
    h = 1e-6
    ends = [weight_bits.forward(w + e * w * v_w, step + e * step * v_step, b)[0] for e in (h, -h)]
    _, saved = weight_bits.forward(w, step, b)
    bars = weight_bits.backward(saved, bits_bar)
    terms = bars["w"] * w * v_w + bars["step"] * step * v_step
    scale = np.abs(bits_bar) * (1 + np.abs(k))
    np.testing.assert_allclose(
        terms, bits_bar * (ends[0] - ends[1]) / (2 * h), atol=1e-7 * scale.max()
    )


def test_rounded_networks_carry_their_gradient_to_numbers_and_steps():
    """With the error of rounding held, a number is k + error steps: so are its slopes."""
    rng, arrays = np.random.default_rng(3), {"x_a": np.zeros((3, 3))}
    for i, (I, J) in enumerate([(3, 5), (5, 2), (2, 0)]):
        arrays[f"psi_c.W{i}"] = rng.laplace(size=(I, J))
        arrays[f"psi_c.b{i}"] = rng.normal(size=J)
    p = Parameters({**arrays, "log_step": rng.normal(size=6) - 2}, np.float64)
    layout = networks.Layout(p, ["psi_c"])
    rounded, _, back = networks.rounded_networks(p, layout)
    steps = networks.steps_of(p["log_step"])
    for i, W in enumerate(rounded["psi_c"][0]):
        np.testing.assert_array_equal(W, np.rint(p[f"psi_c.W{i}"] / steps[2 * i]) * steps[2 * i])
    gradients = p.zeros()
    bar = rng.normal(size=(3, 5))
    gradients["psi_c.W0"][...] = bar
    back(gradients, 0.0)
    np.testing.assert_array_equal(gradients["psi_c.W0"], bar)
    error = rounded["psi_c"][0][0] - p["psi_c.W0"]
    expected = [(bar * error).sum(), 0, 0, 0, 0, 0]
    np.testing.assert_allclose(gradients["log_step"], expected, atol=1e-12)
    gradients.vector[:] = 0
    back(gradients, 2.0)  # the bits alone: they grow with a number, and fall with its step
    step, k = steps[0], rounded["psi_c"][0][0].ravel() / steps[0]
    whole = networks.scales(layout.rounded.vector / steps[layout.tensor], layout)
    _, saved = weight_bits.forward(k * step, np.full(15, step), whole[:15])
    bars = weight_bits.backward(saved, np.full(15, 2.0))
    np.testing.assert_allclose(gradients["psi_c.W0"].ravel(), bars["w"])
    error = (rounded["psi_c"][0][0] - p["psi_c.W0"]).ravel()
    of_step = (bars["w"] * error + bars["step"] * step).sum()
    np.testing.assert_allclose(gradients["log_step"][0], of_step)


def test_scales_are_row_times_column_over_tensor():
    k = np.abs(np.random.default_rng(0).laplace(size=(3, 5)))
    p = Parameters({"psi_c.W0": k, "psi_c.b0": np.ones(5), "grid.0": np.zeros((4, 2))}, np.float64)
    layout = networks.Layout(p, ["psi_c"])
    m, n = k.mean(), 4
    row, column = ((k.sum(axis=1 - i) + n * m) / (k.shape[1 - i] + n) for i in (0, 1))
    expected = np.maximum(np.outer(row, column) / m, 0.4)
    found = networks.scales(p.vector[layout.part], layout)
    np.testing.assert_allclose(found, [*expected.ravel(), *np.ones(5)])
    assert np.all(networks.scales(0 * found, layout) == 0.4)


def test_training_learns_steps_in_stage_4_and_the_file_holds_them():
    scene, moved = p4.load_scene("bouncing", downscale=4), []
    trainer = Trainer(scene, choose("smoke", {"stage_ends": (2, 3, 5, 12)}), seed=3)
    while trainer.iteration < 12:
        before = trainer.parameters["log_step"].copy()
        trainer.step()
        moved.append(not np.array_equal(before, trainer.parameters["log_step"]))
    assert moved == [False] * 5 + [True] * 7
    model, decoded = trainer.model(), decode(encode(trainer.model()))
    assert decoded.position_bits == 10
    for name, pair in decoded.networks.items():
        for arrays, trained, codes in zip(pair, model.networks[name], model.steps[name]):
            for a, b, step in zip(arrays, trained, step_of_code(codes)):
                assert np.array_equal(a, np.rint(b / step) * step)


def test_the_price_of_networks_rises_to_that_of_anchors():
    scene, first = p4.load_scene("bouncing", downscale=8), 5  # iteration of stage 4
    trainer = Trainer(scene, choose("smoke", {"stage_ends": (2, 3, first, 3000)}), seed=3)
    trainer.iteration, state = first, trainer.rng.bit_generator.state

    def at(share):
        trainer.iteration = first + int(share * training.NETWORK_RAMP)
        trainer.rng.bit_generator.state = state
        losses, _, gradients, _ = trainer.gradients_of(scene.train[0])
        return losses.L_rate, gradients["psi_q.W0"].copy()

    (none, g_none), (half, g_half), (whole, g_whole), (later, _) = map(at, (0, 0.5, 1, 2))
    numbers = len(trainer.mask) * sum(trainer.design.widths)
    bits = networks.rounded_networks(trainer.parameters, trainer.layout)[1]
    assert whole - none == pytest.approx(bits / numbers, rel=1e-5) and later == whole
    assert half - none == pytest.approx((whole - none) / 2, rel=1e-4)
    most = np.abs(g_whole - g_none).max()
    assert most > 0
    np.testing.assert_allclose(g_half - g_none, (g_whole - g_none) / 2, atol=1e-2 * most)
