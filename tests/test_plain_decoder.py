"""The plain decoder: on every conformance stream, on models of the test suite, and on damaged files."""
import ast
import json
import random
import struct
from pathlib import Path

import numpy as np
import pytest

import plain_decoder
from p4dgs_ref.codec.conformance import FOLDER
from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import encode, quantised_of
from test_file import MAKE

MANIFEST = json.loads((FOLDER / "manifest.json").read_text())
FORMATS = {"u8": "B", "u16": "H", "i32": "i", "i64": "q", "f32": "f", "f64": "d"}


def expected_numbers(row):
    """{name: flat list} of a good stream, with `struct` alone."""
    body, numbers = (FOLDER / row["expected"]).read_bytes(), {}
    for entry in row["arrays"]:
        count, at = int(np.prod(entry["shape"])), entry["offset"]
        if entry["type"] == "bit":
            numbers[entry["name"]] = [2 * (body[at + i // 8] >> i % 8 & 1) - 1 for i in range(count)]
        else:
            numbers[entry["name"]] = list(struct.unpack_from(f"<{count}{FORMATS[entry['type']]}", body, at))
    return numbers


@pytest.mark.parametrize("row", MANIFEST["good"], ids=lambda row: row["name"])
def test_good_streams(row):
    found = plain_decoder.decode((FOLDER / row["file"]).read_bytes())
    assert found["header"] == row["header"]
    for name, numbers in expected_numbers(row).items():
        assert list(found[name]) == numbers, name
    assert [x.hex() for x in found["attributes"]] == [x.hex() for x in expected_numbers(row)["attributes"]]


@pytest.mark.parametrize("row", MANIFEST["bad"], ids=lambda row: row["name"])
def test_bad_streams(row):
    with pytest.raises(ValueError) as caught:
        plain_decoder.decode((FOLDER / row["file"]).read_bytes())
    assert caught.value.args[0] == row["section"]


@pytest.mark.parametrize("name", ["random", "no_effects", "turning", "flat", "trained"])
def test_other_models(name):
    data = encode(MAKE[name]())
    found, quantised = plain_decoder.decode(data), quantised_of(read_container(data))
    ctx = quantised.context
    for key, array in (("positions", quantised.positions), ("symbols", quantised.symbols), ("mu_units", ctx.mu_units),
                       ("sigma_units", ctx.sigma_units), ("q", ctx.q), ("x_a", quantised.model.anchors.x_a),
                       ("masks", quantised.model.anchors.mask)):
        assert list(found[key]) == array.ravel().tolist(), key


def test_every_truncation_and_many_flips_are_refused():
    data = (FOLDER / "one_anchor.p4dgs").read_bytes()
    rng = random.Random(1)
    flips = [data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1:] for at in range(len(data))]
    for bad in [data[:n] for n in range(len(data))] + flips + [data + b"\0"]:
        with pytest.raises(ValueError) as caught:
            plain_decoder.decode(bad)
        assert len(caught.value.args) == 2


def test_it_is_short_and_stands_alone():
    text = Path(plain_decoder.__file__).read_text(encoding="utf-8")
    names = {alias.name if isinstance(node, ast.Import) else node.module for node in ast.walk(ast.parse(text))
             if isinstance(node, (ast.Import, ast.ImportFrom)) for alias in node.names}
    assert names == {"json", "struct", "zlib", "bisect", "itertools", "math", "pathlib"}
    assert len(text.splitlines()) <= 200
