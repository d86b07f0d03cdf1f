"""The records of decisions beyond the paper run, and their lines keep the form of tutorials."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from p4dgs_ref import decode, encode
from tests.codec.models import random_model
from tests.lab.school.tutorial_form import flaws

FOLDER = Path(__file__).resolve().parents[3] / "tutorials"
RECORDS = sorted(FOLDER.glob("beyond_*.py"), key=lambda path: path.name)


def run(path, folder, *arguments):
    """The text that a record prints; its figures go into the folder."""
    settings = {**os.environ, "P4DGS_TUTORIALS_OUT": str(folder)}
    command = [sys.executable, path, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=settings)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_records_have_the_form_of_tutorials():
    assert {path.stem: flaws(path.read_text(encoding="utf-8")) for path in RECORDS} == {
        path.stem: [] for path in RECORDS
    }


@pytest.mark.slow
@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_runs_as_it_stands(path, tmp_path):
    run(path, tmp_path)
    assert (tmp_path / f"{path.stem}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_decision_about_networks_quotes_the_table(tmp_path):
    path = FOLDER / "beyond_networks.py"
    decision = path.read_text(encoding="utf-8").split("# ## Decision")[1]
    reference = (FOLDER / "reference.md").read_text(encoding="utf-8")
    prices = re.findall(r"^ +0\.\d{5} +9 +(\S+) +(\S+) +(\S+)$", run(path, tmp_path), re.M)
    assert len(prices) == 3  # with nine pairs each
    for share, gain, worst in prices:
        for page in (decision, reference):
            assert share in page and gain in page
        assert worst in reference


@pytest.mark.slow
def test_positions_of_other_files(tmp_path):
    for coded in (False, True):
        model = random_model(1, anchors=30, coded=coded, position_bits=10 if coded else 16)
        (tmp_path / f"coded_{coded}.p4dgs").write_bytes(encode(model))
    files = sorted(tmp_path.glob("*.p4dgs"))
    text = run(FOLDER / "beyond_positions.py", tmp_path, *files)
    for file in files:
        assert f"{file.stem}, {decode(file.read_bytes()).primitives} anchors" in text
