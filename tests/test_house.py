"""The order of the rooms, the packages that are imported, and the files that are installed."""

import configparser
import re
import sys

from tests import ROOT
from tests.imports import PACKAGE, files, imported

PACKAGE_FILES = files("p4dgs_ref")
# A room imports itself and the rooms before it. The first row is the ground floor.
ORDER = (
    *("version", "signals", "arithmetic", "limits", "messages"),
    *("equations", "splatting", "attributes", "effects", "model", "output", "scenes"),
    *("training", "codec", "report", "oracle", "lessons", "lab", "cli", "__main__", "__init__"),
)
PACKAGES = {"numpy", "scipy", "imageio", "matplotlib"}


# --- the order of the house ---------------------------------------------------------------------
def room_of(file, package=PACKAGE):
    """The first part of a module's path below the package."""
    return file.relative_to(package).parts[0].removesuffix(".py")


def imported_rooms(file, package=PACKAGE):
    """The other rooms of the package that a file imports."""
    parts = [name.split(".") for name in imported(file, package)]
    found = {p[1] for p in parts if p[0] == package.name and len(p) > 1}
    return found - {room_of(file, package)}


def test_rooms_import_only_rooms_before_them():
    rank = {room: i for i, room in enumerate(ORDER)}
    for file in PACKAGE_FILES:
        room = room_of(file)
        assert room in rank, f"{file.name}: {room} is a new room; give it a place in ORDER"
        later = {other for other in imported_rooms(file) if rank.get(other, 99) >= rank[room]}
        assert room == "__init__" or not later, (
            f"{file.relative_to(ROOT)} imports {later}, and {room} stands before it in ORDER: data "
            "flow one way, so that a reader meets no room that needs a later one"
        )


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
