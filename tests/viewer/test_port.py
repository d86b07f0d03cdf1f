"""The port in JavaScript: the oracle's verdict on it, damaged files, pictures. It needs node."""

import base64
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.oracle import checker, streams
from p4dgs_ref.oracle.adapter import Adapter
from p4dgs_ref.report.inspect import anchor_bits, components
from tests import ROOT
from tests.codec.models import ENDS_OF_RANGES, with_field
from tests.workshop import needles
from tests.workshop.damage import mutation

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
VIEWER = Path(p4.__file__).parent / "viewer"
DEMO = ROOT / "tutorials" / "demo.p4dgs"
# Arguments: the folder and a file. Input: views. Output: each picture, exact, nearly so, and as
# bytes of the page's canvas; the bits of each anchor; bytes of sections if steps were doubled.
DRAW = """
const { readFileSync } = require("fs");
const [p4dgs, draw, { anchorBits, requantise }] = ["p4dgs", "draw", "requantise"].map(
  (name) => require(`${process.argv[1]}/${name}.js`),
);
const data = new Uint8Array(readFileSync(process.argv[2]));
const model = p4dgs.decode(data);
const pictures = (view) => [
  ...[0, 1e-13].map((least) => [...p4dgs.render(model, view, view.t, { least })]),
  [...draw.onProcessor(draw.see(model, view, view.t).splats, draw.settings(model, view))],
];
const drawn = JSON.parse(readFileSync(0)).map(pictures);
const coarse = requantise(model, { coarser: 2 }).bytes;
console.log(JSON.stringify({ drawn, coarse, bits: [...anchorBits(model)] }));
"""

# Input: a needle and its camera. Output: its picture, exact and nearly so.
NEEDLE = """
const p4dgs = require(`${process.argv[1]}/p4dgs.js`);
const { x, s, r, background, camera, ...looks } = JSON.parse(require("fs").readFileSync(0));
const [x_t, s_t, r_t] = [x, s, r].map((rows) => Float64Array.from(rows.flat()));
const [alpha, color] = [looks.alpha, looks.color].map((a) => Float64Array.from(a.flat()));
const splats = p4dgs.splatting({ alpha, color }, { x_t, s_t, r_t }, camera);
const drawn = [0, 1e-13].map((least) => {
  const scene = { background, size: camera.size, occlusion: true, least };
  return [...p4dgs.compositing(splats, scene).image];
});
console.log(JSON.stringify(drawn));
"""

# Arguments: the folder and a file. Output: the factors of weights that are changed; how far the
# mean over t of psi_d's first layer moves where it sees one frequency, and how far the layer does.
BROKEN = """
const [p4dgs, { requantise }] = ["p4dgs", "requantise"].map(
  (name) => require(`${process.argv[1]}/${name}.js`),
);
const data = new Uint8Array(require("fs").readFileSync(process.argv[2]));
const model = p4dgs.decode(data);
const broken = (how) => requantise(model, how).model.networks;
const weights = (networks) => Object.values(networks).flat().flatMap(({ W, b }) => [...W, ...b]);
const own = weights(model.networks);
const factors = weights(broken({ weight: true })).map((w, i) => w / own[i]);
const [first, other] = [model.networks, broken({ frequency: true })].map(({ psi_d }) => psi_d[0]);
const { L_x, L_t } = model.header;
const x = p4dgs.positionalEncoding([0.1, 0.2, 0.3], 3, L_x);
const gaps = Array.from({ length: 1000 }, (_, i) => {
  const E = Float64Array.from([...x, ...p4dgs.positionalEncoding([(i + 0.5) / 1000], 1, L_t)]);
  const [was, is] = [first, other].map((layer) => p4dgs.mlp([layer], E, 1));
  return was.map((v, j) => is[j] - v);
});
const mean = gaps[0].map((_, j) => gaps.reduce((sum, gap) => sum + gap[j] / 1000, 0));
const most = (values) => Math.max(...values.map(Math.abs));
const changed = factors.filter((factor) => factor !== 1 && !Number.isNaN(factor));
console.log(JSON.stringify({ changed, mean: most(mean), gap: most(gaps.map(most)) }));
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
    assert len({r.subject for r in answered}) == 30
    assert {r.id for r in answered if r.verdict != "pass"} == {"frames/paper_settings"}
    assert found.ok and "the port gives no gradients: only outputs were judged" in str(found)


def test_bad_streams_are_refused_where_they_are_bad(port):
    for row in streams.read_rows()["bad"]:
        said = answer(port, (streams.STREAMS / row["file"]).read_bytes())
        asked = [field for field in ("section", "kind", "offset") if row[field] is not None]
        assert {field: said[field] for field in asked}.items() <= row.items(), row["name"]


def test_headers_end_where_the_page_says(port):
    least = (streams.STREAMS / "one_anchor.p4dgs").read_bytes()
    for name, value, allowed in ENDS_OF_RANGES:
        said = answer(port, with_field(least, name, value))
        assert (said.get("section") != "header") == allowed, (name, value)


@pytest.mark.parametrize("n", [100, pytest.param(2000, marks=pytest.mark.slow)])
def test_damaged_files_get_the_verdict_of_the_package(port, n):
    files = [(streams.STREAMS / row["file"]).read_bytes() for row in streams.read_rows()["good"]]
    for i in range(n):
        data = mutation(n, i, files).data
        try:
            p4.decode(data)
        except p4.BitstreamError as error:
            assert answer(port, data).get("section") == error.section, i
        else:
            assert "arrays" in answer(port, data), i


def described(camera):
    """A camera as the port takes it."""
    return {
        "W": camera.R.ravel().tolist(),
        "T": camera.T.tolist(),
        "focal": [camera.f_x, camera.f_y],
        "center": [camera.c_x, camera.c_y],
        "size": [camera.width, camera.height],
    }


@pytest.mark.parametrize("ratio", needles.RATIOS)
def test_needles_have_all_their_digits(ratio):
    gaussians, _ = needles.needle(ratio)
    asked = {name: a.tolist() for name, a in gaussians.items()}
    asked["camera"] = described(needles.CAMERA)
    said = subprocess.check_output(
        ["node", "-e", NEEDLE, VIEWER], input=json.dumps(asked), encoding="utf-8"
    )
    for drawn in json.loads(said):
        image, _ = needles.truth(ratio)
        np.testing.assert_allclose(drawn, image.ravel(), rtol=1e-12)


@pytest.mark.slow
def test_pictures_and_bits_are_those_of_the_package():
    model, views = p4.decode(DEMO.read_bytes()), p4.load_scene("orbit").test[::3]
    asked = [{**described(view.camera), "t": view.time} for view in views]
    said = json.loads(
        subprocess.check_output(
            ["node", "-e", DRAW, VIEWER, DEMO], input=json.dumps(asked), encoding="utf-8"
        )
    )
    for (exact, nearly, canvas), view in zip(said["drawn"], views, strict=True):
        image = np.clip(model.render(view.camera, view.time, p4.SETTINGS["exact"]), 0, 1)
        np.testing.assert_allclose([exact, nearly], 2 * [image.ravel()], rtol=0, atol=1e-9)
        shown = np.reshape(canvas, (*image.shape[:2], 4))[..., :3]
        np.testing.assert_allclose(shown, 255 * image, rtol=0, atol=1)
    np.testing.assert_allclose(said["bits"], anchor_bits(DEMO.read_bytes())[1], rtol=1e-12)
    coarse = replace(model.design, Q_0=tuple(2 * q for q in model.design.Q_0))
    sizes = components(p4.encode(replace(model, design=coarse)))
    for name in ("features", "scales", "offset_scales", "offsets"):
        assert abs(said["coarse"][name] - sizes[name]) <= 3, name


@pytest.mark.slow
def test_one_weight_is_16_times_as_large_and_one_frequency_has_the_mean_of_all():
    found = json.loads(subprocess.check_output(["node", "-e", BROKEN, VIEWER, DEMO]))
    assert found["changed"] == [16] and found["mean"] < 1e-6 and found["gap"] > 0.1, found
