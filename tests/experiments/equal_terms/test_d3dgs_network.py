"""psi_d with D3DGS's time net and skip: without both, and in a training of anchors."""

from types import SimpleNamespace

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref.equations import deformation
from p4dgs_ref.lab.baselines import d3dgs_network, deformation_d3dgs
from p4dgs_ref.lab.tables.methods import load_plain, save_plain
from p4dgs_ref.training import initial
from p4dgs_ref.training.presets import SMOKE
from tests.lab.baselines.cases.deformation_d3dgs import inputs
from tests.training.whole_gradient import check, setting


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


def test_training_and_file_carry_both(tmp_path):
    """Three layers as in the reference: the arrays of a short training come back from the bytes."""
    scene = p4.load_scene("bouncing", downscale=4)
    network = dict(deformation=(12, 11, 10), time_net=(9, 7), skip=True)
    trainer = d3dgs_network.Trainer(scene, SMOKE, 0, network)
    start, model = trainer.model(), trainer.run()
    for name in ("psi_d", "psi_t"):
        for before, after in zip(start.networks[name][0], model.networks[name][0]):
            assert not after.size or np.abs(after - before).max() > 0, name
    save_plain(model, tmp_path / "plain.npy")
    loaded = load_plain(tmp_path / "plain.npy")
    assert (loaded.design.time_net, loaded.design.skip) == ((9, 7), True)
    view = scene.test[0]
    images = [m.render(view.camera, view.time) for m in (model, loaded)]
    assert np.abs(images[1] - images[0]).max() < 1e-3
    still = model.render(view.camera, 0.0)
    assert np.abs(images[0] - still).max() > 0


def test_every_array_has_its_gradient(monkeypatch):
    network = dict(deformation=(9, 8, 7), time_net=(6, 4), skip=True)

    def design_of(preset, effects):
        return d3dgs_network.Design(**{**vars(initial.design_of(preset, effects)), **network})

    kind = SimpleNamespace(design_of=design_of, initial_parameters=initial.initial_parameters)
    p, design, step_inputs, *others = setting(kind=kind)
    step_inputs = step_inputs._replace(move=d3dgs_network.move)
    names = check(p, design, step_inputs, *others, monkeypatch=monkeypatch)
    assert set(names) == set(p.arrays) and "psi_t.W0" in names
