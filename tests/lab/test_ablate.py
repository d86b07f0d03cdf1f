"""The ablation and the composition: each step differs in its one part, and the files are real."""

import dataclasses

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.lab import baselines
from p4dgs_ref.lab.tables import ablate as study
from p4dgs_ref.lab.tables import composition, methods, plain_file
from p4dgs_ref.lab.tables.methods import OURS, StudyError, Task
from p4dgs_ref.report.evaluate import evaluate

TABLE_3 = [
    "D3DGS",
    "+ spatial prediction",
    "+ compact deformation MLP",
    "+ quantisation and entropy coding",
]


@pytest.fixture(scope="module")
def scene():
    whole = p4.load_scene("bouncing", downscale=8)
    return dataclasses.replace(whole, test=whole.test[:2])


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ablate")
    return folder, study.ablate(scene, folder, 1, 12)


def row_of(done, name):
    folder, result = done
    (row,) = [row for row in result["rows"] if row["step"] == name]
    return row, folder / row["file"]


def model_of(path):
    """The model in a file of any step."""
    if path.suffix == ".ply":
        return baselines.load(path)
    return p4.decode(path.read_bytes()) if path.suffix == ".p4dgs" else plain_file.load(path)


def test_every_row_is_that_of_its_file(done, scene):
    _, result = done
    assert [row["step"] for row in result["rows"]] == [*TABLE_3, *study.LEFT_OUT]
    for row in result["rows"]:
        _, path = row_of(done, row["step"])
        assert path.stat().st_size == row["bytes"]
        assert row["gaussians_bytes"] + row["network_bytes"] + row["other_bytes"] == row["bytes"]
        metrics = evaluate(model_of(path), scene)[0]
        assert metrics["psnr_db"] == pytest.approx(row["psnr_db"], rel=1e-12)


def test_each_step_changes_its_part(done):
    explicit, anchors, compact, whole = (model_of(row_of(done, name)[1]) for name in TABLE_3)
    theirs = baselines.choose("d3dgs")
    assert anchors.design.deformation == theirs.deformation == (256,) * 8
    assert anchors.design.time_net == theirs.time_net and anchors.design.skip
    weights = explicit.parameters.network("psi_d")[0]
    trunk = [W.shape for W in anchors.networks["psi_d"][0][:8]]
    assert trunk == [W.shape for W in weights[:8]]
    assert compact.design.deformation == whole.design.deformation == (64, 64)
    for model, half in ((anchors, False), (compact, True)):
        W = model.networks["psi_d"][0][0]
        assert (W == W.astype(np.float16)).all() == half
        assert (W == W.astype(np.float32)).all()
        W = model.networks["psi_c"][0][0]
        assert (W != W.astype(np.float16)).any()
    sizes = [row_of(done, name)[0]["bytes"] for name in TABLE_3]
    assert sizes == sorted(sizes, reverse=True)


def test_parts_left_out(done, scene):
    whole = row_of(done, TABLE_3[-1])[1]
    found = {name: row_of(done, name)[1] for name in study.LEFT_OUT}
    models = {name: model_of(path) for name, path in found.items()}
    assert "psi_d" in model_of(whole).networks
    assert "psi_d" not in models["no deformation"].networks
    assert models["no masking"].anchors.mask.all()
    base = methods.preset_of(Task(scene, OURS, 0, None, 12))
    context = quantised_of(read_container(found["fixed step"].read_bytes())).context
    steps = (base.Q_f, base.Q_s, base.Q_l, base.Q_O)
    np.testing.assert_allclose(context.q, np.tile(steps, (len(context.q), 1)), rtol=1e-4)
    for name, same in (("global prior", True), ("fixed step", False)):
        context = quantised_of(read_container(found[name].read_bytes())).context
        assert (np.ptp(context.mu_units, axis=0) == 0).all() == same
        assert (np.ptp(context.sigma_units, axis=0) == 0).all() == same


def test_no_noise_before_the_last_step(scene):
    for name in TABLE_3[1:3]:
        preset = study.preset_of(study.Step(name, Task(scene, OURS, 0, None, 400)))
        assert preset.stage(preset.iterations - 1) == 3 and preset.mask_from == 400
        assert max(preset.Q_f, preset.Q_s, preset.Q_l, preset.Q_O) < 1e-12
    preset = study.preset_of(study.Step("no masking", Task(scene, OURS, 0, None, 400)))
    assert preset.mask_from == preset.iterations and preset.stage(399) == 4


def test_savings_are_against_the_step_before():
    rows = [
        {"step": name, "seed": seed, "bytes": size, "psnr_db": psnr + seed, "ssim": 0.9}
        for name, size, psnr in (
            ("D3DGS", 1000, 30.0),
            ("+ spatial prediction", 500, 31.0),
            ("no masking", 600, 31.5),
            ("no deformation", 250, 29.0),
        )
        for seed in (0, 1)
    ]
    first, second, third, last = study.summaries(rows)
    assert first["saved_percent"] is None and first["psnr_db"] == 30.5
    assert (second["saved_percent"], second["psnr_gain"]) == (-50, 1)
    assert third["saved_percent"] == pytest.approx(20) and third["psnr_gain"] == 0.5
    assert (last["saved_percent"], last["psnr_gain"], last["psnr_db_spread"]) == (-50, -2, 0.5)


def test_table_3_shows_the_papers_numbers_apart(done):
    lines = study.describe(done[1]).splitlines()
    assert lines[1].endswith("the paper's MB, %, dB (T-Rex)")
    assert lines[2].startswith("D3DGS") and lines[2].endswith("56.7 - 38.04")
    assert lines[5].endswith("0.85 -84.1 38.24")
    assert lines[6].startswith("ours, fixed step") and lines[6].endswith("- - -")


def test_a_plain_file_renders_like_its_model(scene, tmp_path):
    trainer = p4.train(scene, "smoke", 0)
    exact = dataclasses.replace(
        trainer, anchors=trainer.anchors._replace(mask=np.ones_like(trainer.anchors.mask))
    )
    sizes = plain_file.save(exact, tmp_path / "a")
    assert sum(sizes.values()) == (tmp_path / "a").stat().st_size
    a = exact.anchors
    assert sizes["gaussians"] == 4 * (
        a.x_a.size + a.f_a.size + a.s_a.size + a.l_a.size + a.O_a.size
    )
    view, again = scene.test[0], plain_file.load(tmp_path / "a")
    one, other = (m.render(view.camera, view.time) for m in (exact, again))
    np.testing.assert_allclose(one, other, atol=1e-5)
    assert plain_file.save(exact, tmp_path / "b", ("psi_d",))["network"] < sizes["network"]


def test_composition_sums_to_the_files(scene, tmp_path):
    result = composition.composition(scene, tmp_path, 300.0, 0.0, 12)
    files = sorted(path.stat().st_size for path in tmp_path.glob("*.p4dgs"))
    assert sorted(result["bytes"]) == files and len(files) == 2
    for i in range(2):
        assert sum(row["bytes"][i] for row in result["rows"]) == result["bytes"][i]
        assert sum(row["percent"][i] for row in result["rows"]) == pytest.approx(100)
    rows = {row["component"]: row["bytes"] for row in result["rows"]}
    assert rows["anchor position"][0] == rows["anchor position"][1]
    assert rows["deformation MLP"][0] == rows["deformation MLP"][1] > 0
    assert rows["anchor feature"][0] < rows["anchor feature"][1]  # the low rate stands first
    text = composition.describe(result).splitlines()
    assert text[-1].split() == ["file", *(f"{n:,}" for n in result["bytes"])]
    assert text[1].endswith("the paper's % low  high") and "47.6  26.9" in "\n".join(text)


def test_a_scene_without_test_views(scene, tmp_path):
    empty = dataclasses.replace(scene, test=())
    for job in (study.ablate, composition.composition):
        with pytest.raises(StudyError, match="split 'test': no views"):
            job(empty, tmp_path)
