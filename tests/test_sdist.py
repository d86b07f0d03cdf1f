"""The source distribution holds what the repository holds, and runs its own tests."""

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from tests import ROOT

BUILT = (".git", ".venv", "venv", "build", "dist", "*.egg-info", "__pycache__", ".*_cache")


def not_sources(folder, names):
    """What a copy of the repository leaves out, for `shutil.copytree`."""
    made_by_a_run = {"report", "runs"} if Path(folder) == ROOT else set()
    return made_by_a_run | shutil.ignore_patterns(*BUILT)(folder, names)


def files(folder):
    """The files under a folder, without what a build or a test run leaves there."""
    left = ("__pycache__", ".egg-info", ".pytest_cache", "PKG-INFO", "tutorials/out")
    left += ("tutorials/notebooks/out", ".ipynb_checkpoints")
    paths = (str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())
    return {path for path in paths if not any(name in path for name in left)}


@pytest.mark.slow
def test_source_distribution_is_whole(tmp_path):
    pytest.importorskip("setuptools", reason="the build backend is not installed")
    source = tmp_path / "source"
    shutil.copytree(ROOT, source, ignore=not_sources)
    call = [sys.executable, "-c", "import setuptools; setuptools.setup()", "-q", "sdist"]
    subprocess.run([*call, "-d", str(tmp_path)], cwd=source, check=True, capture_output=True)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        archive.extractall(tmp_path / "unpacked")
    unpacked = next((tmp_path / "unpacked").iterdir())
    assert files(unpacked) == files(source)
    names = ["tests/equations/test_numerics.py", "tests/test_lessons.py"]
    run = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *names]
    result = subprocess.run(run, cwd=unpacked, capture_output=True, encoding="utf-8")
    assert result.returncode == 0, result.stdout
