"""Sweeps: points as jobs of their own, resumed after a kill, one folder for one sweep."""

import csv
import dataclasses
import json

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.lab.baselines import METHODS
from p4dgs_ref.lab.tables import sweep as study
from p4dgs_ref.lab.tables.methods import CODED, StudyError
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.report.inspect import ledger

SETTINGS = {
    "lambdas": (0.0, 300.0),
    "seeds": 2,
    "iterations": 12,
    "names": ["d3dgs_small", "p4dgs_coded"],
}


@pytest.fixture(scope="module")
def scene():
    whole = p4.load_scene("bouncing", downscale=8)
    return dataclasses.replace(whole, test=whole.test[:2])


@pytest.fixture(scope="module")
def swept(scene, tmp_path_factory):
    """The folder, tasks and result of a small sweep; its third point was killed half-way."""
    folder = tmp_path_factory.mktemp("sweep")
    tasks, values = study.plan(scene, folder, *SETTINGS.values())
    study.make_missing(tasks[:3], values)
    study.record(tasks[2]).unlink()
    kept = {task.path: task.path.stat().st_mtime_ns for task in tasks[:3]}
    again, values = study.plan(scene, folder, *SETTINGS.values())
    study.make_missing(again, values)
    changed = [path for path, time in kept.items() if path.stat().st_mtime_ns != time]
    assert changed == [tasks[2].path]
    return folder, tasks, study.collect(tasks, folder)


def table(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_the_csv_has_the_columns_and_rows_of_the_contract(swept, scene):
    folder, tasks, _ = swept
    rows = table(folder / "sweep.csv")
    expected = ["lambda_rate", "seed", "estimated_bytes", "bytes", "psnr_db", "ssim"]
    assert list(rows[0]) == expected
    found = [(float(row["lambda_rate"]), int(row["seed"])) for row in rows]
    assert found == [(0.0, 0), (0.0, 1), (300.0, 0), (300.0, 1)]
    for row, task in zip(rows, tasks):
        data = task.path.read_bytes()
        assert int(row["bytes"]) == len(data)
        metrics = evaluate(p4.decode(data), scene)[0]
        assert float(row["psnr_db"]) == pytest.approx(metrics["psnr_db"], rel=1e-12)
        assert float(row["ssim"]) == pytest.approx(metrics["ssim"], rel=1e-12)
        estimate = sum(part["estimate_bytes"] for part in ledger(data))
        assert abs(int(row["estimated_bytes"]) - estimate) <= 0.5
        assert 0.9 < int(row["estimated_bytes"]) / int(row["bytes"]) < 1
    others = table(folder / "baselines.csv")
    assert [row["method"] for row in others] == 4 * ["p4dgs_coded"] + 2 * ["d3dgs_small"]
    assert [row["lambda_rate"] for row in others] == ["0.0", "0.0", "300.0", "300.0", "", ""]
    assert iio.imread(folder / "sweep.png").std() > 5


def test_the_rate_is_paid_for(swept):
    _, _, result = swept
    free, dear = result["curve"]
    assert free["lambda_rate"] == 0 and dear["anchor_bytes"] < 0.99 * free["anchor_bytes"]
    assert result["points"] == 10 and result["missing"] == 0 and free["seeds"] == 2


def test_the_coded_design_has_a_curve_of_its_own(swept):
    _, tasks, result = swept
    free, dear = result["baselines"]["p4dgs_coded"]
    assert (free["lambda_rate"], dear["lambda_rate"], free["seeds"]) == (0, 300, 2)
    assert dear["bytes"] < free["bytes"] < 0.6 * result["curve"][0]["bytes"]
    designs = [p4.decode(task.path.read_bytes()).design for task in tasks[4:8]]
    assert all(design.coded for design in designs)


def test_a_curve_of_few_points_has_a_reason_instead_of_a_bd_rate(swept):
    _, _, result = swept
    rate, reason = result["bd_rate"]["d3dgs_small"]
    assert rate is None and "at least 3" in reason
    text = study.describe(result)
    assert f"no BD-rate: {reason}" in text and "span a factor of" in text


def test_what_has_arrived_is_drawn(swept, tmp_path):
    folder, tasks, _ = swept
    for task in tasks[1:3]:
        place = tmp_path / "points" / study.record(task).name
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(study.record(task).read_bytes())
    moved = [task._replace(folder=tmp_path / "points") for task in tasks]
    result = study.collect(moved, tmp_path)
    assert (result["points"], result["missing"]) == (2, 8)
    assert [point["seeds"] for point in result["curve"]] == [1, 1]
    assert not result["baselines"] and not (tmp_path / "baselines.csv").exists()


def test_every_baseline_is_drawn(swept, tmp_path, monkeypatch):
    _, tasks, result = swept
    figures = []
    monkeypatch.setattr(study, "save_figure", lambda figure, path: figures.append(figure))
    others = [CODED, *METHODS]
    points = {name: [{"bytes": 9e5, "psnr_db": 30.0}] for name in others}
    rows = [json.loads(study.record(task).read_text()) for task in tasks[:4]]
    study.draw(tmp_path / "a.png", rows, result["curve"], points)
    labels = [text.get_text() for text in figures[0].axes[0].get_legend().get_texts()]
    assert labels[3:] == others


def test_means_over_seeds(swept):
    folder, tasks, result = swept
    rows = [json.loads(study.record(task).read_text()) for task in tasks[2:4]]
    point = result["curve"][1]
    assert point["psnr_db"] == pytest.approx(np.mean([row["psnr_db"] for row in rows]))
    assert point["bytes"] == np.mean([row["bytes"] for row in rows])
    assert point["psnr_db_spread"] == pytest.approx(np.ptp([r["psnr_db"] for r in rows]) / 2)


def test_a_folder_is_of_one_sweep(swept, scene, tmp_path):
    folder, _, _ = swept
    for changes, words in (
        ({"lambdas": (0.0, 1.0)}, "'lambda_rates'"),
        ({"iterations": 13}, "'iterations': expected 13 as in this sweep, found 12"),
        ({"seeds": 3}, "'seeds'"),
        ({"names": []}, "'baselines'"),
    ):
        with pytest.raises(StudyError, match=words):
            study.plan(scene, folder, **{**SETTINGS, **changes})
    old = json.loads((folder / "sweep.json").read_text())
    (tmp_path / "sweep.json").write_text(json.dumps({**old, "version": 0}))
    with pytest.raises(StudyError, match="'version': expected 1"):
        study.plan(scene, tmp_path, **SETTINGS)


def test_empty_sweeps(scene, tmp_path):
    with pytest.raises(StudyError, match="an empty sweep; expected at least one value"):
        study.plan(scene, tmp_path, ())
    with pytest.raises(StudyError, match="method 'nerf'"):
        study.plan(scene, tmp_path, names=["nerf"])
    tasks, _ = study.plan(scene, tmp_path)
    with pytest.raises(StudyError, match="an empty sweep; expected at least one point"):
        study.collect(tasks, tmp_path)
    assert not list(tmp_path.iterdir())
