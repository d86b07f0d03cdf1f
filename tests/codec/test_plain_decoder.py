"""The plain decoder on all conformance streams, on models of the tests, and on damaged files."""

import ast
import struct
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.codec import context, file, fixed_point
from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import encode, quantised_of
from tests.codec.models import CODED, MAKE
from tests.codec.streams import BAD, GOOD, arrays_of, read
from tests.golden import plain_decoder
from tests.sampling import few


@pytest.mark.parametrize("name", GOOD)
def test_good_streams(name):
    found = plain_decoder.decode(read(GOOD[name]["file"]))
    assert found["header"] == GOOD[name]["header"]
    expected = {key: array.ravel() for key, array in arrays_of(GOOD[name]).items()}
    expected["signs"] = 2 * expected["signs"].astype(int) - 1
    for key, numbers in expected.items():
        assert list(found[key]) == numbers.tolist(), key
    # also the sign of zero
    assert np.array(found["attributes"], float).tobytes() == expected["attributes"].tobytes()


@pytest.mark.parametrize("row", BAD.values(), ids=BAD)
def test_bad_streams(row):
    with pytest.raises(ValueError) as caught:
        plain_decoder.decode(read(row["file"]))
    assert caught.value.args[0] == row["section"]


PAPER = {name: MAKE[name] for name in ("random", "no_effects", "turning", "flat", "trained")}


@pytest.mark.parametrize("make", few([*PAPER.values(), *CODED.values()], 6))
def test_other_models(make):
    data = encode(make())
    found, quantised = plain_decoder.decode(data), quantised_of(read_container(data), data[8])
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
    of_context = ("h = 375", "q_units = 45913", "q = 0.1401153564453125", "mu_units = 3106")
    pages = {
        context: (*of_context, "sigma_units = -35"),
        fixed_point: ("y = 456327168", "966393856", "x = 1782528", "X = 3774976"),
        file: ("-0.5844586861982147",),
    }
    for module, texts in pages.items():
        page = " ".join(module.__doc__.split())
        assert all(text in page for text in texts), module.__name__


def test_it_is_short_and_uses_nothing_of_the_package():
    tree = ast.parse(Path(plain_decoder.__file__).read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    assert names == {"json", "struct", "zlib", "bisect", "itertools", "math", "pathlib"}
    assert sum(isinstance(node, ast.stmt) for node in nodes) <= 380  # of both versions
