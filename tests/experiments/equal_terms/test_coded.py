"""The simple codec in which every baseline is stored alike."""

import dataclasses

import numpy as np
import pytest

from p4dgs_ref.beyond import positions
from p4dgs_ref.beyond.networks import step_of_code
from p4dgs_ref.lab import baselines
from p4dgs_ref.lab.baselines import coded, coded_anchors
from p4dgs_ref.lab.tables import methods

from .small import MODULES

LOSS = 1e-4


@pytest.fixture(scope="module", params=[*MODULES, "anchors"])
def files(request, scene, trained, short_model):
    """A model, its sensitivity, its file and the Parameters in that file."""
    model = {"anchors": coded_anchors.OfAnchors(short_model), **trained}[request.param]
    H = coded.sensitivity(model, scene.train[::4], np.random.default_rng(0))
    data, sizes = coded.encode(model, H, LOSS)
    return model, H, data, sizes, coded.decode(data)[0]


def in_file_order(model, H):
    """The numbers of a model's arrays {name: array}, Gaussians in the order of the file."""
    x, box = model.parameters["x"], model.box
    bits = coded.bits_for(box, coded.step_for(LOSS, H["x"]))
    places, _ = positions.snap(x, *box, bits)
    order = np.argsort(positions.codes_of(places, box, bits), kind="stable")
    rows = model.values()["rows"]
    return {n: a[order] if n in rows else a for n, a in model.parameters.arrays.items()}


def test_every_number_comes_back_within_half_its_step(files):
    model, H, _, _, decoded = files
    arrays, (low, high) = in_file_order(model, H), model.box
    assert decoded.arrays.keys() == arrays.keys()
    cell = (high - low) / (2.0 ** coded.bits_for(model.box, coded.step_for(LOSS, H["x"])) - 1)
    assert (np.abs(arrays.pop("x") - decoded["x"]) <= 0.51 * cell + 1e-5).all()
    for name, array in arrays.items():
        in_columns = name in model.values()["rows"]
        split = (
            (lambda a: a.reshape(len(a), -1).T) if in_columns and array.size else (lambda a: [a])
        )
        for numbers, others, h in zip(*map(split, (array, decoded[name], H[name]))):
            step = coded.step_for(LOSS, h, numbers)
            # The code of a step has 5 bits.
            assert np.abs(numbers - others).max(initial=0) <= 0.52 * step + 1e-7, name


def test_every_byte_is_counted_once(files):
    _, _, data, sizes, _ = files
    assert len(data) == sizes["gaussians"] + sizes["network"] + sizes["other"]


def test_a_file_is_read_and_draws_what_its_model_draws(files, scene, tmp_path):
    model, _, data, _, _ = files
    is_explicit = isinstance(model, baselines.explicit.Explicit)
    endings = methods.ENDINGS if is_explicit else methods.PLAIN_ENDINGS
    path = tmp_path / f"some.{endings[methods.ALIKE]}"
    path.write_bytes(data)
    view, model = scene.test[0], model if is_explicit else model.model
    images = [one.render(view.camera, view.time) for one in (model, methods.load(path))]
    assert 0 < np.abs(images[0] - images[1]).mean() < 0.03


def test_a_larger_loss_makes_a_smaller_file(files):
    model, H, data, _, _ = files
    assert len(coded.encode(model, H, 1000 * LOSS)[0]) < 0.9 * len(data)


def test_sensitivity_is_the_squared_derivative_of_the_pixels(scene, trained):
    model, view, count = trained["d3dgs"], scene.train[1], 150
    H = coded.sensitivity(model, [view] * count, np.random.default_rng(1))
    for name in ("sh_dc", "log_s", "logit_alpha"):
        place = np.unravel_index(H[name].argmax(), H[name].shape)
        numbers, images = model.parameters[name], []
        before = numbers[place]
        for h in (1e-2, -1e-2):
            numbers[place] = before + h
            images.append(model.render(view.camera, view.time))
        numbers[place] = before  # exactly: other tests compare this model bit by bit
        expected = (((images[0] - images[1]) / 2e-2) ** 2).sum()
        assert H[name][place] / count == pytest.approx(expected, rel=0.3)


def test_sensitivity_of_anchors_is_that_of_what_is_trained(scene, short_model):
    model, view, count = short_model, scene.train[1], 150
    rng = np.random.default_rng(1)
    H = coded.sensitivity(coded_anchors.OfAnchors(model), [view] * count, rng)["log_s"]
    place, images = np.unravel_index(H.argmax(), H.shape), []
    for h in (1e-2, -1e-2):
        s_a = model.anchors.s_a.copy()
        s_a[place] *= np.exp(h)
        changed = dataclasses.replace(model, anchors=model.anchors._replace(s_a=s_a))
        images.append(changed.render(view.camera, view.time))
    expected = (((images[0] - images[1]) / 2e-2) ** 2).sum()
    assert H[place] / count == pytest.approx(expected, rel=0.3)


def test_steps_of_our_networks_follow_the_pictures(scene, short_model):
    views, rng = scene.train[:2], np.random.default_rng(0)
    fine, coarse = (
        coded_anchors.with_steps(short_model, views, rng, loss) for loss in (1e-8, 1e-6)
    )
    codes = [
        np.concatenate([*one.steps["psi_c"], *one.steps["psi_alpha"]]) for one in (fine, coarse)
    ]
    assert (codes[0] < codes[1]).all()
    assert all(map(np.array_equal, fine.steps["psi_p"], coarse.steps["psi_p"]))
    # However much loss is accepted, a tensor is not rounded to 0.
    for name, (codes, _) in coded_anchors.with_steps(short_model, views, rng, 1e9).steps.items():
        for W, code in zip(short_model.networks[name][0], codes):
            assert step_of_code(code) <= max(1.05 * coded.rms(W), 2.0**-15), name
