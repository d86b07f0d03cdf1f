"""The paper can be read, run and tested with everything else deleted."""

import os
import shutil
import site
import subprocess
import sys

import pytest

from tests import ROOT
from tests.imports import imported

ROOMS = ("equations", "splatting", "scenes", "training", "codec")
OTHERS = ("oracle", "viewer")  # and the laboratory but for its random inputs
KEPT = (  # of the tests, which need no published vectors or streams
    *("equations", "numerics", "splatting", "scenes", "simulator", "training"),
    *("density", "pipeline_gradient", "container", "file", "entropy_coder", "fuzz"),
)


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
    gone, kept = {f"p4dgs_ref.{room}" for room in OTHERS}, {*(folder / "tests").rglob("*.py")}
    for file in (package / "lab").iterdir():
        if file.stem not in ("__init__", "random_inputs"):
            gone.add(f"p4dgs_ref.lab.{file.stem}")
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    for room in OTHERS:
        shutil.rmtree(package / room)
    while True:
        lost = {file for file in kept if needs(imported(file, folder / "tests"), gone)}
        if not lost:
            return
        kept -= lost
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
