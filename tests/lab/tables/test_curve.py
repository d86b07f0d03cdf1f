"""The curve: every method over its own size, kept points, ours against the envelope, Table 4."""

from dataclasses import replace

import imageio.v3 as iio
import pytest

from p4dgs_ref.lab import writer
from p4dgs_ref.lab.tables import curve as study
from p4dgs_ref.lab.tables import methods
from p4dgs_ref.lab.tables.methods import CODED, OURS, Task
from p4dgs_ref.model import Model

from .shared import CURVE, FIRST, table


def test_the_csv_has_a_row_for_each_point_and_says_when_and_where_it_was_made(drawn):
    folder, tasks, _ = drawn
    rows = table(folder / "curve.csv")
    assert [*rows[0]][:5] == FIRST
    assert [(row["method"], row["seed"]) for row in rows] == [
        (task.method, str(task.seed)) for task in tasks
    ]
    assert all("NumPy" in row["arithmetic"] for row in rows)
    knobs = {(row["label"], row["lambda_rate"], row["sh_degree"]) for row in rows}
    assert {("p4dgs lambda_rate=0.01", "0.01", ""), ("d3dgs_small", "", "3")} <= knobs
    assert ("d3dgs_small gaussians=100 sh_degree=0", "", "0") in knobs
    assert iio.imread(folder / "curve.png").std() > 5


def test_sizes_of_the_points(drawn):
    _, tasks, result = drawn
    for row, task in zip(result["rows"], tasks):
        model, preset = methods.load(task.path), methods.preset_of(task)
        if task.is_ours:
            assert (type(model) is Model) == (task.method != CODED)
            assert row["anchors"] <= preset.anchors
        else:
            assert model.parameters["sh_rest"].shape[2] == (row["sh_degree"] + 1) ** 2 - 1
            assert row["gaussians"] <= preset.most == preset.gaussians


def test_ours_against_the_envelope():
    ours, theirs = [(100, 30.0), (200, 32.0)], [(1000, 31.0), (4000, 33.0), (9000, 30.5)]
    found = study.against("all", ours, theirs)
    assert (found["low"], found["high"]) == (31, 32)
    assert found["least"] == pytest.approx(10 / 2**0.5)
    assert found["median"] == pytest.approx((10 / 2**0.5 + 10) / 2)
    assert "at least 3" in found["bd_rate"]
    assert writer.factors(ours, [(5, 40.0)]) == {}


def test_the_envelope_is_that_of_the_explicit_methods(drawn):
    labels, compared = drawn[2]["envelope"], [row["name"] for row in drawn[2]["against"]]
    assert labels and all(label.startswith("d3dgs_small") for label in labels)
    assert compared == ["the envelope", OURS, "d3dgs_small"]


def test_the_best_small_point_is_chosen_by_the_mean():
    def row(method, label, scene, size, psnr):
        return dict(method=method, label=label, scene=scene, seed=0, bytes=size, psnr_db=psnr)

    rows = [
        row(CODED, "low", "a", 20_000, 33.0),
        row(CODED, "low", "b", 40_000, 30.0),
        row(CODED, "high", "a", 25_000, 32.0),
        row(CODED, "high", "b", 25_000, 34.0),
        row(CODED, "large", "a", 31_000, 40.0),
        row("d3dgs_small", "theirs", "a", 80_000, 32.5),
        row("d3dgs_small", "theirs", "b", 90_000, 34.75),
        row("d3dgs_small", "less", "a", 80_000, 33.0),
        row("d3dgs_small", "less", "b", 80_000, 33.0),
    ]
    found = study.best(rows, writer.means(rows, "label", "method"))
    assert [(r["scene"], r["psnr_gain"], r["their_bytes"]) for r in found] == [
        ("a", -0.5, 80_000),
        ("b", -0.75, 90_000),
    ]
    assert found[0]["points"] == "high against theirs"
    assert study.best(rows[:5], writer.means(rows[:5], "label", "method")) == []


def test_composition_sums_to_the_files(drawn):
    folder, tasks, result = drawn
    *rows, whole = table(folder / "composition.csv")
    assert result["composition"]["lambda_rate"] == [0.01, 0.0005] and len(rows) == len(study.PARTS)
    for end, task in zip(("low", "high"), tasks):
        size = sum(int(row[f"bytes_{end}"]) for row in rows)
        assert task.method == OURS and size == task.path.stat().st_size == int(
            whole[f"bytes_{end}"]
        )
        assert sum(float(row[f"percent_{end}"]) for row in rows) == pytest.approx(100)
    lines = study.to_text(result).splitlines()
    assert lines[-1].split()[::2] == ["file", "100.0", "100.0", "-"]
    assert "Table 4" in lines[-12] and lines[-4].split()[-2:] == ["47.6", "26.9"]


def test_trainings_of_another_length_or_scene_are_other_points(drawn, scene):
    folder, tasks, _ = drawn
    paths = {task.path for task in tasks}
    longer = study.plan([scene], folder, **{**CURVE, "iterations": 13})
    other = study.plan([replace(scene, train=scene.train[1:])], folder, **CURVE)
    assert not {task.path for task in (*longer, *other)} & paths
    more = study.plan([scene], folder, **{**CURVE, "names": (), "seeds": 3})
    assert paths < {task.path for task in more}
    assert [task.seed for task in more] == sorted(task.seed for task in more)


def test_a_point_from_another_preset(scene):
    changes = {"preset": "smoke", "lambda_rate": 0.25}
    assert methods.preset_of(Task(scene, CODED, 0, None, None, changes)).name == "smoke"
