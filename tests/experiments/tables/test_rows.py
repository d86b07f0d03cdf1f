"""Rows are made once, in disjoint parts, and are those of their files."""

import dataclasses
import hashlib

import pytest

from p4dgs_ref.lab.writer import read_csv
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.report.inspect import components
from p4dgs_ref.scenes import SceneError
from tutorials.experiments.coded_networks import __main__ as coded
from tutorials.experiments.coded_networks import decision
from tutorials.experiments.tables import __main__ as tables
from tutorials.experiments.tables import methods, rows
from tutorials.experiments.tables.methods import CODED, PAPERS, task_of
from tutorials.experiments.tables.rows import Task, run


def tasks_of(scene, names=(PAPERS, CODED), seeds=2):
    return [task_of(scene, name, seed, 6, "a command") for seed in range(seeds) for name in names]


def make_half(task, path, source):
    """The file of the model in another file, without its last byte: another storage."""
    path.write_bytes(methods.encode(source))
    return {"storage": "again"}


def test_every_row_is_that_of_its_file(scene, tmp_path):
    tasks = tasks_of(scene, [*methods.METHODS], 1)
    for task, row in zip(tasks, rows.rows(tasks, "some", tmp_path), strict=True):
        data, model = (tmp_path / row["file"]).read_bytes(), task.load(tmp_path / row["file"])
        assert [row[name] for name in rows.KEY] == ["bouncing", task.method, 0, 6]
        assert (row["bytes"], row["command"]) == (len(data), "a command")
        assert row["sha256"] == hashlib.sha256(data).hexdigest()[:16]
        kinds = [row[f"{kind}_bytes"] for kind in ("gaussians", "network", "other")]
        assert sum(kinds) == row["bytes"] and min(kinds) >= 0
        if task.method == PAPERS:
            assert row["other_bytes"] == components(data)["header"]
        assert row["psnr_db"] == evaluate(model, scene)[0]["psnr_db"] != row["held_back_db"]
        assert row["train_seconds"] > 0 and "p4dgs_ref" in row["arithmetic"]


def test_parts_are_disjoint_and_a_call_without_them_collects_what_is_there(scene, tmp_path):
    tasks, made = tasks_of(scene), []
    tasks = [task._replace(make=counting(task.make, made)) for task in tasks]
    again = [
        Task(*task[:4], make_half, methods.load, "p4dgs", "", name="again", source=task)
        for task in tasks
        if task.method == PAPERS
    ]
    parts = [rows.rows(tasks + again, "some", tmp_path, (i, 3)) for i in (1, 2, 3)]
    assert sorted(map(len, parts)) == [1, 2, 3] and len(made) == 4
    found = rows.rows(tasks + again, "some", tmp_path)
    assert len(made) == 4 and found == read_csv(tmp_path / "some.csv", rows.TEXTS)
    assert [row["label"] for row in found] == [PAPERS, CODED] * 2 + ["again"] * 2
    for one, other in zip(found[:4:2], found[4:]):  # the file of a source makes the same again
        assert one["sha256"] == other["sha256"] and other["storage"] == "again"
    longer = [task._replace(iterations=7) for task in tasks]
    rows.rows(longer[:1], "some", tmp_path)  # the others stay in the file
    assert len(made) == 5 and len(read_csv(tmp_path / "some.csv")) == 7


def counting(make, made):
    def counted(*arguments):
        made.append(arguments[0].key)
        return make(*arguments)

    return counted


def test_a_killed_study_keeps_its_rows(scene, tmp_path):
    def stop(task, path, source):
        path.write_bytes(b"half a file")
        raise KeyboardInterrupt

    first, second = tasks_of(scene, [PAPERS])
    assert run(rows.rows, [first, second._replace(make=stop)], "some", tmp_path) == 130
    assert [row["seed"] for row in read_csv(tmp_path / "some.csv")] == [0]
    assert not (tmp_path / second.file).exists()


def test_a_record_is_known(scene, tmp_path, monkeypatch):
    (tmp_path / "some.csv").write_text(
        "scene,label,seed,iterations,sha256\nbouncing,p4dgs,0,6,12e3\n"
    )
    monkeypatch.setattr(rows, "RECORDS", tmp_path)
    ((known),) = rows.rows(tasks_of(scene, [PAPERS], 1), "some", tmp_path / "new")
    assert known["sha256"] == "12e3" and [*(tmp_path / "new").iterdir()] == [
        tmp_path / "new/some.csv"
    ]


def test_a_scene_without_test_views_is_refused(scene, tmp_path):
    with pytest.raises(SceneError, match="no views to measure on"):
        rows.rows(tasks_of(dataclasses.replace(scene, test=[])), "some", tmp_path)


@pytest.mark.parametrize(
    "main, words, why",
    [
        (tables.main, "", "required: table, scene"),
        (tables.main, "curve bouncing", "invalid choice: 'curve'"),
        (tables.main, "compare nowhere", "nowhere: no such folder"),
        (tables.main, "compare bouncing --part 3/2", "I from 1 to N, got '3/2'"),
        (tables.main, "compare bouncing --part 0/2", "from 1 on, got '0'"),
        (tables.main, "ablate bouncing --seeds -1", "--seeds"),
        (tables.main, "ablate bouncing --quick -o README.md", "README.md: expected a folder"),
        (decision.main, "--jobs 1.5", "--jobs: expected a whole number"),
        (coded.main, "nowhere", "nowhere: no such folder"),
        (coded.main, "-o README.md", "README.md: a file of another kind"),
    ],
)
def test_misuse_is_one_line_and_exit_2(main, words, why, capsys):
    with pytest.raises(SystemExit) as caught:
        raise SystemExit(run(main, words.split()))
    error = capsys.readouterr().err
    assert caught.value.code == 2 and why in error and error.count("\n") == 1
