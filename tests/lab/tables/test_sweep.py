"""Sweeps: points as jobs of their own, resumed after a kill, one folder for one sweep."""

import json
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.lab.tables import sweep as study
from p4dgs_ref.lab.tables.methods import CODED

from .shared import SWEEP, table


def test_the_csvs_have_a_row_for_each_point(swept):
    folder, _, _ = swept
    written = table(folder / "sweep.csv")
    rows, others = written[:4], written[4:]
    expected = {"lambda_rate", "seed", "estimated_bytes", "bytes", "psnr_db", "ssim"}
    assert expected <= set(rows[0])
    found = [(float(row["lambda_rate"]), int(row["seed"])) for row in rows]
    assert found == [(0.0, 0), (0.0, 1), (300.0, 0), (300.0, 1)]
    assert [row["method"] for row in others] == 4 * ["p4dgs_coded"] + 2 * ["d3dgs_small"]
    assert [row["lambda_rate"] for row in others] == ["0.0", "0.0", "300.0", "300.0", "", ""]
    assert iio.imread(folder / "sweep.png").std() > 5


def test_the_rate_is_paid_for(swept):
    _, tasks, result = swept
    cheap, dear = result["curve"]
    assert cheap["lambda_rate"] == 0 and dear["anchor_bytes"] < 0.99 * cheap["anchor_bytes"]
    assert result["points"] == 10 and result["missing"] == 0 and cheap["seeds"] == 2
    rows = [json.loads(task.record.read_text()) for task in tasks[2:4]]
    assert dear["psnr_db"] == pytest.approx(np.mean([row["psnr_db"] for row in rows]))
    assert dear["bytes"] == np.mean([row["bytes"] for row in rows])
    assert dear["psnr_db_spread"] == pytest.approx(np.ptp([r["psnr_db"] for r in rows]) / 2)


def test_the_coded_design_has_a_curve_of_its_own(swept):
    _, tasks, result = swept
    cheap, dear = result["baselines"]["p4dgs_coded"]
    assert (cheap["lambda_rate"], dear["lambda_rate"], cheap["seeds"]) == (0, 300, 2)
    assert dear["bytes"] < cheap["bytes"] < 0.6 * result["curve"][0]["bytes"]
    coded = [task for task in tasks if task.method == CODED]
    assert all(p4.decode(task.path.read_bytes()).design.coded for task in coded)


def test_a_curve_of_few_points_has_a_reason_instead_of_a_bd_rate(swept):
    _, _, result = swept
    rate, reason = result["bd_rate"]["d3dgs_small"]
    assert rate is None and "at least 3" in reason
    text = study.describe(result)
    assert f"no BD-rate: {reason}" in text and "span a factor of" in text


def test_composition_sums_to_the_files(swept):
    folder, tasks, result = swept
    rows = table(folder / "composition.csv")
    assert result["composition"]["lambda_rate"] == [300, 0] and len(rows) == len(study.PARTS)
    sizes = {}
    for end, task in (("low", tasks[2]), ("high", tasks[0])):
        sizes[end] = {row["component"]: int(row[f"bytes_{end}"]) for row in rows}
        assert sum(sizes[end].values()) == task.path.stat().st_size
        assert sum(float(row[f"percent_{end}"]) for row in rows) == pytest.approx(100)
    low, high = sizes["low"], sizes["high"]
    assert low["anchor position"] == high["anchor position"]
    assert low["deformation MLP"] == high["deformation MLP"] > 0
    assert low["anchor feature"] < high["anchor feature"]
    lines = study.describe(result).splitlines()
    totals = [f"{sum(size.values()):,}" for size in (low, high)]
    assert lines[-1].split() == ["file", totals[0], "100.0", totals[1], "100.0", "-", "-"]
    assert "Table 4" in lines[-12] and lines[-4].split()[-2:] == ["47.6", "26.9"]


def test_trainings_of_another_length_or_scene_are_other_points(swept, scene):
    folder, tasks, _ = swept
    longer = study.plan(scene, folder, **{**SWEEP, "iterations": 13})
    assert not {task.path for task in longer} & {task.path for task in tasks}
    other = study.plan(replace(scene, train=scene.train[1:]), folder, **SWEEP)
    assert not {task.path for task in other} & {task.path for task in tasks}
    more = study.plan(scene, folder, **{**SWEEP, "lambdas": (0.0, 1.0, 300.0), "seeds": 3})
    assert {task.path for task in tasks} < {task.path for task in more}
