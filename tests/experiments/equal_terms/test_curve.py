"""The curve: every method over its own size, kept points, ours against the envelope, Table 4."""

from dataclasses import replace

import imageio.v3 as iio
import pytest

from p4dgs_ref.lab import writer
from p4dgs_ref.lab.tables import curve as study
from p4dgs_ref.lab.tables import hundredfold, methods
from p4dgs_ref.lab.tables.methods import ALIKE, AS_STORED, CODED, OURS, Task
from p4dgs_ref.model import Model

from .shared import CURVE, FIRST, table


def point(size, psnr, **others):
    return {"bytes": size, "psnr_db": psnr, "held_back_db": psnr, **others}


def test_the_csv_has_a_row_for_each_file_and_says_when_and_where_it_was_made(drawn):
    folder, tasks, _ = drawn
    rows = table(folder / "curve.csv")
    assert [*rows[0]][:5] == FIRST
    assert [(row["method"], row["seed"], row["storage"]) for row in rows] == [
        (task.method, str(task.seed), task.storage) for task in tasks
    ]
    assert all("NumPy" in row["arithmetic"] and row["sha256"] for row in rows)
    assert all(row["iterations"] == "4" and float(row["train_seconds"]) > 0 for row in rows)
    labels = {row["label"] for row in rows}
    assert {"p4dgs loss=0.002", "d3dgs_small gaussians=20 sh_degree=0 float16"} <= labels
    assert iio.imread(folder / "curve.png").std() > 5


def test_files_of_one_training_hold_the_same_model(drawn):
    _, tasks, _ = drawn
    rows = {task.path: row for task, row in zip(tasks, methods.made(tasks))}
    for task in tasks:
        model, preset = methods.load(task.path), methods.preset_of(task)
        row, trained = rows[task.path], rows[task.trained.path]
        if task.is_ours:
            assert (type(model) is Model) == (row["storage"] == AS_STORED and task.method == OURS)
            assert row["anchors"] == trained["anchors"] <= preset.anchors
        else:
            assert model.parameters["sh_rest"].shape[2] == (row["sh_degree"] + 1) ** 2 - 1
            assert row["gaussians"] == trained["gaussians"] <= preset.most == preset.gaussians
        assert row["train_seconds"] == trained["train_seconds"]
        if task.storage != AS_STORED:
            assert row["bytes"] < 0.8 * trained["bytes"]
            assert abs(row["psnr_db"] - trained["psnr_db"]) < 3
            assert ("zlib_bytes" in row) == (task.storage == ALIKE and not task.is_ours)


def test_ours_against_others():
    ours = [point(100, 30.0), point(200, 32.0)]
    theirs = [point(1000, 31.0), point(4000, 33.0), point(9000, 30.5)]
    found = study.against(ours, theirs)
    assert (found["low"], found["high"]) == (31, 32)
    assert found["least"] == pytest.approx(10 / 2**0.5)
    assert found["median"] == pytest.approx((10 / 2**0.5 + 10) / 2)
    assert found["bd_rate"] is None  # of curves with less than three points
    assert study.against(ours, [point(5, 40.0)]) == study.against(ours, []) == {}


def test_the_best_points_are_chosen_by_views_held_back():
    points = [
        point(300, 40.0, held_back_db=30.0),
        point(100, 20.0, held_back_db=31.0),
        point(200, 10.0, held_back_db=32.0),
    ]
    assert [one["bytes"] for one in writer.best(points)] == [100, 200]


def rows_of(method, storage, scene, seed, size, psnr):
    label = f"{method} {size} {storage}"
    names = dict(method=method, storage=storage, scene=scene, seed=seed, label=label)
    return point(size, psnr, iterations=4, **names)


def test_a_point_counts_where_every_scene_has_it():
    rows = [rows_of(OURS, AS_STORED, scene, 0, 100, 30.0) for scene in "ab"]
    rows += [rows_of(OURS, AS_STORED, "a", seed, 200, 40.0) for seed in (0, 1)]
    assert [(p["bytes"], p["seeds"]) for p in study.points_of(rows)] == [(100, 1)]
    assert [p["bytes"] for p in study.points_of(rows[2:])] == [200]


def test_a_point_that_lacks_seeds_of_its_method_is_on_no_curve():
    whole = [
        rows_of(method, AS_STORED, scene, seed, factor * size, psnr)
        | dict.fromkeys(hundredfold.KINDS, size)
        for method, factor in ((CODED, 1), ("d3dgs_small", 10), ("hexplane", 20))
        for scene in hundredfold.LEVELS
        for seed in ((0,) if method == "hexplane" else (0, 1))
        for size, psnr in ((100, 34.0), (200, 35.0), (400, 37.0))
    ]
    lucky = [
        {**row, "iterations": 3, "bytes": row["bytes"] // 2}
        for row in whole
        if (row["method"], row["seed"]) == ("d3dgs_small", 0)
    ]
    assert writer.of_every_seed(whole + lucky) == whole
    assert study.comparisons(whole + lucky) == study.comparisons(whole)
    assert hundredfold.steps(whole + lucky) == hundredfold.steps(whole)
    assert {row["name"] for row in study.comparisons(whole)} >= {"hexplane"}
    assert study.shorter(whole) == []
    (found,) = study.shorter(whole + lucky)
    assert (found["files"], found["mean"], found["best"], found["bytes"]) == (6, 0, 0, 0.5)


def test_others_are_compared_in_each_storage_scene_and_with_their_spread():
    rows = [
        rows_of(method, storage, scene, seed, factor * size * (1 + seed), psnr)
        for method, storage, factor in (
            (CODED, AS_STORED, 1),
            (OURS, AS_STORED, 4),
            (OURS, ALIKE, 2),
            ("d3dgs_small", AS_STORED, 10),
            ("d3dgs_small", ALIKE, 3),
            ("hexplane", ALIKE, 6),
        )
        for scene in "ab"
        for seed in (0, 1)
        for size, psnr in ((100, 30.0), (200, 31.0), (400, 32.0))
    ]
    found = {
        (row["scene"], row["against"], row["name"], row["storage"]): row["median"]
        for row in study.comparisons(rows)
    }
    for scene in (study.MEAN, "a", "b"):
        assert found[scene, CODED, OURS, ALIKE] == pytest.approx(2)
        assert found[scene, CODED, study.ENVELOPE, AS_STORED] == pytest.approx(10)
        assert found[scene, CODED, study.ENVELOPE, ALIKE] == pytest.approx(3)
        assert found[scene, OURS, study.ENVELOPE, ALIKE] == pytest.approx(1.5)
        assert found[scene, OURS, study.ENVELOPE, AS_STORED] == pytest.approx(2.5)
        assert found[scene, CODED, "hexplane", ALIKE] == pytest.approx(6)
    assert not any(ours == name for _, ours, name, _ in found)
    assert all(row["median_spread"] == pytest.approx(0) for row in study.comparisons(rows))


def test_both_envelopes_are_those_of_the_explicit_methods(drawn):
    result = drawn[2]
    assert [*result["envelopes"]] == [AS_STORED, ALIKE]
    for storage, labels in result["envelopes"].items():
        assert labels and all(label.startswith("d3dgs_small") for label in labels)
        assert all(("loss" in label) == (storage == ALIKE) for label in labels)


def test_composition_sums_to_the_files(drawn):
    folder, tasks, result = drawn
    *rows, whole = table(folder / "composition.csv")
    assert result["composition"]["lambda_rate"] == [0.01, 0.0005] and len(rows) == len(study.PARTS)
    ours = [task for task in tasks if task.storage == AS_STORED]
    for end, task in zip(("low", "high"), ours):
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
    assert {task.path for task in tasks if task.method == CODED} < {task.path for task in more}
    assert [task.seed for task in more] == sorted(task.seed for task in more)
    assert {task.seed for task in more if task.method in study.ONE_SEED} == {0}
    both = study.plan([scene], folder)
    assert [{t.iterations for t in both if t.seed == seed} for seed in (0, 1)] == [
        {*study.LENGTHS},
        {study.LENGTHS[0]},
    ]
    far = {(t.seed, t.iterations) for t in both if t.method in study.ONE_SEED}
    assert far == {(0, study.LENGTHS[0])}


def test_parts_of_a_plan_are_disjoint_and_hold_the_files_of_their_trainings(drawn):
    _, tasks, _ = drawn
    parts = [methods.part_of(tasks, i, 3) for i in range(3)]
    assert sorted(task.path for part in parts for task in part) == sorted(t.path for t in tasks)
    trained = [{task.trained.path for task in part} for part in parts]
    assert not trained[0] & trained[1] | trained[1] & trained[2] | trained[0] & trained[2]
    assert max(map(len, trained)) <= min(map(len, trained)) + 1


def test_a_point_from_another_preset(scene):
    changes = {"preset": "smoke", "lambda_rate": 0.25}
    assert methods.preset_of(Task(scene, CODED, 0, None, None, changes)).name == "smoke"
