"""pyright's errors by room: none in what a learner opens first, a few elsewhere."""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.budget import ROOT, room_of

CLEAN = {"equations", "splatting", "model"}
MOST = 40  # errors in the other rooms together


@pytest.mark.slow
def test_pyright_finds_nothing_in_the_equations_and_little_elsewhere():
    beside = str(Path(sys.executable).parent)
    pyright = shutil.which("pyright", path=os.pathsep.join([beside, os.environ["PATH"]]))
    if pyright is None:
        pytest.skip("pyright is not installed")
    run = subprocess.run([pyright, "--outputjson"], cwd=ROOT, capture_output=True, encoding="utf-8")
    found = json.loads(run.stdout)["generalDiagnostics"]
    rooms = Counter(room_of(Path(row["file"])) for row in found if row["severity"] == "error")
    assert not CLEAN & set(rooms), rooms
    assert rooms.total() <= MOST, rooms
