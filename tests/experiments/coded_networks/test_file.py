"""Version 2 of the file: whole models, sorted positions, the header."""

import dataclasses
import json
import zlib

import numpy as np
import pytest

from p4dgs_ref.codec.container import EncodeError
from tests.codec.models import digest, random_model, refusal
from tutorials.experiments.coded_networks import file, positions
from tutorials.experiments.coded_networks.file import BASES, decode, encode, quantise
from tutorials.experiments.coded_networks.networks import default_steps
from tutorials.experiments.coded_networks.positions import of_16_bits, read_sorted, write_sorted
from tutorials.experiments.coded_networks.training import CodedModel

# An overflow or a NaN on the way is a failure, too.
pytestmark = pytest.mark.filterwarnings("error")
BOX = np.array([-1.5, -1.0, 0.25], np.float32), np.array([1.5, 2.0, 1.75], np.float32)
FRAME = np.concatenate(BOX).tobytes()  # of a section of positions


def coded(seed=0, bits=10, **changes):
    model = random_model(seed, **changes)
    return CodedModel(**vars(model), steps=default_steps(model.networks), position_bits=bits)


@pytest.mark.parametrize("bits", [1, 7, 10, 16])
@pytest.mark.parametrize("effects", [(), ("translation", "view_color", "background")])
def test_decoding_gives_the_quantised_model_and_encoding_again_the_file(bits, effects):
    model = coded(bits, bits, effects=effects, anchors=60)
    data, rounded = encode(model), quantise(model).model
    assert data[8] == 2 and decode(data).position_bits == bits
    assert digest(decode(data)) == digest(rounded)
    assert decode(data).design == rounded.design
    assert encode(decode(data)) == data


def test_a_weight_that_no_file_can_hold_is_named():
    model = coded()
    model.networks["psi_r"][0][0][2, 1] = np.nan
    with pytest.raises(EncodeError, match="network psi_r"):
        encode(model)
    steps = {name: tuple(0 * part for part in pair) for name, pair in coded().steps.items()}
    with pytest.raises(EncodeError, match="of at most 32767 steps"):
        encode(dataclasses.replace(coded(), steps={**steps}, networks=large(coded().networks)))


def large(networks):
    return {name: ([W + 2 for W in weights], b) for name, (weights, b) in networks.items()}


# --- positions ---
def code_of(point, bits):
    """The Morton code of a point, from the text of its binary digits."""
    texts = [f"{n:0{bits}b}" for n in point]
    return int("".join(digit for digits in zip(*texts) for digit in digits), 2)


def gaps_file(gaps, r):
    """The bytes of some gaps with r raw bits, written digit by digit."""
    text = "".join(f"{gap % 2**r:0{r}b}"[::-1] for gap in gaps if r)
    for gap in gaps:
        b = (gap // 2**r + 1).bit_length() - 1
        rest = gap // 2**r + 1 - 2**b
        text += "0" * b + "1" + (f"{rest:0{b}b}"[::-1] if b else "")
    text += "0" * (-len(text) % 8)
    return bytes([r, *(int(text[i : i + 8][::-1], 2) for i in range(0, len(text), 8))])


@pytest.mark.parametrize("bits", range(1, 17))
def test_the_lattice_is_part_of_that_of_16_bits(bits):
    m, last = np.arange(2**bits), 2**bits - 1
    n = of_16_bits(m, bits)
    assert n.tolist() == [(2 * 65535 * i + last) // (2 * last) for i in m.tolist()]  # half up
    assert np.array_equal((n * last + 32767) // 65535, m)


@pytest.mark.parametrize("bits, count", [(1, 2), (2, 7), (10, 300), (16, 40)])
def test_gaps_are_written_as_the_page_says(bits, count):
    m = np.random.default_rng(bits).integers(0, 2**bits, (count, 3))
    m = m[np.argsort([code_of(point, bits) for point in m.tolist()], kind="stable")]
    codes, points = [code_of(point, bits) for point in m.tolist()], of_16_bits(m, bits)
    gaps = [b - a for a, b in zip([0, *codes], codes)]
    data = write_sorted(points, BOX, bits)[24:]
    least = max(3 * bits - 33, 0)
    sizes = {r: len(gaps_file(gaps, r)) for r in range(least, 3 * bits + 1)}
    assert data == gaps_file(gaps, data[0]) and len(data) == min(sizes.values())
    for r in sizes:  # a decoder reads any r
        assert np.array_equal(read_sorted(FRAME + gaps_file(gaps, r), count, bits)[1], points)


def test_worked_numbers_of_the_pages():
    points = of_16_bits(np.array([[0, 1, 2], [3, 0, 1]]), 2)
    data = bytes([0x04, 0xBA, 0x05])
    assert points.tolist() == [[0, 21845, 43690], [65535, 0, 21845]]
    assert gaps_file([code_of(p, 2) for p in ([0, 1, 2],)] + [27], 4) == data
    assert np.array_equal(read_sorted(FRAME + data, 2, 2)[1], points)
    assert "04 BA 05" in positions.__doc__
    frame = file.write_container({"masks": b"\1\2\3"}).hex(" ").upper()
    assert all(line.split("  ")[0].strip() in frame for line in ("0E 09 9B F7", "01 02 03"))
    assert "0E 09 9B F7" in file.__doc__


def test_axes_without_extent_cost_nothing():
    flat = np.array([0, 0, 1], np.float32), np.array([0, 3, 1], np.float32)
    points = np.zeros((4, 3), np.int64)
    points[:, 1] = [0, 21845, 21845, 65535]
    data = write_sorted(points, flat, 2)
    assert data[24:] == gaps_file([0, 1, 0, 2], data[24])
    assert np.array_equal(read_sorted(data, 4, 2)[1], points)


# --- header ---
def test_base_designs_do_not_change():
    """Files name them. Append new ones instead."""
    sums = {n: zlib.crc32(json.dumps(base, sort_keys=True).encode()) for n, base in BASES.items()}
    assert sums.items() >= {"tiny": 3738698959, "paper": 1050212813}.items()


def test_the_header_holds_what_differs():
    fields = json.loads(file.write_header(coded(bits=7)))
    base = BASES[fields.pop("as")]
    assert fields and all(base.get(name) != value for name, value in fields.items())
    assert file.read_header(file.write_header(coded(bits=7)))[0] == 7


@pytest.mark.parametrize(
    "text, why",
    [
        ('{"anchors":7}', "field 'as': expected one of tiny, paper"),
        ('{"as":["tiny"],"anchors":7}', "field 'as'"),
        ('{"as":"tiny"}', "expected the fields"),
        ('{"as":"tiny","anchors":7,"more":1}', "expected the fields"),
        ('{"as":"tiny","anchors":7,"position_bits":9.0}', "field 'position_bits'"),
        ('{"as":"tiny","anchors":7,"d":0}', "field 'd'"),
        ('{"as":"tiny","anchors":7,"as":"tiny"}', "no field twice"),
    ],
)
def test_wrong_headers_are_refused(text, why):
    error = refusal(file.read_header, text.encode())
    assert (error.section, error.offset) == ("header", 0) and why in error.message
