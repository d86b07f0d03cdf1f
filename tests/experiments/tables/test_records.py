"""The records of trainings: all their rows are there, and one of them is made again each day."""

import csv
import random
from datetime import date

import pytest

from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.lab.tables import methods
from p4dgs_ref.lab.tables.methods import Task
from tests.sampling import SEED
from tutorials.tools import records

from .shared import FIRST

LONGEST = 60  # seconds of the processor that the row of a day may take


@pytest.mark.parametrize("name", records.PLANS)
def test_a_record_has_all_rows_at_full_length_and_their_commands(name):
    rows, tasks = records.rows(name), records.tasks(name)
    assert [*rows[0]][:5] == FIRST
    assert [(*records.name_of(row), row["label"], row["command"]) for row in rows] == [
        (*records.name_of_task(task), task.label, task.command) for task in tasks
    ]
    for row in rows:
        least = 10 if name == "effects" else 19  # without a background all is white
        assert (
            least < row["psnr_db"] < 45 and row["bytes"] > 2000 and date.fromisoformat(row["made"])
        )
        assert ("sha256" in row) != ("the processor's own" in row["arithmetic"])


@pytest.mark.slow
def test_one_row_of_a_record_is_made_again(tmp_path):
    """Another one each day. `P4DGS_TEST_SEED=20260131 pytest -m slow` makes that of a day."""
    short = [
        (name, row)
        for name in records.PLANS
        for row in records.rows(name)
        if "sha256" in row and row["train_seconds"] <= LONGEST
    ]
    if not short:
        pytest.skip("no row of a record was made with the one arithmetic yet")
    name, row = random.Random(SEED).choice(short)
    here = arithmetic()
    if here != row["arithmetic"]:
        pytest.skip(f"{name}, {row['file']}: made with {row['arithmetic']}; here is {here}")
    tasks = {records.name_of_task(task): task for task in records.tasks(name, tmp_path)}
    task = tasks[records.name_of(row)]
    methods.make_missing([task])
    (again,) = methods.made([task])
    for column in ("sha256", "bytes", "psnr_db"):
        assert again[column] == row[column], (name, row["file"], column)


def test_only_rows_without_a_sha256_are_made(scene, tmp_path, monkeypatch):
    tasks = [Task(scene, "d3dgs_small", seed, tmp_path / "files", 2) for seed in (0, 1)]
    file = tmp_path / "records" / "some.csv"
    file.parent.mkdir()
    file.write_text(
        f"file,iterations,sha256,psnr_db\n{tasks[0].path.name},2,12345e67,0.25\n", encoding="utf-8"
    )
    monkeypatch.setattr(records, "FOLDER", tmp_path)
    monkeypatch.setitem(records.PLANS, "some", lambda scenes, folder: tasks)
    records.main("some", 1, is_made=True)
    assert len(file.read_text(encoding="utf-8").splitlines()) == 2
    records.main("some", 1)
    kept, made = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    assert (kept["sha256"], kept["psnr_db"]) == ("12345e67", "0.25")
    assert not tasks[0].record.exists() and [made["file"]] == [tasks[1].path.name]
    assert made["sha256"] == records.rows("some")[1]["sha256"] and made["command"]
    before = file.read_bytes()
    records.main("some", 1)
    assert file.read_bytes() == before
