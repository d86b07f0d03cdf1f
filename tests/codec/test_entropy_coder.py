"""The entropy coder: frequencies in integers, rANS and its readable twin, both kinds of streams.

Damaged and forged streams are refused by BitstreamError and by no other exception.
"""

import ast
import doctest
import hashlib
import inspect

import numpy as np
import pytest
from scipy.special import log_ndtr

from p4dgs_ref.codec import gaussian_table, rans, streams
from p4dgs_ref.codec.container import BitstreamError
from p4dgs_ref.codec.gaussian_table import (
    MU_BITS,
    MU_LIMIT,
    SIGMA_BITS,
    SIGMA_MAX,
    SIGMA_MIN,
    gaussian_model,
)
from p4dgs_ref.codec.streams import (
    decode_bits,
    decode_gaussian,
    encode_bits,
    encode_gaussian,
    ideal_bits_gaussian,
)
from tests.codec.models import flips, prefixes, refusal
from tests.sampling import few
from tests.workshop import make_tables

TWIN = dict(push_rows=rans.push_rows_plainly)


def draw(n, low, high, seed=0, offset=0.0):
    """Symbols of Gaussians with log-uniform sigma / q, their units, and their float64 entropy."""
    rng = np.random.default_rng(seed)
    sigma = np.exp(rng.uniform(np.log(low), np.log(high), n))
    mu = offset + rng.normal(size=n) * 10
    symbols = np.rint(mu + sigma * rng.normal(size=n)).astype(np.int64)
    x = np.abs(symbols - mu)  # the density is even: use the left tail
    upper, lower = log_ndtr((0.5 - x) / sigma), log_ndtr((-0.5 - x) / sigma)
    bits = -(upper + np.log1p(-np.exp(lower - upper))) / np.log(2)
    mu_units = np.rint(mu * 2**MU_BITS).astype(np.int64)
    sigma_units = np.rint(np.log2(sigma) * 2**SIGMA_BITS).astype(np.int64)
    return symbols, mu_units, np.clip(sigma_units, SIGMA_MIN, SIGMA_MAX), float(bits.sum())


def constant(n, mu=0, sigma=0):
    """The same mean and deviation for n symbols."""
    return np.full(n, mu, np.int64), np.full(n, sigma, np.int64)


RAMP = np.arange(600)
EXTREMES = np.array([0, 1, -1, 2**15, -(2**15) - 1, 2**31, -(2**31), 2**24, -(2**24)])
EDGES = {  # symbols, mu_units, sigma_units
    "empty": (RAMP[:0], 0, 0),
    "one symbol": (RAMP[7:8], 0, 0),
    "one escape": (np.array([-(2**31)]), 0, 0),
    "alternating": (RAMP % 2 * 2 - 1, 0, -16),
    "escapes on both sides": ((RAMP - 300) * 7919, 0, 0),
    "smallest sigma": (RAMP % 5 - 2, 0, SIGMA_MIN),
    "largest sigma": ((RAMP - 300) * 12345, 0, SIGMA_MAX),
    **{
        f"{name} {mu} {sigma}": (symbols, mu, sigma)
        for mu in (-MU_LIMIT, MU_LIMIT, 511, 512, -512, -513)
        for sigma in (SIGMA_MIN, -1, 0, 79, 80, SIGMA_MAX)
        for name, symbols in (
            ("extremes", EXTREMES),
            ("near", (mu >> MU_BITS) + np.arange(-9, 10)),
        )
    },
}


def test_the_lines_at_the_top_of_the_page_print_what_stands_there():
    result = doctest.testmod(streams)
    assert result.attempted == 10 and not result.failed


def test_tables_are_those_of_the_format():
    tables = {
        name: gaussian_table.lookup_table(name) for name in ("phi", "exp2", "sigmoid", "log2")
    }
    numbers = np.concatenate(list(tables.values())).astype("<i4")
    digest = hashlib.sha256(numbers.tobytes()).hexdigest()
    assert digest == "0b6b33feb22f099d8d04ffc834e32affe12432e36e09c5e1f25e7209c56d9477"
    assert {name: values.tolist() for name, values in tables.items()} == make_tables.make_tables()


def test_every_table_totals_2_to_the_24_and_every_frequency_is_positive():
    sigma_units = np.repeat(np.arange(SIGMA_MIN, SIGMA_MAX + 1), 40)
    mu_units = np.random.default_rng(2).integers(-(2**20), 2**20, len(sigma_units))
    model = gaussian_model(mu_units, sigma_units)
    assert (np.diff(model.keys) >= 1).all()
    assert (model.keys[model.first] == np.arange(len(model.first)) << 24).all()
    escape = model.keys[model.first + model.blocks]
    assert (escape == (np.arange(1, len(model.first) + 1) << 24) - 1).all()
    assert model.keys[-1] == len(model.first) << 24


def test_worked_numbers():
    mu, sigma = constant(3, 307, 9)
    model = gaussian_model(mu, sigma)
    assert model.keys[13:15].tolist() == [4883934, 9236032]
    keys = np.array([0, 12582912, 16777216])
    assert rans.encode(np.array([0, 1, 0]), keys).hex(" ") == "80 00 00 40 8e 03 00 00 00"
    stream = encode_gaussian(np.array([0, 5, -40]), mu, sigma)
    assert stream.hex(" ") == "80 cb 67 86 a4 03 00 00 00 ff ff ff 00 a0 05"
    stream = encode_bits(np.array([1, 1, 1, 0], bool))
    assert stream.hex(" ") == "00 00 c0 00 80 00 00 40 be 04 00 00 00"


@pytest.mark.parametrize("name", EDGES)
def test_edge_cases_are_decoded(name):
    symbols, *units = EDGES[name]
    mu, sigma = constant(len(symbols), *units)
    data = encode_gaussian(symbols, mu, sigma)
    assert np.array_equal(decode_gaussian(data, mu, sigma), symbols)
    ideal = ideal_bits_gaussian(symbols, mu, sigma)
    assert ideal.shape == symbols.shape
    assert ideal.sum() <= 8 * len(data) <= 1.001 * ideal.sum() + 8 * 10
    assert len(symbols) or data == b""


@pytest.mark.parametrize("lanes", few([1, 4, 32, 2, 1024], 3))
def test_twin_reads_and_writes_the_same_bytes(lanes):
    symbols, mu, sigma, _ = draw(120_000 if lanes == 1024 else 5003, 0.3, 90, seed=lanes)
    symbols[::97] += 5000  # escapes
    data = encode_gaussian(symbols, mu, sigma, lanes)
    assert data[0] & 15 == lanes.bit_length() - 1
    assert encode_gaussian(symbols, mu, sigma, lanes, **TWIN) == data
    assert np.array_equal(decode_gaussian(data, mu, sigma), symbols)
    assert np.array_equal(decode_gaussian(data, mu, sigma, pop_rows=rans.pop_rows_plainly), symbols)


def test_lanes_are_chosen_by_the_length_of_the_message():
    symbols, mu, sigma, _ = draw(200_000, 0.15, 8)
    lengths = (100, 20_000, 100_000, 200_000)
    log2_lanes = [encode_gaussian(symbols[:n], mu[:n], sigma[:n])[0] & 15 for n in lengths]
    assert log2_lanes == [0, 0, 5, 6]
    with pytest.raises(ValueError, match="too short a message for 64 lanes"):
        encode_gaussian(symbols[:500], mu[:500], sigma[:500], lanes=64)


@pytest.mark.parametrize(
    "n, p",
    [
        (0, 0.5),
        (1, 1),
        (4000, 0),
        (4000, 1),
        (4001, 0.97),
        (100_000, 1e-4),
        *few([(200_000, 0.999), (1_000_000, 0.5), (1_000_000, 0.999)], 1),
    ],
)
def test_bits(n, p):
    bits = np.random.default_rng(3).random(n) < p
    data, ones = encode_bits(bits), int(bits.sum())
    assert np.array_equal(decode_bits(data, n), bits)
    entropy = sum(-m * np.log2(m / n) for m in (ones, n - ones) if m)
    assert len(data) <= 1.003 * entropy / 8 + 16
    if ones in (0, n):
        assert len(data) == (4 if n else 0)


def test_probability_is_certain_only_where_all_bits_are_equal():
    found = [streams.probability_of_one(ones, 2**26) for ones in (0, 1, 2**26 - 1, 2**26)]
    assert found == [0, 1, 2**24 - 1, 2**24]


def test_frequencies_and_coder_use_no_float_arithmetic():
    """Integers are never divided with /, and no constant is a float."""
    for module in (gaussian_table, rans):
        nodes = list(ast.walk(ast.parse(inspect.getsource(module))))
        assert not [node for node in nodes if isinstance(node, ast.Div)]
        constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
        assert not [value for value in constants if isinstance(value, float)]
        names = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
        assert not names & {"float64", "float32", "float16", "true_divide", "divide"}
        assert "float" not in {node.id for node in nodes if isinstance(node, ast.Name)}


@pytest.fixture(scope="module", params=[1, 4])
def message(request):
    symbols, mu, sigma, _ = draw(260, 0.11, 60)
    symbols[::40] -= 40000  # escapes
    return symbols, mu, sigma, encode_gaussian(symbols, mu, sigma, request.param)


def outcome(data, mu, sigma):
    """The symbols, or the message of the refusal; any other error fails the test."""
    try:
        symbols = decode_gaussian(data, mu, sigma, section="features")
    except BitstreamError as error:
        assert error.section == "features"
        assert 0 <= error.offset <= len(data)
        return error.message
    assert symbols.shape == mu.shape
    assert np.abs(symbols).max(initial=0) <= 2**31
    return symbols


def is_refused(data, mu, sigma):
    return isinstance(outcome(data, mu, sigma), str)


def test_every_truncation_and_every_extension_is_refused(message):
    _, mu, sigma, data = message
    assert all(is_refused(bad, mu, sigma) for bad in prefixes(data))
    for byte in (0, 255):
        for n in (1, 4, 9, 400):
            assert is_refused(data + bytes([byte]) * n, mu, sigma)


@pytest.mark.parametrize(
    "head, why",
    [
        ("0b 00000000 00000080", "lane byte"),
        ("0f", "end before the first"),
        ("00 00000000", "state 0"),
        ("00 ffffff7f", "state 2147483647"),
        ("80 00000000 00000080", "state 9223372036854775808"),
        ("02 ffffffff 00000080", "a tail of 4294967295"),
        ("02 01000000 00000080", "a tail of 1 of 2048"),
        ("02 00000000 00000080", "a tail of 0 of 2048"),  # lanes start from the words of the tail
    ],
)
def test_impossible_heads_are_refused(head, why):
    padding = bytes(0 if head == "0f" else 40)
    units = np.zeros(2048, int)
    assert why in outcome(bytes.fromhex(head) + padding, units, units)


def test_the_lowest_state_takes_no_word():
    assert rans.pop_bits(rans.LOWEST << 5 | 19, 5, []) == (rans.LOWEST, 19)
    keys, half, words = np.array([0, 2**23, 2**24]), np.array([2**23]), np.array([7], np.uint32)
    states, _ = rans.push_rows_plainly([rans.LOWEST], 0 * half, half)
    for pop in (rans.pop_rows_fast, rans.pop_rows_plainly):
        popped, left = pop(states, words, 0 * half, keys, np.empty(1, int))
        assert popped == [rans.LOWEST] and len(left) == 1


def test_raw_bits_are_read_strictly():
    units = np.full(3, 307), np.full(3, 9)
    data = bytes.fromhex("80 cb 67 86 a4 03 00 00 00 ff ff ff 00 a0 05")
    assert outcome(data, *units).tolist() == [0, 5, -40]
    assert outcome(data[:-1] + b"\x85", *units) == "bits left over"
    escapes = np.arange(40) * 1000 + 5000
    zero = np.zeros(40, int)
    data = bytearray(encode_gaussian(escapes, zero, zero))
    data[-40:] = bytes(40)
    error = refusal(decode_gaussian, bytes(data + b"\1" + bytes(40)), zero, zero)
    assert "an escape of" in str(error) and len(data) - 45 < error.offset < len(data) - 35


def test_symbols_beyond_2_to_the_31_are_refused():
    zero = np.zeros(2, int)
    data = encode_gaussian(np.array([2**31, 0]), zero, zero)
    # The same tables five symbols higher
    assert "beyond +-2^31" in outcome(data, zero + 5 * 1024, zero)


def test_damaged_bit_streams():
    bits = np.random.default_rng(7).random(900) < 0.2
    data = encode_bits(bits)
    for bad in (*prefixes(data), *flips(data)):
        assert refusal(decode_bits, bad, len(bits), "masks").section == "masks"
    for count in (0, 1, 99, 899, 901, 4000):
        refusal(decode_bits, data, count)
    for certain in (bytes(4), bytes([0, 0, 0, 1])):
        assert "left over" in refusal(decode_bits, certain + b"\0", 5).message
    error = refusal(decode_bits, bytes([1, 0, 0, 1]) + data[4:], len(bits))
    assert error.message.startswith("a probability of 16777217")
