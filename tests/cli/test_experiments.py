"""The commands of the paper's tables: their files, and their mistakes in one line."""

import json
import shlex
import time

import pytest

from p4dgs_ref.cli import parser as cli
from p4dgs_ref.lab.baselines import METHODS
from p4dgs_ref.lab.tables import compare

# Outside of pytest Python hides them; matplotlib 3.8 causes some with a new pyparsing.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
SHORT = "--iterations 4 --quiet"


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare, "TURNS", 1)
    return tmp_path


def run(line, capsys):
    """The exit code, stdout and stderr of a command."""
    try:
        code = cli.run(shlex.split(line), time.perf_counter())
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


def refused(line, words, place, capsys):
    before = sorted(place.rglob("*"))
    code, out, err = run(line, capsys)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert err.startswith("p4dgs-ref: ") and [w for w in words if w not in err] == [], err
    assert sorted(place.rglob("*")) == before


@pytest.mark.slow
def test_compare_quick_has_one_row_a_method(place, capsys):
    code, out, err = run(f"compare --quick -o out --json {SHORT}", capsys)
    assert (code, err) == (0, "")
    result = json.loads((place / "out/compare.json").read_text())
    assert json.loads(out) == result
    rows = result["methods"]
    assert [row["method"] for row in rows] == ["p4dgs", *METHODS]
    assert {(row["scene"], row["seed"]) for row in rows} == {("bouncing", 0)}
    for row in rows:
        ending = "p4dgs" if row["method"] == "p4dgs" else "ply"
        file = place / "out" / f"bouncing_{row['method']}_seed0.{ending}"
        assert file.stat().st_size == row["bytes"]


def test_sweep_point_by_point(place, capsys):
    sweep = f"sweep bouncing --seeds 1 --lambda-rate 0,0.5 {SHORT}"
    assert run(f"{sweep} --point 2/2", capsys)[0] == 0
    assert not (place / "report/sweep/sweep.csv").exists()
    assert run(f"{sweep} --collect", capsys)[0] == 0
    assert len((place / "report/sweep/sweep.csv").read_text().splitlines()) == 2
    refused(f"{sweep} --point 3/3", ("--point 3/3", "1 to 2"), place, capsys)
    refused(f"{sweep} --point 0/2", ("--point 0/2", "1 to 2"), place, capsys)
    code, out, err = run(f"{sweep} --json --jobs 1", capsys)
    assert (code, err) == (0, "") and json.loads(out)["missing"] == 0
    assert len((place / "report/sweep/sweep.csv").read_text().splitlines()) == 3
    assert len((place / "report/sweep/composition.csv").read_text().splitlines()) == 10
    (place / "report/sweep/sweep.json").write_text('{"version": 0}')
    refused(f"{sweep} --collect", ("sweep.json: 'version'", "expected 2"), place, capsys)
    (place / "report/sweep/sweep.json").write_text("{")
    refused(f"{sweep} --collect", ("sweep.json", "JSON"), place, capsys)


MISTAKES = [
    ("ablate nowhere -o out", ("nowhere", "packaged")),
    ("ablate bouncing --iterations 3 -o out", ("--iterations", "'3'")),
    ("sweep bouncing --lambda-rate , -o out", ("lambda_rate", "empty sweep")),
    ("sweep bouncing --collect -o out", ("out", "empty sweep")),
    ("sweep bouncing --point 4/3 -o out", ("--point 4/3", "1 to 15")),
    ("sweep bouncing --lambda-rate 1,-2 -o out", ("--lambda-rate", "'-2'")),
    ("sweep bouncing --point 1 -o out", ("--point", "I/N")),
    ("sweep bouncing --method nerf -o out", ("method 'nerf'",)),
    ("compare --method nerf -o out", ("method 'nerf'", "p4dgs, p4dgs_coded, d3dgs")),
    ("compare nowhere -o out", ("nowhere", "packaged")),
    ("compare --iterations 0 -o out", ("--iterations", "'0'")),
    ("compare --seeds 0 -o out", ("--seeds", "'0'")),
    ("compare bouncing -o text", ("text", "folder that can be written")),
]


@pytest.mark.parametrize("line, words", MISTAKES)
def test_mistakes(place, capsys, line, words):
    (place / "text").write_text("")
    refused(line, words, place, capsys)
