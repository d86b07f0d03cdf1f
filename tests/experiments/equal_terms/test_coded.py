"""The simple codec in which every method is stored alike."""

import dataclasses

import numpy as np
import pytest

from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import Trainer
from tutorials.experiments import baselines
from tutorials.experiments.coded_networks.networks import step_of_code
from tutorials.experiments.equal_terms import coded, coded_anchors, half

from ..baselines.small import MODULES, SMALL

LOSS = 1e-4


@pytest.fixture(scope="module")
def models(scene):
    """A model of each method after its training."""
    found = {name: MODULES[name].Trainer(scene, SMALL[name], seed=1).run() for name in MODULES}
    return {**found, "anchors": Trainer(scene, SMOKE).run()}


@pytest.fixture(scope="module", params=[*MODULES, "anchors"])
def files(request, scene, models):
    """A model, its form for the codec, its sensitivity, its file, and the model in that file."""
    model = models[request.param]
    form, codec = model, coded
    if request.param == "anchors":
        form, codec = coded_anchors.OfAnchors(model), coded_anchors
    H = coded.sensitivity(form, scene.train[::4], np.random.default_rng(0))
    data, sizes = codec.encode(model, H, LOSS)
    decoded = codec.decode(data)
    again = decoded if codec is coded_anchors else baselines.model_of(*decoded)
    return model, form, H, (data, sizes, codec), again


def test_every_number_comes_back_within_half_its_step(files):
    """Also positions, and the networks that draw, of both sides; the order is that of the file."""
    _, form, H, _, again = files
    other = coded_anchors.OfAnchors(again) if form is not files[0] else again
    p, q, box = form.parameters, other.parameters, files[0].box
    cell = (box[1] - box[0]).max() / (2.0 ** coded.bits_for(LOSS, H["x"], box) - 1)
    distance = np.abs(p["x"][:, None] - q["x"][None]).max(axis=2).min(axis=1)
    assert distance.max() <= 0.51 * cell + 1e-5
    for name in (name for name in p.arrays if name.startswith("psi_d.W") and p[name].size):
        step = min(coded.step_for(LOSS, H[name]), coded.rms(p[name]))
        # The code of a step has 5 bits.
        assert np.abs(p[name] - q[name]).max() <= 0.52 * step + 2.0**-15, name


def test_every_byte_is_counted_once(files):
    data, sizes, _ = files[3]
    assert len(data) == sum(sizes.values()) and sizes["other"] < 700


def test_a_file_draws_what_its_model_draws(files, scene):
    view = scene.test[0]
    images = [model.render(view.camera, view.time) for model in (files[0], files[4])]
    assert 0 < np.abs(images[0] - images[1]).mean() < 0.03


def test_a_larger_loss_makes_a_smaller_file(files):
    model, _, H, (data, _, codec), _ = files
    assert len(codec.encode(model, H, 1000 * LOSS)[0]) < 0.9 * len(data)


def test_a_step_is_at_most_the_size_of_its_weights(models, scene):
    """However much loss is accepted, a tensor is not rounded to 0."""
    model = models["d3dgs"]
    H = coded.sensitivity(model, scene.train[:1], np.random.default_rng(0))
    network = model.parameters.network("psi_d")
    for W, code in zip(network[0], coded.codes_of(1e9, H.network("psi_d"), network)[0]):
        assert step_of_code(code) <= max(1.05 * coded.rms(W), 2.0**-15)


def test_sensitivity_is_the_squared_derivative_of_the_pixels(scene, models):
    model, view, count = models["d3dgs"], scene.train[1], 300
    H = coded.sensitivity(model, [view] * count, np.random.default_rng(1))
    for name in ("sh_dc", "log_s", "logit_alpha"):
        place = np.unravel_index(H[name].argmax(), H[name].shape)
        numbers, images = model.parameters[name], []
        before = numbers[place]
        for h in (1e-2, -1e-2):
            numbers[place] = before + h
            images.append(model.render(view.camera, view.time))
        numbers[place] = before
        expected = (((images[0] - images[1]) / 2e-2) ** 2).sum()
        assert H[name][place] / count == pytest.approx(expected, rel=0.3)


def test_sensitivity_of_anchors_is_that_of_what_is_trained(scene, models):
    model, view, count = models["anchors"], scene.train[1], 300
    form = coded_anchors.OfAnchors(model)
    H = coded.sensitivity(form, [view] * count, np.random.default_rng(1))
    for name, field in (("log_s", "s_a"), ("x", "x_a")):
        place, images = np.unravel_index(H[name].argmax(), H[name].shape), []
        for h in (1e-3, -1e-3):
            array = getattr(model.anchors, field).copy()
            array[place] = array[place] * np.exp(h) if field == "s_a" else array[place] + h
            changed = dataclasses.replace(model, anchors=model.anchors._replace(**{field: array}))
            images.append(changed.render(view.camera, view.time))
        expected = (((images[0] - images[1]) / 2e-3) ** 2).sum()
        assert H[name][place] / count == pytest.approx(expected, rel=0.3), name


def test_float16(models, scene):
    data, sizes = half.encode(models["hexplane"])
    again = baselines.model_of(*half.decode(data))
    assert len(data) == sum(sizes.values())
    for name, array in models["hexplane"].parameters.arrays.items():
        assert again.parameters[name] == pytest.approx(array, rel=1e-3, abs=1e-7)
