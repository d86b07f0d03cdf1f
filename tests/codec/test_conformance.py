"""The conformance streams: how they are built, and how they are decoded or refused."""

import hashlib
import json
import re
from os.path import commonprefix
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref.codec import context, file, header
from p4dgs_ref.codec.container import SECTIONS, BitstreamError, layout, read_container
from p4dgs_ref.codec.file import NETWORK_SECTIONS, decode, encode, quantised_of
from p4dgs_ref.equations import prior
from p4dgs_ref.model import join
from p4dgs_ref.oracle.streams import STREAMS
from p4dgs_ref.report.inspect import ledger
from tests.codec.models import ENDS_OF_RANGES, refusal, with_field
from tests.workshop import conformance
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


def first_difference(name, made, kept):
    """The section of a file and the byte in it that differ first."""
    parts = {"the file": (made, kept)}
    if name.removesuffix(".p4dgs") in GOOD:
        written, wanted = sections_in(made), sections_in(kept)
        parts = {f"section {key}": (written.get(key, b""), wanted[key]) for key in wanted} | parts
    for part, (one, other) in parts.items():
        if one != other:
            return f"{name}: {part}, byte {len(commonprefix([one, other]))} of {len(other)}"
    return ""


def test_the_builder_writes_the_published_bytes(tmp_path, capsys):
    """The first message names the section and the byte, the smallest stream first."""
    new, rows = tmp_path / "new", [*GOOD.values(), *BAD.values()]
    conformance.main(["-o", str(new)])
    assert capsys.readouterr().out.startswith(f"{new}: ")
    names = [row[key] for row in rows for key in ("file", "expected") if key in row]
    for name in [*names, "manifest.json"]:
        different = first_difference(name, (new / name).read_bytes(), read(name))
        assert not different, different
    for folder in (new, STREAMS):
        assert {path.name for path in folder.iterdir()} == {*names, "manifest.json"}
    assert sum(path.stat().st_size for path in STREAMS.iterdir()) <= 260_000
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


@pytest.mark.parametrize("name, value, allowed", ENDS_OF_RANGES)
def test_the_header_ends_where_the_page_says(name, value, allowed):
    """A file with another header may be refused by its other sections."""
    data = with_field(read("one_anchor.p4dgs"), name, value)
    try:
        decode(data)
    except BitstreamError as error:
        assert (error.section != "header") == allowed, error
    else:
        assert allowed


def test_a_header_has_at_most_2_to_the_14_bytes():
    section = bytes(read_container(read("one_anchor.p4dgs"))["header"])
    assert header.read_header(section.ljust(2**14))[1] == 1
    with pytest.raises(BitstreamError, match="16385 bytes"):
        header.read_header(section.ljust(2**14 + 1))


def test_worked_numbers_of_the_format_page():
    """The page states them, and the codec computes them."""
    weights, bias = np.float16([[0.5], [-0.3]]).astype(float), np.float16([0.1]).astype(float)
    (layer,) = context.integer_layers([weights], [bias])
    x = np.array([[16384.0, -8192.0]])
    assert context.run_network(x, [layer]) == 456327168 and layer.bound == 966393856
    hidden = context.round_off(context.run_network(x, [layer]), layer.s)
    assert hidden == 1782528 and layer.bound + 2**layer.s // 2 >> layer.s == 3774976

    level = SimpleNamespace(grid=(("xy", 3),), F=1)
    signs = np.array([[1], [1], [1], [1], [-1], [1], [-1], [1], [1]])
    assert context.hash_feature(np.array([[20000, 50000, 7]]), [signs], level) == 375

    # A group has one column, whose mean is y and whose raw deviation is -3.5.
    groups = SimpleNamespace(Q_0=(0.1, 0.1, 0.1, 0.1), widths=(1, 1, 1, 1))
    mu_columns, _ = prior.layout(groups.widths)
    psi_q = context.integer_layers([np.tile(weights, 4)], [np.tile(bias, 4)])
    is_mean = np.isin(np.arange(8), mu_columns)
    psi_p = context.integer_layers([weights * is_mean], [np.where(is_mean, bias, -3.5)])
    q, mu_units, sigma_units = context.context_of(x, psi_q, psi_p, groups)
    assert (q == 45913 * (0.1 * 2.0**-15)).all() and (q == 0.1401153564453125).all()
    assert (mu_units == 3106).all() and (sigma_units == -35).all()
    assert -1.5 + 20000 * (3 / 65535) == -0.5844586861982147

    of_network = ("y = 456327168", "966393856", "x = 1782528", "X = 3774976")
    of_context = ("h = 375", "q_units = 45913", "q = 0.1401153564453125", "mu_units = 3106")
    pages = {
        context: (*of_network, *of_context, "sigma_units = -35"),
        file: ("-0.5844586861982147", "absent if nothing moves"),
        # What authors of decoders had to guess.
        header: ("Time is bounded by n,",),
    }
    for module, texts in pages.items():
        page = " ".join(module.__doc__.split())
        for text in texts:
            assert text in page, f"{module.__name__} does not say {text!r}"
