"""The sections of networks: their steps, scales and symbols come back; rows and columns pay."""

import numpy as np
import pytest

from tests.codec.models import refusal
from tutorials.experiments.coded_networks import weights
from tutorials.experiments.coded_networks.networks import step_code, step_of_code
from tutorials.experiments.coded_networks.weights import read_networks, read_steps, write_weights

pytestmark = pytest.mark.filterwarnings("error")
SHAPES = [
    {"psi_alpha": [(5, 7), (7, 2)], "psi_c": [(5, 7), (7, 6)]},
    {"psi_d": [(4, 3), (3, 3), (3, 0), (3, 4)]},  # a head without outputs
    {"psi_q": [(1, 1)]},
    {"psi_d": [(40, 60)]},
]


def made(shapes, scale):
    """Networks of whole numbers of steps, and the codes of these steps."""
    rng, networks, steps = np.random.default_rng(0), {}, {}
    for name, layers in shapes.items():
        codes = rng.integers(0, 256, (2, len(layers)))
        codes[:, [J == 0 for _, J in layers]] = 0
        W = [np.rint(scale * rng.normal(size=s) * rng.lognormal(size=(s[0], 1))) for s in layers]
        b = [np.rint(scale * rng.normal(size=J)) for _, J in layers]
        numbers = [
            [np.clip(n, -32767, 32767) * step_of_code(code) + 0.0 for n, code in zip(*pair)]
            for pair in ((W, codes[0]), (b, codes[1]))
        ]
        networks[name], steps[name] = tuple(numbers), tuple(codes)
    return networks, steps


@pytest.mark.parametrize("shapes", SHAPES)
@pytest.mark.parametrize("scale", [3.0, 0.1, 0.0, 3000.0])
def test_sections_come_back(shapes, scale):
    networks, steps = made(shapes, scale)
    data = write_weights(networks, steps)
    found, codes = read_networks(data, "section", shapes), read_steps(data, "section", shapes)
    for name, pair in networks.items():
        for arrays, others in zip(pair, found[name]):
            for a, b in zip(arrays, others, strict=True):
                assert a.shape == b.shape and a.tobytes() == b.tobytes(), name
        assert np.array_equal(codes[name], steps[name]), name
    assert write_weights(found, codes) == data
    error = refusal(read_networks, data + b"\0", "section", shapes)
    assert error.message == "bits left over"


def test_steps_are_a_lattice_of_sixteen_an_octave():
    codes = np.arange(256)
    steps = step_of_code(codes)
    assert steps[0] == 2.0**-15 and steps[-1] == 31 / 16 and step_of_code(186) == 0.1015625
    assert np.array_equal(step_code(steps), codes)
    assert step_code([0, 1e-9, 1.9999, 5]).tolist() == [0, 0, 255, 255]
    middle = (steps[1:] + steps[:-1]) / 2
    assert np.array_equal(step_code(middle * (1 - 1e-9)), codes[:-1])
    assert np.array_equal(step_code(middle * (1 + 1e-9)), codes[1:])
    # The largest symbol times any step is exact in float32, in which training computes.
    assert np.array_equal((32767 * steps).astype(np.float32), 32767 * steps)


def test_rows_and_columns_that_are_almost_zero_are_cheap():
    networks, steps = made({"psi_d": [(64, 64)]}, 4.0)
    n = np.rint(4 * np.random.default_rng(1).normal(size=(64, 64)))
    networks["psi_d"][0][0][...] = n * step_of_code(steps["psi_d"][0][0])
    whole = len(write_weights(networks, steps))
    networks["psi_d"][0][0][::2] = 0
    assert len(write_weights(networks, steps)) < 0.56 * whole
    networks["psi_d"][0][0][:, ::2] = 0
    assert len(write_weights(networks, steps)) < 0.34 * whole


@pytest.mark.parametrize("scale", [0.2, 1, 30, 5000])
def test_the_level_and_codes_chosen_cost_the_least(scale):
    rng = np.random.default_rng(4)
    n = np.rint(scale * rng.normal(size=(9, 5)) * rng.lognormal(size=5)).astype(np.int64)
    magnitudes = np.minimum(np.abs(n), weights.KNOWN_COSTS - 1)
    t, r, c = weights.fit(n, True)

    def bits(t, r, c):
        codes = weights.price(np.abs(np.append(r, c)), 0).sum()
        return weights.price(magnitudes, t + r[:, None] + c).sum() + codes

    least = bits(t, r, c)
    assert least <= min(bits(level, 0 * r, 0 * c) for level in weights.LEVELS)
    assert least <= min(bits(level, r, c) for level in weights.LEVELS)
    for i, code in [(i, code) for i in range(len(r)) for code in weights.CODES]:
        assert least <= bits(t, np.where(np.arange(len(r)) == i, code, r), c)
