"""Rows are those of their files, in every study; presets, names and mistakes."""

import dataclasses
import hashlib
import json
import math
import os
import pickle
import shlex
import shutil

import pytest

import p4dgs_ref as p4
from p4dgs_ref.__main__ import main
from p4dgs_ref.lab import StudyError, baselines, writer
from p4dgs_ref.lab.tables import ablate, compare, curve, methods
from p4dgs_ref.lab.tables.methods import OURS, Task
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.report.inspect import ledger
from p4dgs_ref.scenes import SceneError
from p4dgs_ref.scenes.files import read_json

from .shared import FIRST


@pytest.mark.parametrize(
    "study", ["compared", "ablated", pytest.param("drawn", marks=pytest.mark.slow)]
)
def test_every_row_is_that_of_its_file(study, scene, request):
    folder, *_, result = request.getfixturevalue(study)
    (place,) = folder.glob("points_*")
    for row in result.get("methods") or result["rows"]:
        path = place / row["file"]
        assert list(row)[:5] == FIRST and row["scene"] == "bouncing"
        assert path.stat().st_size == int(row["bytes"])
        assert row["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        kinds = [int(row[f"{kind}_bytes"]) for kind in ("gaussians", "network", "other")]
        assert sum(kinds) == int(row["bytes"]) and min(kinds) >= 0
        metrics = evaluate(methods.load(path), scene)[0]
        for name in ("psnr_db", "ssim"):
            assert float(row[name]) == pytest.approx(metrics[name], rel=1e-12)
        if path.suffix == ".p4dgs":
            estimate = sum(part["estimate_bytes"] for part in ledger(path.read_bytes()))
            assert abs(int(row["estimated_bytes"]) - estimate) <= 0.5
            assert 0.9 < estimate / int(row["bytes"]) < 1
        assert float(row["train_seconds"]) > 0


def test_means_over_scenes_and_seeds():
    made = zip("aabb", (0, 1, 0, 1), (30.0, 31.0, 34.0, 37.0), (None, 1, 2, 3))
    rows = [
        {"method": "m", "scene": scene, "seed": seed, "psnr_db": psnr, "empty": empty}
        for scene, seed, psnr, empty in made
    ]
    (whole,) = writer.means(rows, "method")
    assert whole == {"method": "m", "seeds": 2, "psnr_db": 33.0, "psnr_db_spread": 1.0}
    assert [row["psnr_db"] for row in writer.means(rows, "scene")] == [30.5, 35.5]
    forms = {"scene": "{scene}", "dB": "{psnr_db:.1f}", "none": "{empty:.1f}", "gone": "{gone}"}
    lines = writer.text_table(forms, rows[:2])
    assert lines == [
        "scene    dB  none  gone",
        "a      30.0     -     -",
        "a      31.0   1.0     -",
    ]


def test_dates_of_all_presets_shorten_alike(scene):
    counted_otherwise = {
        "gaussians",
        "sh_degree",
        "grow_every",
        "most",
        "L_x",
        "L_t",
        "nodes",
        "time_nodes",
        "features",
        "waves",
    }
    for name in baselines.METHODS:
        whole, half = (
            methods.preset_of(Task(scene, name, 0, None, iterations)) for iterations in (3800, 1900)
        )
        assert whole == baselines.choose(name)
        for field in dataclasses.fields(whole):
            before, after = getattr(whole, field.name), getattr(half, field.name)
            if field.name in methods.DATES:
                assert after == round(before / 2), (name, field.name)
            else:
                assert after == before
                assert type(before) is not int or field.name in counted_otherwise, (
                    f"{name}: {field.name} is a date or a count: add it to one of the lists"
                )
    ours = [methods.preset_of(Task(scene, OURS, 0, None, n)).stage_ends for n in (None, 1900)]
    assert ours == [(200, 300, 1800, 3800), (100, 150, 900, 1900)]


def test_a_task_travels_to_other_processes_and_names_its_file(scene, tmp_path):
    changes = {"gaussians": 20}
    task = pickle.loads(pickle.dumps(Task(scene, "d3dgs_small", 0, tmp_path, 3, changes)))
    assert task.path == tmp_path / "bouncing_d3dgs_small_gaussians=20_seed0.ply"
    row = methods.make(task)
    assert list(row)[:5] == FIRST and row["iterations"] == 3
    assert baselines.load(task.path).primitives <= 20 and methods.made([task]) == [row]
    step = task._replace(method=OURS, step="+ a / b", plain=())
    assert step.path == tmp_path / "bouncing_a___b_seed0.npy"


@pytest.fixture(scope="module")
def kept(scene, tmp_path_factory):
    """Tasks of both kinds of method whose rows are kept."""
    folder = tmp_path_factory.mktemp("kept")
    tasks = [
        Task(scene, name, 0, folder, 4, {"lambda_rate": 0.01} if name == OURS else {})
        for name in (OURS, "d3dgs_small")
    ]
    methods.make_missing(tasks)
    return tasks


def edited(**fields):
    """A change of fields of a row; one that becomes ... is left out."""

    def damage(task):
        row = {**read_json(task.record), **fields}
        text = json.dumps({name: a for name, a in row.items() if a is not ...})
        task.record.write_text(text, encoding="utf-8")

    return damage


def in_place_of(which, make):
    def damage(task):
        getattr(task, which).unlink()
        make(getattr(task, which))

    return damage


ODD = {"pipe": os.mkfifo, "folder": os.mkdir, "link": lambda path: path.symlink_to(path.name)}
DAMAGES = {
    "{}": lambda task: task.record.write_text("{}", encoding="utf-8"),
    "a list": lambda task: task.record.write_text("[]", encoding="utf-8"),
    "cut": lambda task: task.record.write_bytes(task.record.read_bytes()[:-5]),
    "no method": edited(method=...),
    "no SSIM": edited(ssim=...),
    "NaN": edited(psnr_db=math.nan),
    "a list of seeds": edited(seed=[0]),
    "bytes 0": edited(bytes=0),
    "other parts": edited(network_bytes=1),
    "another release": edited(release="0.0.1"),
    "another seed": edited(seed=1),
    "another length": edited(iterations=5),
    "another rate": edited(lambda_rate=0.5),
    "unknown field": edited(speed=1),
    "another number": edited(psnr_db=99.0),
    "no checksum": edited(row_sha256=...),
    "another file": lambda task: task.path.write_bytes(task.path.read_bytes()[::-1]),
    "empty file": lambda task: task.path.write_bytes(b""),
    "no file": lambda task: task.path.unlink(),
    **{
        f"{which} is a {kind}": in_place_of(which, make)
        for which in ("record", "path")
        for kind, make in ODD.items()
    },
}


def test_damaged_rows_are_refused_in_one_line_before_any_training(kept, tmp_path, monkeypatch):
    monkeypatch.setattr(methods, "make", lambda task: pytest.fail("trained"))
    for task in kept:
        for name, damage in DAMAGES.items():
            folder = tmp_path / f"{task.method} {name}"
            shutil.copytree(task.folder, folder)
            copied = task._replace(folder=folder)
            damage(copied)
            with pytest.raises(StudyError, match="; delete it, or name another folder$") as said:
                methods.make_missing([copied])
            assert f"{folder}/{task.path.stem}." in str(said.value)
            assert "\n" not in str(said.value)
            assert name != "another release" or ".json: release: '0.0.1'; " in str(said.value)


@pytest.mark.filterwarnings("always:scene")  # of a command: a line
@pytest.mark.parametrize("changes", [{}, {"preset": "small_coded", "d": 8, "anchors": 60}])
def test_the_command_of_a_row_makes_its_file(changes, tmp_path, monkeypatch, capsys):
    task = Task(p4.load_scene("bouncing"), methods.CODED, 3, tmp_path / "rows", 4, changes)
    row = methods.make(task)
    monkeypatch.chdir(tmp_path)
    for part in row["command"].split(" && "):
        assert main(shlex.split(part)[1:]) == 0
    made = (tmp_path / row["file"]).read_bytes()
    assert made == task.path.read_bytes() and "--seed 3 --set" in row["command"]


def test_the_command_of_a_row_of_a_study_plans_its_task(scene, tmp_path):
    for plan, study, asked in (
        (compare.plan, "compare", ([scene], tmp_path, ["d3dgs_small"], 3, 9)),
        (curve.plan, "compare --curve", ([scene], tmp_path, ["d3dgs_small"], 3, 9)),
        (ablate.plan, "ablate", (scene, tmp_path, 3, 9)),
    ):
        task = next(t for t in plan(*asked) if t.seed == 1 and (t.step or not t.is_ours))
        method = " --method d3dgs_small" * (study != "ablate")
        assert task.command == (
            f"p4dgs-ref {study} bouncing{method} --seeds 2 --iterations 9 --yes"
        )


def test_bytes_of_our_files_by_kind():
    names = ("header", "positions", "masks", "hash_grid", "anchor_mlps", "deformation_mlp")
    assert methods.kinds(dict(zip(names, (1, 2, 4, 8, 16, 32)))) == {
        "gaussians": 6,
        "network": 56,
        "other": 1,
    }


def test_the_coded_design_is_compared_where_it_is_named():
    assert methods.known([]) == [OURS, "d3dgs", "d3dgs_small", "hexplane", "gaussian4d"]
    assert methods.known(["hexplane", methods.CODED, OURS]) == [OURS, methods.CODED, "hexplane"]


def test_only_scenes_that_move_are_compared():
    names = set(compare.dynamic_scenes())
    assert names >= {"bouncing", "figure", "glossy", "orbit"}
    assert not {"static", "orientation"} & names


def test_a_scene_without_test_views_is_refused(scene, tmp_path):
    with pytest.raises(SceneError, match="scene bouncing: split 'test': no views"):
        methods.make_missing(ablate.plan(dataclasses.replace(scene, test=()), tmp_path))
    assert not list(tmp_path.iterdir())
