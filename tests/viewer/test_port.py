"""The port in JavaScript: the oracle's verdict on it, damaged files, pictures. It needs node."""

import base64
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec.published import FOLDER
from p4dgs_ref.oracle import checker, streams
from p4dgs_ref.oracle.adapter import Adapter
from tests.golden.damage import mutation

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
VIEWER = Path(p4.__file__).parent / "viewer"
DEMO = Path(__file__).parents[2] / "tutorials" / "demo.p4dgs"
# Arguments: the module and a file. Input: views. Output: each picture, exact and as it is shown.
DRAW = """
const { readFileSync } = require("fs");
const [p4dgs, views] = [require(process.argv[1]), JSON.parse(readFileSync(0))];
const model = p4dgs.decode(new Uint8Array(readFileSync(process.argv[2])));
const draw = (view) => [0, 1e-13].map((least) => [...p4dgs.render(model, view, view.t, { least })]);
console.log(JSON.stringify(views.map(draw)));
"""


@pytest.fixture(scope="module")
def port():
    with Adapter(f"node {VIEWER / 'adapter.js'}", timeout=60) as port:
        yield port


def answer(port, data):
    """What the port says of a file, also the section of its refusal."""
    request = {"id": "codec/damaged", "stream": base64.b64encode(data).decode()}
    return port._ask(request, "codec")


def test_every_subject_and_stream_of_the_port_is_right(port):
    found = checker.check_port(port)
    answered = [r for r in found.results if r.verdict != "absent"]
    assert len({r.subject for r in answered}) == 29
    assert {r.id for r in answered if r.verdict != "pass"} == {"frames/paper_settings"}
    assert found.ok and "the port answers no gradients: outputs alone were judged" in str(found)


def test_bad_streams_are_refused_where_they_are_bad(port):
    for row in streams.read_rows()["bad"]:
        said = answer(port, (FOLDER / row["file"]).read_bytes())
        asked = [field for field in ("section", "kind", "offset") if row[field] is not None]
        assert {field: said[field] for field in asked}.items() <= row.items(), row["name"]


@pytest.mark.parametrize("n", [100, pytest.param(2000, marks=pytest.mark.slow)])
def test_damaged_files_get_the_verdict_of_the_package(port, n):
    files = [(FOLDER / row["file"]).read_bytes() for row in streams.read_rows()["good"]]
    for i in range(n):
        data = mutation(n, i, files).data
        try:
            p4.decode(data)
        except p4.BitstreamError as error:
            assert answer(port, data).get("section") == error.section, i
        else:
            assert "arrays" in answer(port, data), i


def test_pictures_are_those_of_the_package():
    model, views = p4.decode(DEMO.read_bytes()), p4.load_scene("orbit").test
    asked = [
        {
            "W": view.camera.R.ravel().tolist(),
            "T": view.camera.T.tolist(),
            "t": view.time,
            "focal": [view.camera.f_x, view.camera.f_y],
            "center": [view.camera.c_x, view.camera.c_y],
            "size": [view.camera.width, view.camera.height],
        }
        for view in views
    ]
    exact = [model.render(view.camera, view.time, p4.SETTINGS["exact"]) for view in views]
    said = subprocess.check_output(
        ["node", "-e", DRAW, VIEWER / "p4dgs.js", DEMO], input=json.dumps(asked), text=True
    )
    want = [2 * [np.clip(image, 0, 1).ravel()] for image in exact]
    np.testing.assert_allclose(json.loads(said), want, rtol=0, atol=1e-9)
