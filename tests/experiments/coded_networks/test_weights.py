"""Coded networks in files of version 2: their steps, sections, and what is refused."""

import dataclasses

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.beyond import weights
from p4dgs_ref.beyond.file import quantised
from p4dgs_ref.beyond.networks import default_steps, step_code, step_of_code
from p4dgs_ref.beyond.weights import read_networks, read_steps, write_weights
from p4dgs_ref.codec.container import EncodeError
from p4dgs_ref.designs import decode, encode, fit
from tests.codec.models import prefixes, random_model, refusal

pytestmark = pytest.mark.filterwarnings("error")
SHAPES = {
    "usual": {"psi_alpha": [(5, 7), (7, 2)], "psi_c": [(5, 7), (7, 6)]},
    "head without outputs": {"psi_d": [(4, 3), (3, 3), (3, 0), (3, 4)]},
    "least": {"psi_q": [(1, 1)]},
    "of one column": {"psi_alpha": [(3, 9), (9, 1)]},
    "wide": {"psi_d": [(40, 60)]},
}
SCALES = {"fine": 3.0, "dead": 0.1, "zero": 0.0, "far": 3000.0}


def made(shapes, scale, seed=0):
    """Networks of whole numbers of steps, and the codes of these steps."""
    rng = np.random.default_rng(seed)
    networks, steps = {}, {}
    for name, layers in shapes.items():
        codes = rng.integers(0, 256, (2, len(layers)))
        codes[:, [J == 0 for _, J in layers]] = 0
        rows = [rng.lognormal(size=(I, 1)) for I, _ in layers]
        W = [np.rint(scale * rng.normal(size=pair) * row) for pair, row in zip(layers, rows)]
        b = [np.rint(scale * rng.normal(size=J)) for _, J in layers]
        sizes = step_of_code(codes)
        found = [np.clip(n, -32767, 32767) * s + 0.0 for n, s in zip(W, sizes[0])]
        networks[name] = found, [n * s + 0.0 for n, s in zip(b, sizes[1])]
        steps[name] = tuple(codes)
    return networks, steps


@pytest.mark.parametrize("shapes", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_sections_come_back(shapes, scale):
    networks, steps = made(shapes, scale)
    data = write_weights(networks, steps)
    found = read_networks(data, "anchor_mlps", shapes)
    codes = read_steps(data, "anchor_mlps", shapes)
    assert [*found] == [*networks] == [*codes]
    for name, pair in networks.items():
        for arrays, others in zip(pair, found[name]):
            for a, b in zip(arrays, others, strict=True):
                assert a.shape == b.shape and a.tobytes() == b.tobytes(), name
        assert np.array_equal(codes[name], steps[name]), name
    assert write_weights(found, codes) == data


def test_steps_are_a_lattice_of_sixteen_an_octave():
    codes = np.arange(256)
    steps = step_of_code(codes)
    assert steps[0] == 2.0**-15 and steps[-1] == 31 / 16
    assert np.array_equal(step_code(steps), codes)
    assert np.all(steps[1:] / steps[:-1] <= 17 / 16) and np.all(steps[1:] > steps[:-1])
    assert np.array_equal(step_of_code(186), 0.1015625)  # as the page says
    assert step_code([0, 1e-9, 1.9999, 5]).tolist() == [0, 0, 255, 255]
    middle = (steps[1:] + steps[:-1]) / 2
    assert np.array_equal(step_code(middle * (1 - 1e-9)), codes[:-1])
    assert np.array_equal(step_code(middle * (1 + 1e-9)), codes[1:])
    # the largest symbol times any step is exact in float32, in which training computes
    assert np.array_equal((32767 * steps).astype(np.float32), 32767 * steps)


def test_rows_and_columns_that_are_almost_zero_are_cheap():
    shapes = {"psi_d": [(64, 64)]}
    networks, steps = made(shapes, 4.0)
    whole = len(write_weights(networks, steps))
    networks["psi_d"][0][0][::2] = 0
    half = len(write_weights(networks, steps))
    networks["psi_d"][0][0][:, ::2] = 0
    assert half < 0.56 * whole
    assert len(write_weights(networks, steps)) < 0.34 * whole


@pytest.mark.parametrize("scale", [0.2, 1, 30, 5000])
def test_the_codes_chosen_never_cost_more_than_none_and_are_found_soon(monkeypatch, scale):
    rng, calls, price = np.random.default_rng(4), [], weights.price
    n = np.rint(scale * rng.normal(size=(9, 5)) * rng.lognormal(size=5)).astype(np.int64)
    magnitudes = np.minimum(np.abs(n), weights.KNOWN_COSTS - 1)
    plain = weights.fit(n, True, weights.best_level_plainly)
    monkeypatch.setattr(weights, "price", lambda *pair: calls.append(pair) or price(*pair))
    t, r, c = weights.fit(n, True)
    assert len(calls) <= 3 * weights.SWEEPS  # the plain search looks up 28 levels in every sweep
    assert np.array_equal([t, *r, *c], [plain[0], *plain[1], *plain[2]])
    bits = [
        price(magnitudes, t + r[:, None] + c).sum() + price(np.abs(np.append(r, c)), 0).sum()
        for t, r, c in ((t, r, c), *((level, 0 * r, 0 * c) for level in weights.LEVELS))
    ]
    assert bits[0] == min(bits)


def test_rows_of_large_tensors_get_the_codes_that_they_get_alone():
    """Tensors are searched in blocks."""
    rng = np.random.default_rng(5)
    magnitudes = np.abs(np.rint(9 * rng.normal(size=(300, 250)) * rng.lognormal(size=(300, 1))))
    magnitudes, scales = magnitudes.astype(int), rng.integers(-3, 4, 250)
    alone = [weights.best_codes(row[None], scales)[0] for row in magnitudes]
    assert weights.best_codes(magnitudes, scales).tolist() == alone and len({*alone}) > 3


def test_every_truncation_is_refused():
    shapes = SHAPES["usual"]
    data = write_weights(*made(shapes, 3.0))
    for bad in prefixes(data):
        error = refusal(read_networks, bad, "anchor_mlps", shapes)
        assert error.section == "anchor_mlps" and error.offset <= len(bad)
    assert refusal(read_networks, data + b"\0", "", shapes).message == "bits left over"


@pytest.mark.parametrize("tensor", range(8))
def test_a_level_beyond_27_is_refused_at_its_byte(tensor):
    data = bytearray(write_weights(*made(SHAPES["usual"], 3.0)))
    data[2 * tensor + 1] = 28
    error = refusal(read_networks, bytes(data), "anchor_mlps", SHAPES["usual"])
    assert error.offset == 2 * tensor + 1 and "levels of at most 27" in error.message


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 32768 * 2.0**-15])
def test_a_weight_that_no_file_can_hold_is_named(wrong):
    model = random_model(1, is_coded=True)
    steps = {name: (0 * W, 0 * b) for name, (W, b) in model.steps.items()}
    tame = {name: [[0 * a for a in part] for part in pair] for name, pair in model.networks.items()}
    tame["psi_r"][0][0][2, 1] = wrong
    with pytest.raises(EncodeError, match="network psi_r"):
        encode(dataclasses.replace(model, networks=tame, steps=steps))


def test_a_model_without_steps_gets_the_default_ones():
    model = random_model(1, is_coded=True)
    plain = dataclasses.replace(model, steps=None)
    expected = default_steps(model.networks)
    found = quantised(plain).model
    assert all(np.array_equal(found.steps[name], expected[name]) for name in expected)
    rms = np.sqrt(np.mean(model.networks["psi_c"][0][0] ** 2))
    assert step_of_code(expected["psi_c"][0][0]) == pytest.approx(0.1 * rms, rel=0.04)
    assert step_of_code(expected["psi_c"][1][0]) == pytest.approx(0.05 * rms, rel=0.04)
    assert encode(decode(encode(plain))) == encode(plain)


def test_training_learns_the_steps_and_the_file_holds_them():
    changes = dict(is_coded=True, position_bits=10, network_ramp=5, lr_step="0.05,0.02")
    scene = p4.load_scene("bouncing", downscale=4)
    trainer = fit(scene, "smoke", 3, **changes)
    first = fit(scene, "smoke", 3, **{**changes, "lr_step": "0,0"})
    model, decoded = trainer.model(), decode(encode(trainer.model()))
    assert decoded.design.position_bits == 10
    for name, pair in decoded.networks.items():
        for arrays, trained, codes in zip(pair, model.networks[name], model.steps[name]):
            for a, b, step in zip(arrays, trained, step_of_code(codes)):
                assert np.array_equal(a, np.rint(b / step) * step)
    other = first.model().steps
    assert any(not np.array_equal(model.steps[name], other[name]) for name in other)
