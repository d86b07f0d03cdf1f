"""The house stays small: counts within the budget, imports that point one way, installed files."""

import configparser
import re
import subprocess
import sys
from shutil import which

import pytest

from tests import ROOT
from tests.budget import CEILINGS, PACKAGE, budget, files, imported, room_of, tokens
from tests.processes import CAPTURED

PACKAGE_FILES = files("p4dgs_ref")
# A room imports itself and the rooms before it. The first row is the ground floor.
ORDER = (
    *("version", "signals", "arithmetic", "limits"),
    *("equations", "splatting", "attributes", "effects", "model", "output", "scenes"),
    *("training", "codec", "report", "oracle", "lessons", "lab", "cli", "__main__", "__init__"),
)
PACKAGES = {"numpy", "scipy", "imageio", "matplotlib"}


# --- the budget ---------------------------------------------------------------------------------
def excess(entry, counts):
    """What to do where an entry counts more than its ceiling, in one line; "" where it does not."""
    count, ceiling = counts[entry], CEILINGS[entry]
    if count <= ceiling:
        return ""
    return (
        f"{entry}: {count:,}, at most {ceiling:,}: take out {count - ceiling:,} first; "
        "entries of tests/budget.json are never raised, `python -m tests.budget` counts"
    )


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="an f-string is several tokens there")
@pytest.mark.parametrize("entry", CEILINGS)
def test_counts_stay_within_their_budget(entry):
    line = excess(entry, budget())
    assert not line, line


def test_everything_is_counted_and_too_much_is_said():
    assert budget().keys() == CEILINGS.keys()
    counts = {"codec": CEILINGS["codec"] + 1}
    assert excess("codec", counts).startswith("codec: 11,601, at most 11,600: take out 1 first")


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="an f-string is several tokens there")
def test_tokens_are_counted_without_comments_and_docstrings(tmp_path):
    file = tmp_path / "sample.py"
    text = '"""A module."""\nx = 1  # one\ndef f():\n    """A function."""\n    return [f"{x}"]\n'
    file.write_text(text, encoding="utf-8")
    assert tokens(file) == len("x = 1 def f ( ) : return [ text ]".split())


# --- the order of the house ---------------------------------------------------------------------
def imported_rooms(file, package=PACKAGE):
    """The other rooms of the package that a file imports."""
    parts = [name.split(".") for name in imported(file, package)]
    found = {p[1] for p in parts if p[0] == package.name and len(p) > 1}
    return found - {file.relative_to(package).parts[0].removesuffix(".py")}


def test_rooms_import_only_rooms_before_them():
    rank = {room: i for i, room in enumerate(ORDER)}
    for file in PACKAGE_FILES:
        room = room_of(file)
        assert room in rank, f"{file.name}: {room} is a new room; give it a place in ORDER"
        wrong = {other for other in imported_rooms(file) if rank.get(other, 99) >= rank[room]}
        assert room == "__init__" or not wrong, f"{file.relative_to(ROOT)} imports {wrong}"


def test_imports_are_seen_wherever_they_stand(tmp_path):
    """Inside functions, of packages, through one dot and two."""
    file = tmp_path / "p4dgs_ref" / "codec" / "new.py"
    file.parent.mkdir(parents=True)
    lines = [
        "from .. import training",
        "from ..model import split",
        "from . import rans",
        "import p4dgs_ref.cli.parser",
        "def late():\n    from ..report.figures import pyplot\n    import torch.nn",
    ]
    file.write_text("\n".join(lines), encoding="utf-8")
    package = tmp_path / "p4dgs_ref"
    assert imported_rooms(file, package) == {"training", "model", "cli", "report"}
    assert "torch.nn" in {*imported(file, package)}


def test_only_the_named_packages_are_imported_and_never_the_tutorials():
    own = {"pytest", "p4dgs_ref", "tests", "tutorials"}
    for file in (file for room in ("p4dgs_ref", "tests", "tutorials") for file in files(room)):
        roots = {name.split(".")[0] for name in imported(file)} - set(sys.stdlib_module_names)
        allowed = PACKAGES | ({"p4dgs_ref"} if file in PACKAGE_FILES else own)
        assert roots <= allowed, f"{file.relative_to(ROOT)} imports {roots - allowed}"


# --- what is installed --------------------------------------------------------------------------
SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg")


def test_every_package_and_every_data_file_is_installed():
    """A file that no line of setup.cfg names is in the checkout alone."""
    made = {".".join(f.parent.relative_to(ROOT).parts) for f in PACKAGE.rglob("__init__.py")}
    assert set(SETUP["options"]["packages"].split()) == made | {"p4dgs_ref.tiny_scenes"}
    installed = set(PACKAGE_FILES)
    for name, patterns in SETUP["options.package_data"].items():
        folder = ROOT.joinpath(*name.split("."))
        installed |= {file for p in patterns.split(",") for file in folder.glob(p.strip())}
    present = {file for file in PACKAGE.rglob("*") if file.is_file() and file.suffix != ".pyc"}
    assert present <= installed, present - installed


def test_requirements_are_the_named_packages():
    required = SETUP["options"]["install_requires"].split()
    assert {re.split(r"\W", requirement)[0] for requirement in required} == PACKAGES
    assert SETUP["options.extras_require"]["test"].split() == ["pytest>=7.0.0"]


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".git").exists() or not which("git"), reason="no checkout")
def test_a_checkout_is_small():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, **CAPTURED).stdout
    files = [ROOT / name for name in listed.split("\0") if name]
    assert sum(file.stat().st_size for file in files if file.is_file()) <= 20_000_000
