"""The records of decisions and measurements run, and their lines keep the form of tutorials."""

import csv
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.tutorials.tutorial_form import flaws

FOLDER = Path(__file__).resolve().parents[2] / "tutorials"
RECORDS = [FOLDER / "beyond_networks.py", FOLDER / "growing_detail.py"]


def test_records_have_the_form_of_tutorials():
    assert {path.stem: flaws(path.read_text(encoding="utf-8")) for path in RECORDS} == {
        path.stem: [] for path in RECORDS
    }


@pytest.mark.slow
def test_the_record_of_networks_runs_and_its_decision_quotes_the_table(tmp_path):
    path, settings = FOLDER / "beyond_networks.py", {**os.environ, "P4DGS_TUTORIALS_OUT": tmp_path}
    done = subprocess.run(
        [sys.executable, path], capture_output=True, encoding="utf-8", env=settings
    )
    assert done.returncode == 0, done.stderr
    decision = path.read_text(encoding="utf-8").split("# ## Decision")[1]
    prices = re.findall(r"^ +0\.\d{5} +9 +(\S+) +(\S+) +\S+$", done.stdout, re.M)
    assert len(prices) == 3  # with nine pairs each
    assert (tmp_path / "beyond_networks.png").stat().st_size > 10_000
    assert all(share in decision and gain in decision for share, gain in prices)


def script():
    """The script of growing detail as a module of its own."""
    spec = importlib.util.spec_from_file_location("growing_detail", FOLDER / "growing_detail.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def growing(tmp_path, monkeypatch):
    """The same, with one tiny size and folders of its own."""
    module = script()
    module.ITERATIONS, module.FOLDER = 20, tmp_path / "trainings"
    module.LOSSES = module.LOSSES[:3]
    module.SIZES = {16: (1, ((20, 0), (40, 1, "narrow")), ((6, 0.0005),), ((12, 0.0005),))}
    module.RECORD = tmp_path / "growing_detail.csv"
    monkeypatch.setenv("P4DGS_TUTORIALS_OUT", str(tmp_path))
    return module


def test_growing_detail_is_made_in_parts_collected_and_drawn(growing, tmp_path, capsys):
    growing.main([])
    assert "no growing_detail.csv yet" in capsys.readouterr().out
    for words in (["mak"], ["make", "1/0"]):
        with pytest.raises(SystemExit, match="^2$"):
            growing.main(words)
        assert capsys.readouterr().err.endswith(": expected cost, make, make I/N or collect\n")
    assert [task.changes.get("deformation") for task in growing.plan()[3:5]] == [None, (32, 32)]
    growing.main(["make", "0/2"])
    made = [task.record.exists() for task in growing.plan()]
    assert made == [True] * 4 + [False] * 4 + [True, False]  # trainings with their coded files
    growing.main(["cost"])
    assert "detail_16: 2 trainings" in capsys.readouterr().out
    growing.main(["make", "1/2"])
    growing.main(["collect"])
    rows = list(csv.DictReader(growing.RECORD.read_text(encoding="utf-8").splitlines()))
    alike = ["coded alike"] * len(growing.LOSSES)
    assert [row["storage"] for row in rows] == 2 * ["as stored", *alike] + 2 * ["as stored"]
    assert len({row["sha256"] for row in rows}) == len(rows)
    before = growing.RECORD.read_bytes()
    growing.FOLDER = tmp_path / "another machine"  # makes nothing that the record has
    for word in ("make", "collect"):
        growing.main([word])
    assert growing.RECORD.read_bytes() == before and not [*growing.FOLDER.glob("points*")]
    capsys.readouterr()
    growing.main([])
    shown = capsys.readouterr().out
    assert "detail_16, times the bytes of ours that explicit Gaussians need" in shown
    for kind in (growing.FOUR, growing.ALONE):
        assert re.search(rf"^{kind}: \d.*\n  (\d+\.\d\d at|no PSNR)", shown, re.M)
    assert (tmp_path / "growing_detail.png").stat().st_size > 5000


def test_growing_detail_counts_numbers_and_says_where_curves_cross(growing, capsys):
    growing.count()
    growing.implied()
    counted = capsys.readouterr().out
    text = (FOLDER / "growing_detail.py").read_text(encoding="utf-8")
    for line in ("tiny_coded, a child of 4 8.5 0.25", "small_coded, a child of 1 17.0 1.00"):
        assert line in " ".join(counted.split())
    for name, numbers in (("degree 0", "11.0"), ("degree 1", "20.0"), ("degree 3", "56.0")):
        assert f"explicit, {name} {numbers} 1.00" in " ".join(counted.split())
    assert "34 numbers" in text and "8.5 numbers" in text and "17 numbers" in text
    gaussians = [int(n.replace(",", "")) for n in re.findall(r" (\d{3},\d{3}) ", counted)]
    assert len(gaussians) == 3 and max(gaussians) < 1.2 * min(gaussians)
    explicit = [(1000, 28.0), (4000, 32.0)]
    found = growing.at_levels(explicit, [(2000, 28.7), (2000.01, 31.4)])
    assert [*found] == [29, 29.5, 30, 30.5, 31, 31.4]
    assert [*found.values()] == pytest.approx([4 ** (i / 8) for i in (-2, -1, 0, 1, 2, 2.8)], 1e-5)
    row = {"kind": growing.FOUR, "each": 1.0, "factors": found}
    assert "\n  0.71 at 29 dB, 0.84 at 29.5 dB, 1.00 at 30 dB" in growing.told(row)
    row["factors"] = growing.at_levels(explicit, [(9, 40.0)])
    assert growing.told(row).endswith("\n  no PSNR that both reach")
    rows = [
        {"kind": kind, "label": f"{kind} {psnr}", "seed": seed, "bytes": size, "psnr_db": psnr}
        for seed, scale in enumerate((1.0, 1.1, 1.2))
        for kind in ("explicit", growing.FOUR)
        for size, psnr in ((s * scale if kind == growing.FOUR else s, p) for s, p in explicit)
    ]
    rows = [{**row, "held_back_db": row["psnr_db"]} for row in rows]
    more = {"scene": "detail", "gaussians": 10, "gaussians_bytes": 50}
    of_explicit, four = growing.summaries([{**row, **more} for row in rows])
    assert "factors" not in of_explicit
    assert "  0.91 at 28 dB" in growing.told(four)
    assert growing.told(four).endswith(
        "median 0.91 ±0.10 over 3 seeds, which cannot tell who needs fewer"
    )
    assert growing.told({**four, "error": 0.05}).endswith("median 0.91 ±0.05 over 3 seeds")
    assert growing.median_by_seed(rows[:4], growing.FOUR)[1:] == (np.inf, 1)


def test_growing_detail_draws_the_points_that_are_best_on_held_back_views(growing):
    """The second of the three is worse there, though better on test views."""
    rows = [
        {"kind": growing.FOUR, "label": str(size), "seed": 0, "bytes": size, "psnr_db": size / 100}
        for size in (1000, 2000, 3000)
    ]
    rows = [{**row, "held_back_db": db} for row, db in zip(rows, (28.0, 27.0, 29.0))]
    assert growing.curves_of(rows)[growing.FOUR] == [(1000, 10.0), (3000, 30.0)]
