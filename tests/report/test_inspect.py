"""The size ledger, the heat picture, and the format page."""

import dataclasses
import json
import re

import numpy as np
import pytest
from matplotlib import colormaps

import p4dgs_ref as p4
from p4dgs_ref.codec import container, file, published
from p4dgs_ref.codec.__main__ import page
from p4dgs_ref.codec.container import SECTIONS
from p4dgs_ref.codec.gaussian_table import lookup_table
from p4dgs_ref.designs import layout, quantised_of, read_container
from p4dgs_ref.equations import grid_nodes
from p4dgs_ref.report import figures as report
from p4dgs_ref.report.figures import heat_image
from p4dgs_ref.report.inspect import anchor_bits, ledger, symbol_bits
from p4dgs_ref.splatting.camera import look_at
from tests import processes
from tests.codec.models import MAKE, coded


@pytest.fixture(scope="module")
def data(trained):
    return trained.data


@pytest.fixture(scope="module", params=[*MAKE, "coded"])
def anything(request):
    """A file of every kind of model; the last is one of version 2."""
    return p4.encode({**MAKE, "coded": coded}[request.param]())


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
    q = quantised_of(data)
    assert symbol_bits(q).shape == q.symbols.shape
    assert not symbol_bits(q)[~q.kept].any()


def test_the_color_of_an_anchor_is_that_of_its_gaussians(data):
    """Another colour of one anchor changes the picture where its Gaussians are, nowhere else."""
    model = p4.decode(data)
    camera = look_at((2.5, 2.0, 2.2), (0, 0, 0), 60, 60, 40, 40)
    colors = np.full((len(model.anchors.x_a), 3), 0.5)
    flat = heat_image(model, colors, camera, 0.5)
    seen = np.unique(model.gaussians(0.5, camera).index // model.design.k)
    assert len(seen) > 3
    assert np.ptp(flat.reshape(-1, 3), axis=0).max() > 0.05  # the scene is visible over white
    colors[seen[0]] = 0.0
    difference = np.abs(heat_image(model, colors, camera, 0.5) - flat).max(axis=2)
    alone = model.anchors.mask & (np.arange(len(colors)) == seen[0])[:, None]
    anchors = model.anchors._replace(mask=alone)
    only = dataclasses.replace(model, anchors=anchors, background=np.zeros(3))
    covered = heat_image(only, colors, camera, 0.5).min(axis=2) < 0.999
    assert difference[~covered].max(initial=0) <= 1e-3 < difference.max()


def test_the_bar_of_the_heat_picture_spans_the_bits(data, tmp_path, monkeypatch):
    """Bar and histogram have the data's range and name the unit; the picture has its colours."""
    saved = []
    monkeypatch.setattr(report, "save_figure", lambda figure, path: saved.append(figure))
    monkeypatch.setattr(report, "heat_image", lambda model, colors, *view: colors[None])
    model = p4.decode(data)
    bits = np.random.default_rng(3).gamma(4, 30, len(model.anchors.x_a))
    limits = bits.min(), bits.max()
    report.write_heat(tmp_path, model, bits, None)
    (figure,) = saved
    figure.canvas.draw()
    picture, histogram, bar = figure.axes
    assert bar.get_ylim() == limits
    assert "bits" in bar.get_ylabel() and "bits" in histogram.get_xlabel()
    columns = histogram.patches
    assert sum(column.get_height() for column in columns) == len(bits)
    assert (columns[0].get_x(), columns[-1].get_x() + columns[-1].get_width()) == limits
    drawn = picture.images[0].get_array()[0]
    want = colormaps["viridis"]((bits - limits[0]) / np.ptp(bits))[:, :3]
    np.testing.assert_allclose(drawn, want, atol=0.02)
    report.pyplot().close(figure)


def test_the_format_page_is_complete():
    text = page()
    for words in (
        "89 50 34 44 0D 0A 1A 0A",
        "offset_scales",
        "65535",
        "2654435761",
        "Elias",
        "L LANES",
        "phi",
        "sigmoid",
        "12582912",
        "least integer with max |W|",
    ):
        assert words in text, words
    words = " ".join(text.split())
    for name in ("phi", "exp2", "sigmoid", "log2"):
        assert " ".join(map(str, lookup_table(name).tolist())) in words


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
    # the vocabulary of errors, and where the expected numbers stand
    assert published.__doc__.strip() in page()
    for row in json.loads((published.FOLDER / "manifest.json").read_text())["bad"]:
        assert row["kind"] in words.split("`kind` is one of")[1].split("Types are")[0]
    for sentence in (
        "The tail must have taken every word that step 2 put on the stack.",
        "The header promises at most 2^22 + 2^4 n numbers.",
        "All anchors together need at most 2^34 + 2^15 n multiplications.",
        "the largest coordinate is the float32 below it, 9.999999394896025e29",
        "Encoding a decoded model gives the same bytes if this encoder wrote the file.",
    ):
        assert sentence in words
    assert float(np.nextafter(np.float32(1e30), np.float32(0))) == 9.999999394896025e29
    assert grid_nodes.__doc__.strip() not in page() and "grid_nodes" not in words


def test_python_m_codec_prints_the_page():
    assert processes.run("-m", "p4dgs_ref.codec").stdout == page()
