"""The shortest run of each command: rows, files that are read back, tables and pictures."""

import hashlib

import pytest

from p4dgs_ref.lab.writer import read_csv
from tutorials.experiments.coded_networks import decision, file
from tutorials.experiments.equal_terms import __main__ as equal
from tutorials.experiments.equal_terms import curve
from tutorials.experiments.tables import __main__ as tables
from tutorials.experiments.tables import methods
from tutorials.experiments.tables.rows import TEXTS, rows, run


@pytest.mark.parametrize("line", [*tables.TABLES, "ablate --anchors 20"])
def test_a_table_is_made_once_and_shown(line, tmp_path, capsys):
    name, *more = line.split()
    words = [name, "bouncing", *more, *f"--seeds 1 --iterations 40 -o {tmp_path}".split()]
    assert run(tables.main, words) == 0
    shown, progress = capsys.readouterr()
    found = read_csv(tmp_path / f"{name}.csv", TEXTS)
    assert progress.count(" trainings: ") == len({row["file"] for row in found}) == len(found)
    for row in found:
        data = (tmp_path / row["file"]).read_bytes()
        assert row["sha256"] == hashlib.sha256(data).hexdigest()[:16], row["label"]
        assert sum(row[f"{kind}_bytes"] for kind in ("gaussians", "network", "other")) == len(data)
    first = {row["label"] if name != "training" else f"{row['iterations']}" for row in found}
    assert all(any(line.startswith(text) for line in shown.splitlines()) for text in first)
    assert run(tables.main, words) == 0 and " trainings: " not in capsys.readouterr().err


def test_every_method_and_storage_of_the_curve(scene, tmp_path):
    tasks = {(task.method, task.load): task for task in curve.plan() if task.seed == 0}
    assert len(tasks) == 11  # each method as stored and coded alike, and half a file
    made = rows([short(task, scene) for task in tasks.values()], "some", tmp_path)
    sizes = {(row["method"], task.load): row["bytes"] for task, row in zip(tasks.values(), made)}
    stored = {method: size for (method, load), size in sizes.items() if load is of_method(method)}
    assert all(sizes[key] < stored[key[0]] for key in sizes if key[1] is not of_method(key[0]))


def of_method(method):
    """The function that reads a method's file as its authors store it."""
    return methods.METHODS[method][1]


def short(task, scene):
    """The same task with a few iterations on a small scene."""
    source = task.source and short(task.source, scene)
    return task._replace(scene=scene, iterations=8, source=source)


def test_coded_networks_encode_to_the_same_file_again(scene, tmp_path):
    task = methods.task_of(scene, methods.CODED, 0, 8, "a command")
    ((row),) = rows([task], "some", tmp_path)
    data = (tmp_path / row["file"]).read_bytes()
    assert file.encode(file.decode(data)) == data


def test_what_is_in_the_records_is_printed_and_drawn(tmp_path, capsys):
    there = ["-o", f"{tmp_path}"]
    assert run(equal.main, ["curve", *there]) == run(decision.main, there) == 0
    shown = capsys.readouterr().out
    assert "| bouncing | coded alike |" in shown and "price of a bit" in shown
    drawn = [
        (tmp_path / f"{name}.png").stat().st_size for name in ("equal_terms", "coded_networks")
    ]
    assert min(drawn) > 5000


@pytest.mark.parametrize(
    "main, words, why",
    [
        (tables.main, "training nowhere", "nowhere: no such folder"),
        (tables.main, "ablate bouncing --seeds -1", "--seeds: expected a whole number"),
        (equal.main, "", "required: study"),
        (decision.main, "-o README.md", "README.md: expected a writable"),
    ],
)
def test_misuse_is_one_line_and_exit_2(main, words, why, capsys):
    with pytest.raises(SystemExit) as caught:
        raise SystemExit(run(main, words.split()))
    error = capsys.readouterr().err
    assert caught.value.code == 2 and why in error and error.count("\n") == 1
