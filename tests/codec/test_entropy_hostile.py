"""Damaged and forged streams are refused by BitstreamError and by no other exception."""

import numpy as np
import pytest

from p4dgs_ref.codec import rans
from p4dgs_ref.codec.container import BitstreamError
from p4dgs_ref.codec.gaussian_table import gaussian_model
from p4dgs_ref.codec.streams import decode_bits, decode_gaussian, encode_bits, encode_gaussian
from tests.codec.models import flips, prefixes, refusal


def inputs(n, sigma_low, sigma_high, seed=4):
    rng = np.random.default_rng(seed)
    sigma_units, mu_units = rng.integers(sigma_low, sigma_high, n), rng.integers(-9000, 9000, n)
    symbols = np.rint(mu_units / 1024 + 2.0 ** (sigma_units / 16) * rng.normal(size=n))
    return symbols.astype(np.int64), mu_units, sigma_units


@pytest.fixture(scope="module", params=[1, 4])
def message(request):
    symbols, mu, sigma = inputs(260, -50, 95)
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


def test_flipped_bits_never_pass_the_coder(message):
    _, mu, sigma, data = message
    rng, model = np.random.default_rng(5), gaussian_model(mu, sigma)
    _, raw = rans.decode(data, model.table, model.keys)
    seen = set()
    for _ in range(150):
        at = int(rng.integers(len(data)))
        bad = bytearray(data)
        bad[at] ^= 1 << int(rng.integers(8))
        answer = outcome(bytes(bad), mu, sigma)
        if isinstance(answer, str):
            seen.add(answer)
        else:
            assert at >= raw  # raw bits have no redundancy; the container's checksum has
    assert any(answer.startswith("lane 0 ends in") for answer in seen)
    assert ("a lane does not end where lanes start" in seen) == (data[0] & 15 > 0)


@pytest.mark.parametrize(
    "head, why",
    [
        ("0b 00000000 00000080", "lane byte"),
        ("10 00000080", "lane byte"),
        ("0f", "end before the first"),
        ("00 00000000", "state 0"),
        ("00 ffffff7f", "state 2147483647"),
        ("80 00000080 00000000", "state 2147483648"),
        ("80 00000000 00000080", "state 9223372036854775808"),
        ("02 ffffffff 00000080", "a tail of 4294967295"),
        ("02 04080000 00000080", "a tail of 2052"),
        ("02 01000000 00000080", "a tail of 1 of 2048"),
    ],
)
def test_impossible_heads_are_refused(head, why):
    padding = bytes(0 if head == "0f" else 40)
    units = np.zeros(2048, int)
    assert why in outcome(bytes.fromhex(head) + padding, units, units)


def test_raw_bits_are_read_strictly():
    units = np.full(3, 307), np.full(3, 9)
    data = bytes.fromhex("80 cb 67 86 a4 03 00 00 00 ff ff ff 00 a0 05")
    assert outcome(data, *units).tolist() == [0, 5, -40]
    assert outcome(data[:-1] + b"\x85", *units) == "bits left over"
    escapes = np.arange(40) * 1000 + 5000
    zero = np.zeros(40, int)
    data = bytearray(encode_gaussian(escapes, zero, zero))
    data[-40:] = bytes(40)
    assert outcome(bytes(data + b"\1" + bytes(40)), zero, zero).startswith("an escape of")


def test_symbols_beyond_2_to_the_31_are_refused():
    zero = np.zeros(2, int)
    data = encode_gaussian(np.array([2**31, 0]), zero, zero)
    # The same tables five symbols higher
    assert "at most 2^31" in outcome(data, zero + 5 * 1024, zero)


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


def test_many_lanes_need_a_tail():
    """The encoder starts lanes from the words of the tail; a message without a tail is refused."""
    ones = np.zeros(4096, np.int64)
    data = bytearray(encode_gaussian(np.arange(4096) % 9 - 4, ones, ones + 32, lanes=32))
    assert data[0] & 15 == 5 and int.from_bytes(data[1:5], "little") > 0
    data[1:5] = bytes(4)
    assert "a tail of 0" in refusal(decode_gaussian, bytes(data), ones, ones + 32).message
