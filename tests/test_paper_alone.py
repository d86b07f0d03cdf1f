"""The paper can be read, run and tested with everything else deleted."""

import os
import re
import shutil
import site
import subprocess
import sys

import pytest

from tests import ROOT
from tests.budget import PACKAGE, imported

ROOMS = ("equations", "splatting", "scenes", "training", "codec")
OTHERS = ("oracle", "viewer")  # and the laboratory but for its random inputs
MODULES = [
    *(file for room in ROOMS for file in sorted((PACKAGE / room).rglob("*.py"))),
    *(PACKAGE / f"{name}.py" for name in ("attributes", "effects", "model", "output")),
    PACKAGE / "codec" / "picture.txt",
]
KEPT = (  # of the tests, which need neither published vectors nor baselines
    *("equations", "numerics", "splatting", "scenes", "simulator", "training"),
    *("density", "pipeline_gradient", "file", "container", "entropy_coder", "conformance", "fuzz"),
)
OURS = re.compile(
    r"\bB[123]\b|is_coded|coded design|version 2|p4dgs_ref\.beyond|(import|from) .*\bbeyond\b"
)


def test_the_rooms_of_the_paper_hold_the_paper():
    """No word of what is ours stands in them, and no import of it."""
    words = {}
    for file in MODULES:
        lines = file.read_text(encoding="utf-8").splitlines()
        words |= {f"{file.name}:{i}": line for i, line in enumerate(lines, 1) if OURS.search(line)}
    assert not words


def in_copy(folder, *command):
    """Run Python where the package has the rooms of the paper alone.

    Without `site`, an editable installation would not add what was deleted.
    """
    path = os.pathsep.join([str(folder), *site.getsitepackages()])
    return subprocess.run(
        [sys.executable, "-S", *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        encoding="utf-8",
    )


def prune(folder):
    """Delete the rooms that are not the paper's, and what of the tests cannot be imported then.

    Random inputs stay, because the cases of equations are made with them.
    """
    package = folder / "p4dgs_ref"
    gone = {f"p4dgs_ref.{room}" for room in OTHERS}
    for file in (package / "lab").iterdir():
        if file.stem not in ("__init__", "random_inputs"):
            gone.add(f"p4dgs_ref.lab.{file.stem}")
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    for room in OTHERS:
        shutil.rmtree(package / room)
    files = {*(folder / "tests").rglob("*.py")}
    while True:
        lost = {file for file in files if needs(imported(file, folder / "tests"), gone)}
        if not lost:
            return
        files -= lost
        names = (".".join(file.relative_to(folder).with_suffix("").parts) for file in lost)
        gone |= {name.removesuffix(".__init__") for name in names}
        for file in lost:
            file.unlink()


def needs(names, gone):
    """Whether one of some imported names stands in a module that is gone."""
    return any(f"{name}.".startswith(f"{module}.") for name in names for module in gone)


@pytest.mark.slow
def test_the_paper_runs_alone(tmp_path):
    """Its tests pass, and `demo --preset tiny` trains, compresses, decodes and renders."""
    for name in ("p4dgs_ref", "tests", "tiny_scenes"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "README.md"):
        shutil.copy(ROOT / name, tmp_path)
    prune(tmp_path)
    stages = ("--set", "stage_ends=5,10,20,30")
    demo = in_copy(tmp_path, "-m", "p4dgs_ref", "demo", "--preset", "tiny", *stages, "-o", "report")
    assert demo.returncode == 0 and (tmp_path / "report" / "bouncing.p4dgs").exists(), demo.stderr
    left = {file.name for room in ROOMS for file in (tmp_path / "tests" / room).glob("test_*.py")}
    assert left >= {f"test_{name}.py" for name in KEPT}
    tests = in_copy(tmp_path, "-m", "pytest", "-q", *(f"tests/{room}" for room in ROOMS))
    assert tests.returncode == 0, tests.stdout
