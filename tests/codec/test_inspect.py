"""The size ledger, the heat picture, and the format page."""

import dataclasses
import io
from contextlib import redirect_stdout

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec import __main__ as pages
from p4dgs_ref.codec.container import SECTIONS, layout, read_container
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.codec.inspect import anchor_bits, components, ledger, symbol_bits
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.studies.heat import heat_image
from tests.codec.test_file import MAKE


@pytest.fixture(scope="module")
def data():
    return p4.encode(
        p4.train(load_scene("bouncing"), "smoke", anchors=60, stage_ends=(20, 30, 60, 100))
    )


@pytest.fixture(scope="module", params=[name for name in MAKE])
def anything(request):
    return p4.encode(MAKE[request.param]())


def test_every_byte_is_accounted_for(anything):
    rows = ledger(anything)
    assert sum(row["bytes"] for row in rows) == len(anything)
    assert [row["name"] for row in rows] == ["container", *read_container(anything)]
    for row in rows:
        assert (
            row["payload_bytes"] + row["header_bytes"] == row["bytes"]
            and min(row["header_bytes"], row["payload_bytes"]) >= 0
        )
    frame = sum(size for name, size in layout(anything) if name not in SECTIONS)
    assert rows[0]["bytes"] == rows[0]["header_bytes"] == frame


def test_gaps_have_the_sizes_that_are_claimed(anything):
    """Payload never beats the integer entropy by more than a byte, and exceeds it by no more than 0.3 % and 12 bytes."""
    for row in ledger(anything):
        gap = row["payload_bytes"] - row["integer_bytes"]
        assert -1 <= gap <= 0.003 * row["integer_bytes"] + 12, row


def test_coded_size_is_within_three_per_mille_of_the_float_entropy(data):
    for row in ledger(data):
        if row["name"] not in ("container", "header", "positions"):
            assert row["bytes"] <= 1.003 * row["estimate_bytes"] + 16, row


def test_anchor_bits_add_up_to_what_anchors_cost(data):
    model, bits = anchor_bits(data)
    rows = {row["name"]: row for row in ledger(data)}
    parts = ("positions", "features", "scales", "offset_scales", "offsets", "masks")
    assert bits.sum() / 8 == pytest.approx(
        sum(rows[name]["integer_bytes"] for name in parts), rel=1e-4
    )
    q = quantised_of(read_container(data))
    assert symbol_bits(q).shape == q.symbols.shape and not symbol_bits(q)[~q.kept].any()
    assert sum(components(data).values()) == len(data)


def test_heat_follows_the_bits(data):
    """Equal bits, one colour everywhere; one dear anchor, its colour where its Gaussians are."""
    model, bits = anchor_bits(data)
    camera = look_at((2.5, 2.0, 2.2), (0, 0, 0), 60, 60, 40, 40)
    flat = heat_image(model, np.full_like(bits, 100.0), camera, 0.5, (0.0, 200.0), "viridis")
    shade = model.gaussians(0.5, camera)
    seen = np.unique(shade.index // model.design.k)
    assert (
        len(seen) > 3 and np.ptp(flat.reshape(-1, 3), axis=0).max() > 0.05
    )  # the scene is there, over white
    dear = bits * 0 + 100.0
    dear[seen[0]] = 200.0
    changed = np.abs(heat_image(model, dear, camera, 0.5, (0.0, 200.0), "viridis") - flat).max(
        axis=2
    )
    alone = model.anchors.mask & (np.arange(len(bits)) == seen[0])[:, None]
    only = dataclasses.replace(
        model, anchors=model.anchors._replace(mask=alone), background=np.zeros(3)
    )
    covered = heat_image(only, dear, camera, 0.5, (0.0, 200.0), "viridis").min(axis=2) < 0.999
    assert not changed[~covered].max(initial=0) > 1e-3


def test_the_format_page_is_whole():
    out = io.StringIO()
    with redirect_stdout(out):
        print(pages.page())
    text = out.getvalue()
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
    assert all(name in text for name in SECTIONS)
