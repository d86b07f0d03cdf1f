"""The commands of the paper's tables: their files, and their mistakes in one line."""

import json
import shutil

import pytest

from p4dgs_ref.lab.baselines import METHODS
from p4dgs_ref.lab.tables import compare

# Outside of pytest Python hides them; matplotlib 3.8 causes some with a new pyparsing.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(autouse=True)
def place(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare, "TURNS", 1)
    shutil.copytree(scene, "scene")
    return tmp_path


@pytest.mark.slow
def test_compare_quick_has_one_row_a_method(place, run):
    code, out, err = run("compare scene --quick -o out --json --iterations 4")
    assert (code, err) == (0, "")
    result = json.loads((place / "out/compare.json").read_text())
    assert json.loads(out) == result
    rows = result["methods"]
    assert [row["method"] for row in rows] == ["p4dgs", *METHODS]
    assert {(row["scene"], row["seed"]) for row in rows} == {("scene", 0)}
    for row in rows:
        ending = "p4dgs" if row["method"] == "p4dgs" else "ply"
        file = place / "out" / f"scene_{row['method']}_seed0.{ending}"
        assert file.stat().st_size == row["bytes"]


def test_sweep_point_by_point(place, run, refused):
    sweep, folder = "sweep scene --seeds 1 --lambda-rate 0,0.5 --iterations 4", "report/sweep"
    assert run(f"{sweep} --point 2/2")[0] == 0
    assert not (place / folder / "sweep.csv").exists()
    assert run(f"{sweep} --collect")[0] == 0
    assert len((place / folder / "sweep.csv").read_text().splitlines()) == 2
    refused(f"{sweep} --point 3/3", ("--point 3/3", "1 to 2"))
    refused(f"{sweep} --point 0/2", ("--point 0/2", "1 to 2"))
    code, out, err = run(f"{sweep} --json --jobs 1")
    assert (code, err) == (0, "") and json.loads(out)["missing"] == 0
    assert len((place / folder / "sweep.csv").read_text().splitlines()) == 3
    assert len((place / folder / "composition.csv").read_text().splitlines()) == 10
    for damage, words in (('{"version": 0}', ("'version'", "expected 2")), ("{", ("JSON",))):
        (place / folder / "sweep.json").write_text(damage)
        refused(f"{sweep} --collect", ("sweep.json", *words))


MISTAKES = [
    ("ablate nowhere -o out", ("nowhere", "packaged")),
    ("ablate bouncing --iterations 3 -o out", ("--iterations", "'3'")),
    ("ablate bouncing -o text/out", ("text/out", "folder that can be written")),
    ("sweep bouncing --lambda-rate , -o out", ("lambda_rate", "empty sweep")),
    ("sweep bouncing --collect -o out", ("out", "empty sweep")),
    ("sweep bouncing --point 4/3 -o out", ("--point 4/3", "1 to 15")),
    ("sweep bouncing --lambda-rate 1,-2 -o out", ("--lambda-rate", "'-2'")),
    ("sweep bouncing --lambda-rate 1,x -o out", ("--lambda-rate", "'x'")),
    ("sweep bouncing --point 1 -o out", ("--point", "I/N")),
    ("sweep bouncing --method nerf -o out", ("method 'nerf'",)),
    ("compare --method nerf -o out", ("method 'nerf'", "p4dgs, p4dgs_coded, d3dgs")),
    ("compare nowhere -o out", ("nowhere", "packaged")),
    ("compare --iterations 0 -o out", ("--iterations", "'0'")),
    ("compare --seeds 0 -o out", ("--seeds", "'0'")),
    ("compare bouncing -o text", ("text", "folder that can be written")),
]


@pytest.mark.parametrize("line, words", MISTAKES)
def test_mistakes(place, refused, line, words):
    (place / "text").write_text("")
    refused(line, words)
