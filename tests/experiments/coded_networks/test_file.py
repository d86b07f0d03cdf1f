"""Version 2 of the file: its frame, header and coded positions."""

import itertools
import json
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref.beyond import positions
from p4dgs_ref.beyond.file import BASES, quantised, read_header, write_header
from p4dgs_ref.beyond.positions import of_16_bits, read_positions, snap, write_positions
from p4dgs_ref.beyond.presets import design_of
from p4dgs_ref.designs import choose, decode, encode, read_container
from tests.codec.models import CODED, MAKE, coded, digest, refusal
from tests.golden.both import write_container
from tests.sampling import few

# An overflow or a NaN on the way is a failure, too.
pytestmark = pytest.mark.filterwarnings("error")
BOX = np.array([-1.5, -1.0, 0.25], np.float32), np.array([1.5, 2.0, 1.75], np.float32)


def box_bytes(box):
    return np.concatenate(box).astype("<f4").tobytes()


def write_gaps(points, box, bits):
    """The section after the box."""
    model = SimpleNamespace(box=box, design=SimpleNamespace(position_bits=bits))
    section = write_positions(model, points)
    assert section.startswith(box_bytes(box))
    return section[24:]


def read_gaps(data, count, box, bits):
    """The positions in a section whose bytes after the box are `data`."""
    found, points = read_positions(
        box_bytes(box) + data, count, SimpleNamespace(position_bits=bits)
    )
    assert np.array_equal(found, box)
    return points


@pytest.mark.parametrize("name", few(CODED, 4))
def test_decoding_gives_the_quantised_model_and_encoding_again_the_file(name):
    model = CODED[name]()
    data, rounded = encode(model), quantised(model)
    assert data[8] == 2
    assert digest(decode(data)) == digest(rounded.model)
    assert decode(data).design == rounded.model.design
    assert encode(decode(data)) == data


def changed_design(model, design):
    """The model with another design."""
    return type(model)(**{**vars(model), "design": design})


def code_of(point, bits, axes=(0, 1, 2)):
    """The Morton code of a point, from the text of its binary digits."""
    texts = [f"{point[axis]:0{bits}b}" for axis in axes]
    return int("".join(digit for digits in zip(*texts) for digit in digits), 2)


def test_anchors_of_one_code_keep_their_order():
    model = coded(1, anchors=400)  # eight codes
    alive = model.anchors.mask.any(axis=1)
    given = type(model.anchors)(*(array[alive] for array in model.anchors))
    lo, hi = (corner.astype(float) for corner in model.box)
    codes = [code_of(point, 1) for point in np.rint((given.x_a - lo) / (hi - lo)).astype(int)]
    order = sorted(range(len(codes)), key=codes.__getitem__)  # a stable sort
    found = quantised(model)
    assert np.array_equal(found.model.anchors.mask, given.mask[order])
    for i, name in enumerate(("f_a", "s_a", "l_a")):
        error = np.abs(getattr(found.model.anchors, name) - getattr(given, name)[order])
        assert np.all(error <= 0.501 * found.context.q[:, i : i + 1]), name


@pytest.mark.parametrize("bits", range(1, 17))
def test_the_lattice_is_part_of_that_of_16_bits(bits):
    m, last = np.arange(2**bits), 2**bits - 1
    n = of_16_bits(m, bits)
    # 65535 i / last, rounded half up
    assert n.tolist() == [(2 * 65535 * i + last) // (2 * last) for i in m.tolist()]
    assert n[0] == 0 and n[-1] == 65535 and (np.diff(n) > 0).all()
    assert np.array_equal((n * (2**bits - 1) + 32767) // 65535, m)
    lo, hi = np.zeros(3, np.float32), np.array([1, 2, 4], np.float32)
    symbols, x = snap(np.outer(m / (2**bits - 1), hi.astype(float)), lo, hi, bits)
    assert np.array_equal(symbols, np.repeat(n[:, None], 3, axis=1))
    assert np.array_equal(snap(x, lo, hi, bits)[0], symbols)


# --- positions ---


def gaps_file(gaps, r, tail=0):
    """The bytes of some gaps with r raw bits, written digit by digit."""
    text = "".join(f"{gap % 2**r:0{r}b}"[::-1] for gap in gaps if r)
    for gap in gaps:
        b = (gap // 2**r + 1).bit_length() - 1
        rest = gap // 2**r + 1 - 2**b
        text += "0" * b + "1" + (f"{rest:0{b}b}"[::-1] if b else "")
    text += "0" * (-len(text) % 8 + 8 * tail)
    parts = [text[i : i + 8][::-1] for i in range(0, len(text), 8)]
    return bytes([r, *(int(part, 2) for part in parts)])


def sorted_points(rng, count, bits, spread=None):
    """Points of 16 bits in the order of their codes, and the codes."""
    m = rng.integers(0, 2**bits, (count, 3))
    if spread:
        m = np.clip(m // spread + rng.integers(0, 2**bits - 1), 0, 2**bits - 1)
    codes = [code_of(point, bits) for point in m.tolist()]
    order = np.argsort(codes, kind="stable")
    return of_16_bits(m[order], bits), sorted(codes)


GAPS = itertools.product([1, 2, 7, 10, 15, 16], [1, 2, 7, 300], [None, 3, 50])


@pytest.mark.parametrize("bits, count, spread", few(GAPS, 12))
def test_gaps_are_written_as_the_page_says(bits, count, spread):
    rng = np.random.default_rng([bits, count, spread or 0])
    points, codes = sorted_points(rng, count, bits, spread)
    data = write_gaps(points, BOX, bits)
    gaps = [b - a for a, b in zip([0, *codes], codes)]
    assert data == gaps_file(gaps, data[0])
    least = max(3 * bits - 33, 0)
    sizes = {r: sum(r + 2 * (gap // 2**r + 1).bit_length() - 1 for gap in gaps) for r in range(49)}
    allowed = {r: size for r, size in sizes.items() if least <= r <= 3 * bits}
    assert data[0] == min(allowed, key=allowed.get)
    for r in range(least, 3 * bits + 1):  # a decoder reads any r
        assert np.array_equal(read_gaps(gaps_file(gaps, r), count, BOX, bits), points)


def test_worked_numbers_of_positions():
    points = of_16_bits(np.array([[0, 1, 2], [3, 0, 1]]), 2)
    assert points.tolist() == [[0, 21845, 43690], [65535, 0, 21845]]
    assert [code_of(point, 2) for point in ([0, 1, 2], [3, 0, 1])] == [10, 37]
    assert gaps_file([10, 27], 4) == bytes([0x04, 0xBA, 0x05])
    assert np.array_equal(read_gaps(bytes([0x04, 0xBA, 0x05]), 2, BOX, 2), points)
    for text in ("10 and 27", "04 BA 05", "0, 21845, 43690 and 65535"):
        assert text in " ".join(positions.__doc__.split())


@pytest.mark.parametrize(
    "data, count, bits, offset, why",
    [
        (b"", 2, 2, 0, "before the number of raw bits"),
        (bytes([7, 0, 0]), 2, 2, 0, "7 raw bits per gap, expected at most 6"),
        (bytes([255]), 2, 16, 0, "255 raw bits"),
        (bytes([4]), 2, 2, 1, "before the last bit of a gap"),
        (bytes([6, 0]), 2, 2, 2, "before the last bit of a gap"),
        (bytes([4, 0xBA]), 2, 2, 2, "before the last bit of a gap"),
        (bytes([0, 0b10000]), 2, 2, 1, "the data end before its last bit"),
        (bytes([0, 0, 0, 0, 0, 0, 0]), 1, 16, 1, "more than 33"),
        (gaps_file([10, 27], 4)[:-1] + b"\x15", 2, 2, 2, "bits left over"),
        (gaps_file([10, 27], 4, tail=1), 2, 2, 2, "bits left over"),
        (gaps_file([10, 27], 4), 1, 2, 1, "bits left over"),
        (gaps_file([10, 54], 4), 2, 2, 0, "add up to 2^6 or more"),
        (gaps_file([64], 0), 1, 2, 0, "add up to 2^6 or more"),
        (gaps_file([2**48 - 1, 1], 20), 2, 16, 0, "add up to 2^48 or more"),
        (gaps_file([2**33 << 48], 48), 1, 16, 0, "add up to 2^48 or more"),
        (gaps_file([2**47] * 400, 40), 400, 16, 0, "add up to 2^48 or more"),
    ],
)
def test_wrong_gaps_are_refused(data, count, bits, offset, why):
    error = refusal(read_gaps, data, count, BOX, bits)
    assert (error.section, error.offset) == ("positions", 24 + offset) and why in error.message


def test_gaps_may_add_up_to_the_last_code():
    found = read_gaps(gaps_file([2**48 - 1, 0], 20), 2, BOX, 16)
    assert found.tolist() == [[65535] * 3] * 2


def test_axes_without_extent_cost_nothing():
    points = np.zeros((4, 3), np.int64)
    points[:, 1] = [0, 21845, 21845, 65535]
    flat = np.array([0, 0, 1], np.float32), np.array([0, 3, 1], np.float32)
    data = write_gaps(points, flat, 2)
    assert data == gaps_file([0, 1, 0, 2], data[0])
    assert np.array_equal(read_gaps(data, 4, flat, 2), points)
    nowhere = flat[0], flat[0]
    assert write_gaps(points * 0, nowhere, 16) == bytes([0, 0b1111])
    assert not read_gaps(bytes([0, 0b1111]), 4, nowhere, 16).any()


# --- header ---


@pytest.mark.parametrize(
    "preset, bits, name", [("tiny", 10, "tiny"), ("paper_synthetic", 16, "paper")]
)
def test_a_base_design_says_what_a_preset_says(preset, bits, name):
    effects = tuple(BASES[name]["effects"])
    design = design_of(choose(preset, {"is_coded": True, "position_bits": bits}), effects)
    text = json.dumps({"as": name, "anchors": 7}, separators=(",", ":")).encode()
    found, anchors, background = read_header(text)
    assert (found, anchors, background.tolist()) == (design, 7, [1.0, 1.0, 1.0])
    model = coded(10)
    written = write_header(changed_design(model, design))
    assert json.loads(written)["as"] == name and "d" not in json.loads(written)


def test_base_designs_do_not_change():
    """Files name them. Append new ones instead."""
    texts = {name: json.dumps(base, sort_keys=True).encode() for name, base in BASES.items()}
    sums = {name: zlib.crc32(text) for name, text in texts.items()}
    assert sums.items() >= {"tiny": 3738698959, "paper": 1050212813}.items()


def test_the_header_holds_what_differs():
    model = coded(7)
    fields = json.loads(write_header(model))
    base = BASES[fields.pop("as")]
    assert fields and all(base.get(name) != value for name, value in fields.items())
    assert read_header(write_header(model))[0] == model.design


@pytest.mark.parametrize(
    "text, why",
    [
        ({"anchors": 7}, "field 'as': expected one of tiny, paper"),
        ({"as": "Tiny", "anchors": 7}, "field 'as'"),
        ({"as": ["tiny"], "anchors": 7}, "field 'as'"),
        ({"as": {}, "anchors": 7}, "field 'as'"),
        ({"as": None, "anchors": 7}, "field 'as'"),
        ({"as": "tiny"}, "expected the fields"),
        ({"as": "tiny", "anchors": 0}, "field 'anchors'"),
        ({"as": "tiny", "anchors": 7, "is_coded": True}, "expected the fields"),
        ({"as": "tiny", "anchors": 7, "position_bits": 0}, "field 'position_bits'"),
        ({"as": "tiny", "anchors": 7, "position_bits": 17}, "field 'position_bits'"),
        ({"as": "tiny", "anchors": 7, "position_bits": 9.0}, "field 'position_bits'"),
        ({"as": "tiny", "anchors": 7, "d": 0}, "field 'd'"),
        ('{"as":"tiny","anchors":7,"anchors":7}', "no field twice"),
        ('{"as":"tiny","anchors":7,"as":"tiny"}', "no field twice"),
        ("[]", "expected"),
        ("tiny", "a JSON object"),
    ],
)
def test_wrong_headers_are_refused(text, why):
    body = text if isinstance(text, str) else json.dumps(text)
    error = refusal(read_header, body.encode())
    assert (error.section, error.offset) == ("header", 0) and why in error.message


def test_a_header_belongs_to_its_version():
    old, new = encode(MAKE["random"]()), encode(coded())
    for data, version, why in ((old, 2, "field 'as'"), (new, 1, "expected the fields")):
        forged = write_container(read_container(data), version)
        assert why in refusal(decode, forged).message


# --- the whole file ---
