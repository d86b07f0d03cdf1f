"""The vectors of the encoder: confirmed by a decoder that shares no code with it."""

import numpy as np
import pytest

from p4dgs_ref.oracle import published
from tests.workshop import plain_decoder

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


@pytest.mark.parametrize("case", published.cases("rans"), ids=lambda case: case.id)
def test_messages_can_be_read(case):
    start, freq = (case.tensors[f"in.{name}"].tolist() for name in ("start", "freq"))
    want = case.tensors["out.message"].tobytes()
    tables = [((0, a, a + b, 2**24).__getitem__, 3) for a, b in zip(start, freq)]
    entries, end = plain_decoder.read_message(want, 0, tables, "rans")
    assert entries == [1] * len(start) and end == len(want)


def test_sections_together_are_the_file():
    for name in NAMES:
        case = case_of("encoder", name)
        sections = plain_decoder.read_container(case.tensors["out.file"].tobytes())
        assert sections.pop("header").decode() == case.record["settings"]["header"]
        bodies = {n: a.tobytes() for n, a in case.tensors.items() if n.startswith("out.")}
        del bodies["out.file"]
        assert {f"out.{n}": body for n, body in sections.items()} == bodies
    assert "out.deformation_mlp" not in bodies
