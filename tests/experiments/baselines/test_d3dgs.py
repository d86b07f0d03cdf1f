"""D3DGS: its pipeline and gradients, training, presets, and its file."""

import io
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from p4dgs_ref.lab import baselines
from p4dgs_ref.lab.baselines import d3dgs
from p4dgs_ref.training.progress import Progress
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.watch import NotFinite

from . import small

SMALL = small.SMALL["d3dgs"]
random_parameters = partial(small.random_parameters, "d3dgs")
model_of = partial(small.model_of, "d3dgs")


# --- pipeline ---


def test_the_pipeline_against_a_loop():
    """Gaussian by Gaussian, from the formulas at the head of the module."""
    p, x_c, t = random_parameters(3), np.array([2.0, 1.0, -1.0]), 0.7
    g = model_of(p).predict(t, x_c)[0]
    time = [t, np.sin(t), np.cos(t), np.sin(2 * t), np.cos(2 * t)]
    W, b = p.network("psi_t")
    for n, x in enumerate(p["x"]):
        seen = np.maximum(time @ W[0] + b[0], 0) @ W[1] + b[1]
        inputs = np.concatenate([x, np.sin(x), np.cos(x), seen])
        V, c = p.network("psi_d")
        hidden = np.maximum(inputs @ V[0] + c[0], 0)
        hidden = np.maximum(hidden @ V[1] + c[1], 0)
        hidden = np.maximum(np.concatenate([inputs, hidden]) @ V[2] + c[2], 0)
        delta_x, delta_s, delta_r = (hidden @ V[i] + c[i] for i in (3, 4, 5))
        r = p["raw_r"][n] / np.linalg.norm(p["raw_r"][n]) + delta_r
        assert g.x[n] == pytest.approx(x + delta_x, rel=1e-12)
        assert g.s[n] == pytest.approx(np.exp(p["log_s"][n]) + delta_s, rel=1e-12)
        assert g.r[n] == pytest.approx(r / np.linalg.norm(r), rel=1e-12)
        assert g.alpha[n] == pytest.approx(1 / (1 + np.exp(-p["logit_alpha"][n])), rel=1e-12)


# --- training ---


def test_a_number_that_is_not_finite_is_named(scene):
    trainer = d3dgs.Trainer(scene, SMALL)
    trainer.parameters["sh_dc"][3] = np.nan
    with np.errstate(all="ignore"), pytest.raises(NotFinite, match="iteration 0: .*is nan"):
        trainer.step()


def test_annealed_noise_of_the_time(scene):
    """None on synthetic scenes; on real ones it fades to none."""
    view, count = scene.train[0], len(scene.train)
    quiet = d3dgs.Trainer(scene, SMALL)
    assert quiet.time_of(view) == view.time
    noisy = d3dgs.Trainer(scene, replace(SMALL, time_noise=0.1, noise_until=20))
    for iteration, size in ((0, 0.1), (10, 0.05), (20, 0), (25, 0)):
        noisy.iteration = iteration
        drawn = [noisy.time_of(view) - view.time for _ in range(2000)]
        assert np.std(drawn) == pytest.approx(size / count, rel=0.06)
        assert abs(np.mean(drawn)) <= 0.1 * size / count


def test_training_by_name(scene):
    """The same model as from the Trainer, and a progress line that calls things by their names."""
    stream = io.StringIO()
    changes = dict(gaussians="30", iterations=12, warm_up=4)
    model = baselines.train(scene, "d3dgs_small", seed=2, report=Progress(stream), **changes)
    preset = replace(d3dgs.TINY_SMALL, gaussians=30, iterations=12, warm_up=4)
    wanted = d3dgs.Trainer(scene, preset, 2).run()
    assert np.array_equal(model.parameters.vector, wanted.parameters.vector)
    lines = stream.getvalue().splitlines()
    assert "stage 1" in lines[0] and "stage 2" in lines[-1]
    assert all("30 stored  30 Gaussians" in line for line in lines)


# --- presets ---
def test_the_network_has_the_size_of_the_authors():
    """522,280 parameters for synthetic scenes."""
    p = Parameters(
        d3dgs.D3DGS.initial(replace(d3dgs.PAPER_SYNTHETIC, gaussians=5), np.random.default_rng(0))
    )
    assert sum(a.size for name, a in p.arrays.items() if name.startswith("psi")) == 522_280
    assert sum(p[name].size for name in p.arrays if not name.startswith("psi")) == 5 * 59


@pytest.mark.parametrize(
    "method, preset, changes, words",
    [
        ("gsplat", None, {}, "method 'gsplat': expected one of d3dgs"),
        ("d3dgs", "huge", {}, "preset 'huge': expected one of paper_synthetic"),
        ("d3dgs", None, {"anchors": 3}, "field 'anchors' of preset tiny"),
        ("d3dgs", None, {"name": "x"}, "field 'name' of preset tiny"),
        ("d3dgs", None, {"gaussians": 2.5}, "field 'gaussians': expected a value like"),
    ],
)
def test_unknown_names_and_values(method, preset, changes, words):
    with pytest.raises(ValueError, match=words) as caught:
        baselines.choose(method, preset, changes)
    assert "\n" not in str(caught.value)


# --- file ---


def test_the_vertices_are_those_of_3dgs(trained, tmp_path):
    """62 floats in the order of the authors, the harmonics colour by colour."""
    trained["d3dgs"].save(tmp_path / "a.ply")
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == [
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    N, p = trained["d3dgs"].primitives, trained["d3dgs"].parameters
    rows = np.frombuffer(body, "<f4", len(names) * N).reshape(N, len(names))
    assert np.array_equal(rows[:, :3], p["x"]) and not np.any(rows[:, 3:6])
    assert np.array_equal(rows[:, 9 + 15 + 2], p["sh_rest"][:, 1, 2])
    assert np.array_equal(rows[:, 54], p["logit_alpha"])
    assert np.array_equal(rows[:, 58:], p["raw_r"])


# What stands in the header of a file, and what no file of a baseline has in its place.
EDITS = {
    b'"method"': b'"methods"',
    b'"form"': b'"from"',
    b'"rows"': b'"row"',
    b'"background": [1.0,': b'"background": [',
    b'"logit_alpha": []': b'"logit_beta": []',
    b"property float y\n": b"",
    b"comment {": b"comment [",
}


@pytest.mark.parametrize("method", ["d3dgs", "hexplane", "gaussian4d"])
def test_bad_files(trained, tmp_path, method):
    path = tmp_path / "a.ply"
    trained[method].save(path)
    data = path.read_bytes()
    nan = data.replace(b"end_header\n", b"end_header\n" + np.float32("nan").tobytes())[:-4]
    cut = b"", b"ply\n", data[:-1], data[:-4], data + b"1234", data[:600], b"x" + data, nan
    edited = [data.replace(old, new) for old, new in EDITS.items()]
    assert data not in edited
    for bad in (*cut, *edited, data.replace(method.encode(), b"x", 1)):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match="a.ply: ") as caught:
            baselines.load(path)
        assert "\n" not in str(caught.value)
