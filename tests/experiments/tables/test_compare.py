"""All methods in one table: summaries, ratios and notes against independent sums."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.lab.tables import compare as study
from p4dgs_ref.lab.tables.methods import OURS

from .shared import OTHERS

CHOSEN = [OURS, *(label for name in OTHERS for label in (name, f"{name} sh_degree=0"))]


def test_every_method_has_a_row_for_each_seed(compared):
    folder, result = compared
    assert json.loads((folder / "compare.json").read_text(encoding="utf-8")) == json.loads(
        json.dumps(result)
    )
    rows = result["methods"]
    assert [(row["seed"], row["label"]) for row in rows] == [(s, m) for s in (0, 1) for m in CHOSEN]
    for row in rows:
        assert min(row["render_fps"], row["train_seconds"], row["psnr_db"]) > 0
        assert row["iterations"] == 4
    assert {row["sh_degree"] for row in rows if row["label"].endswith("=0")} == {0}
    one, other = (row["psnr_db"] for row in rows if row["label"] == OURS)
    assert one != other
    assert iio.imread(folder / "compare.png").std() > 5


def test_summary_and_ratios(compared):
    _, result = compared
    psnr = {m: [r["psnr_db"] for r in result["methods"] if r["label"] == m] for m in CHOSEN}
    size = {m: np.mean([r["bytes"] for r in result["methods"] if r["label"] == m]) for m in CHOSEN}
    assert {own["label"]: own["bytes"] for own in result["summary"]} == size
    for other in result["against"]:
        name = other["label"]
        assert other["ratio"] == pytest.approx(size[name] / size[OURS])
        assert 0 < other["ratio"] - other["network_share"] - other["gaussians_share"] < 0.2
        gains = np.subtract(psnr[OURS], psnr[name])
        assert other["psnr_gain"] == pytest.approx(gains.mean())
        assert other["psnr_gain_range"] == pytest.approx([gains.min(), gains.max()])


def test_the_tables_show_the_papers_numbers_apart(compared):
    text = study.to_text(compared[1]).splitlines()
    heading = next(i for i, line in enumerate(text) if line.startswith("method"))
    assert text[heading].count("the paper's") == 2
    assert [line.split("  ")[0] for line in text[heading + 1 :][: len(CHOSEN)]] == CHOSEN
    assert "ignore a scene's list of effects" in text[heading - 1]
    ours = " ".join(text[heading + 1].split())
    assert ours.endswith("38.10 0.985 1.039 262 24.18 0.855 0.704 274")
    assert text[heading + 2].split()[0] == "d3dgs_small"
    assert text[heading + 2].split()[-2:] == ["-", "-"]
