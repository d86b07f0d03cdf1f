"""The conformance streams: how they are built, and how they are decoded or refused.

By this project's decoder and by the plain one, which also reads the models of the tests.
"""

import ast
import hashlib
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.codec import context, file, header
from p4dgs_ref.codec.container import SECTIONS, BitstreamError, layout, read_container
from p4dgs_ref.codec.file import NETWORK_SECTIONS, decode, encode, quantised_of
from p4dgs_ref.model import join
from p4dgs_ref.oracle.streams import STREAMS
from p4dgs_ref.report.inspect import ledger
from tests.codec.models import ENDS_OF_RANGES, MAKE, refusal, with_field
from tests.sampling import few
from tests.workshop import conformance, plain_decoder
from tests.workshop.damage import sections_in

MANIFEST = json.loads((STREAMS / "manifest.json").read_text(encoding="utf-8"))
GOOD, BAD = ({row["name"]: row for row in MANIFEST[key]} for key in ("good", "bad"))


def read(name):
    return (STREAMS / name).read_bytes()


def arrays_of(row):
    """The expected arrays of a good stream, {name: array}, read as the manifest describes them."""
    body, arrays, end = read(row["expected"]), {}, 0
    for entry in row["arrays"]:
        count, start = int(np.prod(entry["shape"])), entry["offset"]
        assert start == end
        if entry["type"] == "bit":
            end += (count + 7) // 8
            array = np.unpackbits(np.frombuffer(body[start:end], np.uint8), bitorder="little")
            assert not array[count:].any()
        else:
            kind = np.dtype(f"<{entry['type'][0]}{int(entry['type'][1:]) // 8}")
            end += count * kind.itemsize
            array = np.frombuffer(body[start:end], kind)
        assert hashlib.sha256(body[start:end]).hexdigest() == entry["sha256"], entry["name"]
        arrays[entry["name"]] = array[:count].reshape(entry["shape"])
    assert end == len(body)
    return arrays


# The encoder writes other bytes for these: it drops an anchor, stores 0 where the box has no
# extent, or chooses another number of lanes.
NOT_OURS = {"all_masked_but_one", "one_anchor", "lanes"}
KINDS = {
    "length": r"total length|at least 18 bytes|add up to|expected \d+ bytes",
    "magic": "wrong magic",
    "version": "version [23], expected 1",
    "checksum": "checksum",
    "table": "ascending ids|lengths of",
    "missing": "section is missing",
    "unexpected": "no effect that needs",
    "header": "expected",
    "number": "finite",
    "stream": r"left over|the data end before|state \d+|lane|tail|probability|symbol|an escape",
}


def test_the_builder_writes_the_published_bytes(tmp_path, capsys):
    new = tmp_path / "new"
    conformance.main(["-o", str(new)])
    assert capsys.readouterr().out.startswith(f"{new}: ")
    names = sorted(path.name for path in STREAMS.iterdir())
    assert sorted(path.name for path in new.iterdir()) == names
    for name in names:
        assert (new / name).read_bytes() == read(name), name
    assert sum(len(read(name)) for name in names) <= 260_000
    files = [
        row[key]
        for row in [*GOOD.values(), *BAD.values()]
        for key in ("file", "expected")
        if key in row
    ]
    assert sorted([*files, "manifest.json"]) == names
    assert len(GOOD) == len(MANIFEST["good"]) and len(BAD) == len(MANIFEST["bad"])


@pytest.mark.parametrize("name", GOOD)
def test_good_streams_decode_to_what_is_expected(name):
    row, data = GOOD[name], read(GOOD[name]["file"])
    assert (len(data), hashlib.sha256(data).hexdigest()) == (row["bytes"], row["sha256"])
    sections = sections_in(data)
    assert {key: len(body) for key, body in sections.items()} == row["sections"]
    assert json.loads(sections["header"]) == row["header"]
    assert sum(size for _, size in layout(data)) == len(data)
    expected, found = arrays_of(row), quantised_of(read_container(data))
    model, ctx = decode(data), found.context
    anchors, signs = model.anchors, np.concatenate([grid.ravel() for grid in model.grids])
    values = {
        "positions": found.positions,
        "symbols": found.symbols,
        "masks": anchors.mask,
        "x_a": anchors.x_a,
        "signs": signs > 0,
        "mu_units": ctx.mu_units,
        "sigma_units": ctx.sigma_units,
        "q": ctx.q,
        "attributes": join(anchors),
    }
    for section, members in NETWORK_SECTIONS.items():
        networks = [model.networks[name] for name in members if name in model.networks]
        layers = [layer for network in networks for layer in zip(*network)]
        if layers:
            values[section] = np.concatenate([np.append(W, b) for W, b in layers])
    assert set(expected) == {*values, "h", "q_units"}
    for key, value in values.items():
        assert value.shape == expected[key].shape, key
        assert np.array_equal(value, expected[key]), key
    # also the sign of zero
    assert values["attributes"].tobytes() == expected["attributes"].tobytes()
    q = expected["q_units"] * (np.array(model.design.Q_0) * 2.0**-15)
    assert np.array_equal(expected["q"], q)
    assert np.abs(expected["h"]).max() <= 2**15
    assert all(np.isfinite(row["bytes"]) for row in ledger(data))
    again = encode(model)
    assert (again == data) == (name not in NOT_OURS)
    assert encode(decode(again)) == again


@pytest.mark.parametrize("name", BAD)
def test_bad_streams_are_refused_where_they_are_bad(name):
    row, data = BAD[name], read(BAD[name]["file"])
    assert (len(data), hashlib.sha256(data).hexdigest()) == (row["bytes"], row["sha256"])
    assert row["section"] in (*SECTIONS, "container")
    for reader in (decode, ledger):
        error = refusal(reader, data)
        assert error.section == row["section"] and row["offset"] in (None, error.offset)
        assert re.search(KINDS[row["kind"]], error.message)


def test_every_kind_of_error_has_a_stream():
    assert len(GOOD) >= 12 and set(KINDS) == {row["kind"] for row in BAD.values()}


@pytest.mark.parametrize("name", GOOD)
def test_the_plain_decoder_finds_what_is_expected(name):
    found = plain_decoder.decode(read(GOOD[name]["file"]))
    assert found["header"] == GOOD[name]["header"]
    expected = {key: array.ravel() for key, array in arrays_of(GOOD[name]).items()}
    expected["signs"] = 2 * expected["signs"].astype(int) - 1
    for key, numbers in expected.items():
        assert list(found[key]) == numbers.tolist(), key
    # also the sign of zero
    assert np.array(found["attributes"], float).tobytes() == expected["attributes"].tobytes()


@pytest.mark.parametrize("name", BAD)
def test_the_plain_decoder_refuses_bad_streams(name):
    row = BAD[name]
    with pytest.raises(ValueError) as caught:
        plain_decoder.decode(read(row["file"]))
    assert caught.value.args[0] == row["section"]


@pytest.mark.parametrize("name, value, allowed", ENDS_OF_RANGES)
def test_the_header_ends_where_the_page_says(name, value, allowed):
    """A file with another header may be refused by its other sections."""
    data = with_field(read("one_anchor.p4dgs"), name, value)
    for reader, refused in ((decode, BitstreamError), (plain_decoder.decode, ValueError)):
        try:
            reader(data)
        except refused as error:
            section = getattr(error, "section", error.args[0])
            assert (section != "header") == allowed, error
        else:
            assert allowed


@pytest.mark.parametrize("name", few(["random", "no_effects", "turning", "flat", "trained"], 2))
def test_the_plain_decoder_reads_other_models(name):
    data = encode(MAKE[name]())
    found, quantised = plain_decoder.decode(data), quantised_of(read_container(data))
    ctx = quantised.context
    for key, array in (
        ("positions", quantised.positions),
        ("symbols", quantised.symbols),
        ("mu_units", ctx.mu_units),
        ("sigma_units", ctx.sigma_units),
        ("q", ctx.q),
        ("x_a", quantised.model.anchors.x_a),
        ("masks", quantised.model.anchors.mask),
    ):
        assert list(found[key]) == array.ravel().tolist(), key


def test_a_header_has_at_most_2_to_the_14_bytes():
    section = bytes(read_container(read("one_anchor.p4dgs"))["header"])
    assert header.read_header(section.ljust(2**14))[1] == 1
    with pytest.raises(BitstreamError, match="16385 bytes"):
        header.read_header(section.ljust(2**14 + 1))


def test_worked_numbers_of_the_format_page():
    """The plain decoder computes the worked numbers, and the page states them."""
    grid = {"grid": [("xy", 3)], "F": 1, "Q_0": [0.1]}
    signs = [1, 1, 1, 1, -1, 1, -1, 1, 1]
    assert plain_decoder.hash_feature((20000, 50000, 7), grid, [signs]) == [375]
    numbers = struct.unpack("<3e", struct.pack("<3e", 0.5, -0.3, 0.1))
    output = plain_decoder.run_network([16384, -8192], (2, 1), numbers)
    assert output == ([456327168], 30, 966393856)
    halved = plain_decoder.run_network([16384, -8192], (2, 1, 1), (*numbers, 1.0, 0.0))
    assert halved == ([1782528 << 14], 36, 3774976 << 14)  # n is 14 for a weight of 1
    layers = {"psi_p": ([456327168, -229376 << 14], 30, 966393856), "psi_q": ([456327168], 30, 0)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain_decoder, "run_network", lambda x, name: layers[name])
        found = plain_decoder.context((20000, 50000, 7), grid, [signs], [1], ["psi_p"], ["psi_q"])
    assert found == ([375], [45913], [3106], [-35])
    assert 45913 * (0.1 * 2.0**-15) == 0.1401153564453125
    assert -1.5 + 20000 * (3 / 65535) == -0.5844586861982147
    of_network = ("y = 456327168", "966393856", "x = 1782528", "X = 3774976")
    of_context = ("h = 375", "q_units = 45913", "q = 0.1401153564453125", "mu_units = 3106")
    pages = {
        context: (*of_network, *of_context, "sigma_units = -35"),
        file: ("-0.5844586861982147", "absent where nothing moves"),
        # What authors of decoders had to guess.
        header: ("Time is bounded by n,",),
    }
    for module, texts in pages.items():
        page = " ".join(module.__doc__.split())
        assert all(text in page for text in texts), module.__name__


def test_the_plain_decoder_is_short_and_uses_nothing_of_the_package():
    tree = ast.parse(Path(plain_decoder.__file__).read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    assert names == {"json", "struct", "zlib", "bisect", "itertools", "math", "pathlib"}
    assert sum(isinstance(node, ast.stmt) for node in nodes) <= 300
