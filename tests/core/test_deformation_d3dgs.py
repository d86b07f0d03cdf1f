"""psi_d with D3DGS's time net and skip: its gradient, without both, in training and in a file."""

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.equations import deformation, deformation_d3dgs
from p4dgs_ref.lab.random_inputs import random_network
from p4dgs_ref.model import deformation_layers
from p4dgs_ref.table import Equation
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import Trainer
from tests.core.adjoint import check_adjoint
from tests.golden.cases import Case

L_X, L_T = 2, 3
HIDDEN = (9, 8, 6, 5)
EQUATION = Equation(
    "deformation_d3dgs",
    "5",
    "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), psi_t(E(t))))",
    "p4dgs_ref.equations.deformation_d3dgs",
    ("delta_x", "delta_s", "delta_r"),
    ("weights", "biases", "time_weights", "time_biases"),
)


def inputs(time_net, skip, seed=0):
    """Random inputs for five Gaussians; layers as `Design.layers` gives them."""
    rng = np.random.default_rng(seed)
    layers = deformation_layers(L_X, L_T, HIDDEN, (3, 3, 4), time_net, skip)
    drawn = {}
    for name in ("psi_d", "psi_t"):
        pairs = [random_network(rng, *pair) for pair in layers.get(name, [])]
        drawn[name] = [W for (W,), _ in pairs], [b for _, (b,) in pairs]
    return dict(
        x=rng.normal(size=(5, 3)),
        t=0.37,
        weights=drawn["psi_d"][0],
        biases=drawn["psi_d"][1],
        time_weights=drawn["psi_t"][0],
        time_biases=drawn["psi_t"][1],
        L_x=L_X,
        L_t=L_T,
    )


VARIANTS = pytest.mark.parametrize("time_net", [(), (7, 4)])
SKIPS = pytest.mark.parametrize("skip", [False, True])


@VARIANTS
@SKIPS
def test_gradients(time_net, skip):
    """The gradient of every array; x by itself, because E(x) is far from linear."""
    case = Case("ordinary", inputs(time_net, skip))
    check_adjoint(EQUATION, case, EQUATION)
    check_adjoint(EQUATION._replace(gradients=("x",)), case, EQUATION)


def test_without_both_it_is_eq_5():
    case = inputs((), False)
    ours, saved = deformation_d3dgs.forward(**case)
    cut = {name: case[name] for name in ("x", "t", "weights", "biases", "L_x", "L_t")}
    theirs, saved_5 = deformation.forward(**cut)
    bars = [np.random.default_rng(1).normal(size=a.shape) for a in ours]
    gradients = deformation_d3dgs.backward(saved, *bars)
    for name, wanted in deformation.backward(saved_5, *bars).items():
        pairs = [(gradients[name], wanted)] if name == "x" else zip(gradients[name], wanted)
        assert all(np.allclose(a, b, rtol=1e-10, atol=1e-12) for a, b in pairs), name
    assert all(np.allclose(a, b, rtol=1e-12, atol=1e-13) for a, b in zip(ours, theirs))
    lean = deformation_d3dgs.backward(saved, *bars, needs_x=False)
    assert "x" not in lean and np.array_equal(lean["weights"][0], gradients["weights"][0])


def test_training_and_file_carry_both():
    """Three layers as in the reference: the arrays of a short training come back from the bytes."""
    scene = p4.load_scene("bouncing", downscale=4)
    options = dict(deformation=(12, 11, 10), time_net=(9, 7), skip=True)
    trainer = Trainer(scene, SMOKE, design=design_of(SMOKE, scene.effects)._replace(**options))
    start, model = trainer.model(), trainer.run()
    for name in ("psi_d", "psi_t"):
        for before, after in zip(start.networks[name][0], model.networks[name][0]):
            assert not after.size or np.abs(after - before).max() > 0, name
    decoded = p4.decode(p4.encode(model))
    assert (decoded.design.time_net, decoded.design.skip) == ((9, 7), True)
    for name in ("psi_d", "psi_t"):
        for stored, trained in zip(decoded.networks[name][0], model.networks[name][0]):
            assert np.array_equal(stored, trained.astype(np.float16))
