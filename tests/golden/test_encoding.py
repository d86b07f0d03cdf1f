"""The vectors of the encoder: confirmed by a decoder and an encoder that share no code with it."""

import numpy as np
import pytest

from p4dgs_ref.oracle import published
from tests.golden import plain_decoder

NAMES = ("ordinary", "masked_and_still")


def case_of(key, name):
    return next(case for case in published.cases(key) if case.name == name)


@pytest.fixture(params=NAMES)
def pair(request):
    """What the plain decoder reads in the expected file, and the case of the quantiser."""
    data = case_of("encoder", request.param).tensors["out.file"].tobytes()
    return plain_decoder.decode(data), case_of("quantiser", request.param)


def test_the_plain_decoder_finds_the_integers_in_the_file(pair):
    read, case = pair
    for name in ("positions", "h", "q_units", "mu_units", "sigma_units", "symbols"):
        assert np.ravel(case.tensors[f"out.{name}"]).tolist() == list(read[name]), name
    assert [2 * bit - 1 for bit in case.tensors["out.signs"].tolist()] == read["signs"]


@pytest.mark.parametrize("case", published.cases("frequencies"), ids=lambda case: case.id)
def test_intervals_are_those_of_the_page(case):
    i, out = case.inputs(), {n: a.tolist() for n, a in case.tensors.items()}
    sizes = []
    for j, symbol in enumerate(i["symbols"].tolist()):
        cum, n, lowest, low = plain_decoder.gaussian(
            int(i["mu_units"][j]), int(i["sigma_units"][j])
        )
        place, v = (symbol >> low) - lowest, 0
        if not 0 <= place < n:
            v = -2 * place if place < 0 else 2 * (place - n) + 1
            place = n
        interval = (cum(place), cum(place + 1) - cum(place)) if place < n else (2**24 - 1, 1)
        assert interval == (out["out.start"][j], out["out.freq"][j])
        assert (low, symbol % 2**low, v) == tuple(
            out[f"out.{name}"][j] for name in ("low", "low_bits", "v")
        )
        assert (v > 0) == out["out.escape"][j]
        sizes.append(low)
    assert case.name != "every_deviation" or set(sizes) >= set(range(15))


class Lane:
    """A state, and the stack that all lanes share."""

    def __init__(self, stack, x=2**31):
        self.x, self.stack = x, stack

    def spill(self):
        self.stack.append(self.x % 2**32)
        self.x >>= 32

    def push(self, start, freq):
        if self.x >= freq << 39:
            self.spill()
        self.x = (self.x // freq << 24) + self.x % freq + start

    def push_bits(self, b, v):
        if self.x >= 1 << 63 - b:
            self.spill()
        self.x = (self.x << b) + v

    def pop_bits(self, b):
        self.x, v = divmod(self.x, 2**b)
        if self.x < 2**31:
            self.x = (self.x << 32) + self.stack.pop()
        return v


def message_of(start, freq, L):
    """The bytes of a message, in the steps of the format page."""
    stack, left = [], len(start)
    first = Lane(stack)
    while left and (L == 1 or left % L or len(stack) < L):  # 1
        left -= 1
        first.push(start[left], freq[left])
    lanes = [first] + [Lane(stack, 2**31 + first.pop_bits(31)) for _ in range(1, L)]  # 2
    for i in reversed(range(left)):  # 3
        lanes[i % L].push(start[i], freq[i])
    for lane in lanes[:0:-1]:  # 4
        n = lane.x.bit_length() - 32
        first.push_bits(31, lane.x % 2**31)
        first.push_bits(n, (lane.x >> 31) - 2**n)
        first.push_bits(5, n)
    high = first.x >= 2**32  # 5
    head = bytes([L.bit_length() - 1 | high << 7])
    tail = (len(start) - left).to_bytes(4, "little") if L > 1 else b""
    words = b"".join(word.to_bytes(4, "little") for word in reversed(stack))
    return head + tail + first.x.to_bytes(8 if high else 4, "little") + words


@pytest.mark.parametrize("case", published.cases("rans"), ids=lambda case: case.id)
def test_messages_are_those_of_the_page_and_can_be_read(case):
    start, freq = (case.tensors[f"in.{name}"].tolist() for name in ("start", "freq"))
    want = case.tensors["out.message"].tobytes()
    assert message_of(start, freq, case.record["settings"]["lanes"]) == want
    tables = [((0, a, a + b, 2**24).__getitem__, 3) for a, b in zip(start, freq)]
    entries, end = plain_decoder.read_message(want, 0, tables, "rans")
    assert entries == [1] * len(start) and end == len(want)


def test_sections_together_are_the_file():
    for name in NAMES:
        case = case_of("encoder", name)
        sections = plain_decoder.read_container(case.tensors["out.file"].tobytes())
        assert sections.pop("header").decode() == case.record["settings"]["header"]
        found = {n: a.tobytes() for n, a in case.tensors.items() if n.startswith("out.")}
        del found["out.file"]
        assert {f"out.{n}": body for n, body in sections.items()} == found
    assert "out.deformation_mlp" not in found
