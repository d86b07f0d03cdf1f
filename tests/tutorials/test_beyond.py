"""The records of decisions beyond the paper run, and their lines keep the form of tutorials."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tutorials.tutorial_form import flaws

FOLDER = Path(__file__).resolve().parents[2] / "tutorials"
RECORDS = sorted(FOLDER.glob("beyond_*.py"), key=lambda path: path.name)


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
