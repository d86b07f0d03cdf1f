"""psi_d with D3DGS's time net and skip: without both, in training and in a file."""

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref.equations import deformation, deformation_d3dgs
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import Trainer
from tests.lab.baselines.cases.deformation_d3dgs import inputs


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
