"""The curve: which rows count, what a comparison says, the four steps, the parts of a plan."""

import numpy as np
import pytest

from tutorials.experiments.equal_terms import __main__ as command
from tutorials.experiments.equal_terms import curve, numbers, picture, steps
from tutorials.experiments.equal_terms.curve import ALIKE, HALF, STORED
from tutorials.experiments.tables.methods import PAPERS
from tutorials.experiments.tables.rows import make_row, run


def rows_of(method, storage, scale, seeds=(0, 1, 2), scenes=curve.SCENES):
    """Rows with three sizes whose PSNR is 30, 32 and 34 dB."""
    sizes = ((100, 30.0), (200, 32.0), (400, 34.0))
    return [
        dict(method=method, storage=storage, scene=scene, seed=seed, label=f"{method} {size}")
        | dict(bytes=scale(scene, seed) * size, psnr_db=psnr, held_back_db=psnr, iterations=4)
        for scene in scenes
        for seed in seeds
        for size, psnr in sizes
    ]


def test_a_difference_whose_seeds_lie_on_both_sides_of_1_is_none():
    rows = rows_of(PAPERS, ALIKE, lambda *_: 1)
    draw = rows_of("d3dgs_small", ALIKE, lambda scene, seed: (0.8, 1.1, 1.0)[seed])
    found = curve.compare(rows + draw, ALIKE)
    assert [row["scene"] for row in found] == ["mean", *curve.SCENES]
    assert all((row["first"], row["last"]) == pytest.approx((0.8, 1.1)) for row in found)
    assert {row["verdict"] for row in found} == {"none"}
    assert all(row["median"] == pytest.approx(1.0) for row in found)  # of the seeds' medians
    fewer = rows_of("d3dgs_small", ALIKE, lambda *_: 0.5)
    assert {row["verdict"] for row in curve.compare(rows + fewer, ALIKE)} == {"fewer"}


def test_only_seeds_that_all_points_have_count():
    rows = rows_of(PAPERS, ALIKE, lambda *_: 1)
    lucky = {**rows[0], "seed": 3, "bytes": 1}
    assert curve.of_common_seeds([*rows, lucky]) == curve.of_common_seeds(rows)
    assert len(curve.of_common_seeds(rows)) == len(rows)


def test_a_step_is_a_band_over_all_levels_of_a_scene():
    sizes = {step: 10 ** (4 - i) for i, step in enumerate(steps.STEPS)}
    rows = []
    for step, (method, storage) in steps.STEPS.items():
        rows += rows_of(method, storage, lambda *_, step=step: sizes[step])
    found = steps.bands(rows)
    assert len(found) == 15 and {(row["low"], row["high"]) for row in found} == {(30, 34)}
    for row in found:
        assert (row["least"], row["most"]) == pytest.approx(
            (100 * sizes[row["step"]], 400 * sizes[row["step"]])
        )
        if row["step"] != next(iter(steps.STEPS)):
            assert (row["worst"], row["best"]) == pytest.approx((10, 10))


def test_the_plan_begins_with_the_first_seed_and_makes_files_of_one_training():
    tasks = curve.plan()
    assert [task.seed for task in tasks] == sorted(task.seed for task in tasks)
    assert len({task.key for task in tasks}) == len(tasks)
    assert {task.seed for task in tasks if task.method in curve.FAR} == {0}
    assert {*curve.recorded("curve")} <= {task.key for task in tasks}
    for task in tasks:
        assert (task.source is None) == (curve.storage_of(task.label) == STORED)
        if task.source:
            assert task.source.method == task.method and task.source in tasks


@pytest.mark.parametrize("method", [PAPERS, "d3dgs_small"])
def test_all_files_of_a_training_hold_its_model(scene, tmp_path, method):
    stored = curve.task_of(scene, method, 0, 6, "a command")
    tasks = curve.files_of(stored, losses=(1e-4,))
    tasks += [curve.half_of(stored)] if method != PAPERS else []
    first, *others = [make_row(task, tmp_path) for task in tasks]
    assert [curve.storage_of(row["label"]) for row in others] == [ALIKE, HALF][: len(others)]
    for row in others:
        assert row["bytes"] < first["bytes"] and row["anchors"] == first["anchors"]
        assert row["psnr_db"] == pytest.approx(first["psnr_db"], abs=3)


def test_the_numbers_of_t_rex_follow_from_the_papers_tables():
    first, second, third = numbers.inferred()
    assert first["gaussians"] * 62 * 4 + 4 * 522_280 == pytest.approx(56.7e6)
    assert second["numbers"] == 5.5 and second["each"] == 22
    assert 3.5 < third["bits"] < 4.5
    assert np.ptp([row["gaussians"] for row in (first, second, third)]) < 45_000


def test_the_picture_and_the_tables_of_the_record(tmp_path, capsys):
    picture.draw(curve.read(), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000
    curve.tell(curve.read())
    assert "| bouncing |" in capsys.readouterr().out


def test_misuse_is_one_line(capsys):
    with pytest.raises(SystemExit) as caught:
        raise SystemExit(run(command.main, ["lengths"]))
    assert caught.value.code == 2 and capsys.readouterr().err.count("\n") == 1


def test_what_is_missing_is_estimated(capsys):
    command.estimate(curve.plan(), "curve")
    count = int(capsys.readouterr().out.split()[0])
    assert 0 <= count <= 99
