"""The size ledger, the heat picture, and the format page."""

import re

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec import container, file
from p4dgs_ref.codec.__main__ import page
from p4dgs_ref.codec.container import SECTIONS, layout, read_container
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.codec.gaussian_table import lookup_table
from p4dgs_ref.equations import grid_nodes
from p4dgs_ref.report import inspect
from p4dgs_ref.report.inspect import anchor_bits, ledger, symbol_bits
from tests import processes
from tests.codec.models import MAKE


@pytest.fixture(scope="module")
def data(trained):
    return trained.data


@pytest.fixture(scope="module", params=[*MAKE])
def anything(request):
    """A file of every kind of model."""
    return p4.encode(MAKE[request.param]())


def test_every_byte_is_accounted_for_and_gaps_are_small(anything):
    rows = ledger(anything)
    assert sum(row["bytes"] for row in rows) == len(anything)
    assert [row["name"] for row in rows] == ["container", *read_container(anything)]
    for row in rows:
        assert row["payload_bytes"] + row["header_bytes"] == row["bytes"]
        assert min(row["header_bytes"], row["payload_bytes"]) >= 0
        # A payload is at most a byte below the integer entropy, or 0.3 % and 12 bytes above it.
        least = row["integer_bytes"]
        assert least - 1 <= row["payload_bytes"] <= 1.003 * least + 12, row
    frame = sum(size for name, size in layout(anything) if name not in SECTIONS)
    assert rows[0]["bytes"] == rows[0]["header_bytes"] == frame


def test_anchor_bits_add_up_to_the_cost_of_all_anchors(data):
    model, bits = anchor_bits(data)
    rows = {row["name"]: row for row in ledger(data)}
    parts = ("positions", "features", "scales", "offset_scales", "offsets", "masks")
    total = sum(rows[name]["integer_bytes"] for name in parts)
    assert bits.sum() / 8 == pytest.approx(total, rel=1e-4)
    q = quantised_of(read_container(data))
    assert symbol_bits(q).shape == q.symbols.shape
    assert not symbol_bits(q)[~q.kept].any()


def test_the_format_page_lists_sections_in_the_order_of_the_file():
    """The table of sections on the page has the ids and the order that files have."""
    row = r"^ +(\d+) +(\w+) +(?:JSON|plain|Gaussian|bits|float16) "
    rows = re.findall(row, file.__doc__, re.M)
    assert file.__doc__.strip() in page()
    assert rows == [(str(number), name) for number, name in enumerate(SECTIONS, 1)]
    ids = re.findall(r"\b(\d+) (" + "|".join(SECTIONS) + r")\b", container.__doc__)
    assert ids == rows


def test_the_format_page_has_what_a_decoder_needs_and_leaves_out_the_rest():
    words = " ".join(page().split())
    for name in ("phi", "exp2", "sigmoid", "log2"):
        assert " ".join(map(str, lookup_table(name).tolist())) in words
    for sentence in (
        "89 50 34 44 0D 0A 1A 0A",
        "offset_scales",
        "65535",
        "2654435761",
        "Elias",
        "L LANES",
        "12582912",
        "least integer with max |W|",
        "The tail must have taken every word that step 2 put on the stack.",
        "The header declares at most 2^22 + 2^4 n numbers.",
        "All anchors together need at most 2^34 + 2^15 n multiplications.",
        "the largest coordinate is the float32 below it, 9.999999394896025e29",
        "Encoding a decoded model gives the same bytes if this encoder wrote the file.",
    ):
        assert sentence in words
    assert float(np.nextafter(np.float32(1e30), np.float32(0))) == 9.999999394896025e29
    assert grid_nodes.__doc__.strip() not in page() and "grid_nodes" not in words


def test_python_m_codec_prints_the_page():
    assert processes.run("-m", "p4dgs_ref.codec").stdout == page()


def test_blocks_of_anchors_have_the_bits_of_all_at_once(data, monkeypatch):
    """A block holds as many anchors as memory allows: one, where hardly anything is allowed."""
    q = quantised_of(read_container(data))
    whole = inspect.attribute_bits(q)
    assert len(inspect.blocks_of(q)) == 1
    monkeypatch.setattr(inspect, "BLOCK", -2 * sum(grid.size for grid in q.model.grids))
    assert len(inspect.blocks_of(q)) == len(q.symbols) > 1
    for name, bits in inspect.attribute_bits(q).items():
        assert np.allclose(bits, whole[name], rtol=1e-12, atol=0), name


def test_a_page_of_docstrings_needs_docstrings():
    printed = processes.run("-OO", "-m", "p4dgs_ref.codec")
    assert (printed.returncode, printed.stdout) == (2, "")
    assert printed.stderr == "the page consists of docstrings; expected Python without -OO\n"
