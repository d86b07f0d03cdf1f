"""The house stays readable: files, functions and rooms within the README's budget, imports pointing one way."""

import ast
import configparser
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "p4dgs_ref"
PACKAGE_FILES = sorted(
    file for file in PACKAGE.rglob("*.py") if file.name != "example_adapter.py"
)  # that is data
FILES = PACKAGE_FILES + sorted(
    [*(ROOT / "tests").rglob("*.py"), *(ROOT / "tutorials").rglob("*.py")]
)
WIDTH = 130  # characters; 120 is what we aim at

# A room imports itself and rooms of earlier rows; rooms of one row do not know each other.
ROWS = (
    ("equations", "output", "lazy"),
    ("splatting", "networks"),
    ("scenes", "sixty_digits"),
    ("effects",),
    ("model",),
    ("training", "codec"),
    ("stability",),
    ("experiments",),
    ("oracle",),
    ("catalogue", "text", "lessons"),
    ("gallery",),
    ("syllabus",),
    ("school",),
    ("commands",),
    ("cli",),
    ("__main__", "__init__"),
)
ROW_OF = {room: i for i, row in enumerate(ROWS) for room in row}
PACKAGES = {"numpy", "scipy", "imageio", "matplotlib"}


def name_of(file):
    return str(file.relative_to(ROOT))


@cache
def read(file):
    return file.read_text(encoding="utf-8")


@cache
def parse(file):
    return ast.parse(read(file), str(file))


def imported(file, package=PACKAGE):
    """What a file imports, at its top and inside functions: full dotted names; relative ones resolved."""
    here = [package.name, *file.relative_to(package).parts[:-1]] if package in file.parents else []
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{start}.{alias.name}" for alias in node.names)


def room_of(file, package=PACKAGE):
    """The first part of a module's name below the package."""
    return file.relative_to(package).parts[0].removesuffix(".py")


def rooms(file, package=PACKAGE):
    """The other rooms that a file imports; a name of the package itself (`__version__`) is none."""
    parts = (name.split(".") for name in imported(file, package))
    found = {p[1] for p in parts if p[0] == package.name and len(p) > 1 and p[1] != "__version__"}
    return found - {room_of(file, package)}


def test_files_are_short():
    most = {file: 100 if file.parent == PACKAGE / "equations" else 300 for file in FILES}
    lines = {file: len(read(file).splitlines()) for file in FILES}
    assert not {name_of(file): n for file, n in lines.items() if n > most[file]}


def test_lines_are_short():
    assert not [
        f"{name_of(file)}:{i}"
        for file in FILES
        for i, line in enumerate(read(file).splitlines(), 1)
        if len(line) > WIDTH
    ]


def test_functions_are_short():
    functions = [
        (file, node)
        for file in FILES
        for node in ast.walk(parse(file))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    ]
    assert len(functions) > 500
    lines = {f"{name_of(file)}: {f.name}": f.end_lineno - f.lineno + 1 for file, f in functions}
    assert not {name: n for name, n in lines.items() if n > 60}


def test_files_say_what_they_are_for():
    """In the first line; a tutorial's is a comment that opens its first cell."""
    for file in FILES:
        first = read(file).split("\n", 1)[0]
        assert (
            first.lstrip("r").startswith('"""')
            or ROOT / "tutorials" in file.parents
            and first[:1] == "#"
        ), file


def test_nothing_is_left_to_do():
    marks = re.compile(r"\b(TO" r"DO|FIX" r"ME|XX" r"X)\b")
    assert not [
        name_of(file)
        for file in [*FILES, ROOT / "README.md", ROOT / "CHANGELOG.md"]
        if marks.search(read(file))
    ]


def test_lines_are_within_what_the_readme_says():
    """The README's own commands, run; a limit far above the count would promise nothing."""
    rows = re.findall(
        r"^\| (.*?) \| `(.*?)` \| ([\d,]+) \|$", read(ROOT / "README.md"), re.MULTILINE
    )
    assert len(rows) == 3
    for what, command, most in rows:
        done = subprocess.run(
            ["bash", "-c", command.replace("\\|", "|")], cwd=ROOT, capture_output=True, text=True
        )
        most, lines = int(most.replace(",", "")), int(done.stdout)
        assert 0.7 * most < lines <= most, f"{what}: {lines} lines"
    limits = [
        int(n) for n in re.findall(r"more than (\d+)", read(ROOT / "README.md").split("\n## ")[0])
    ]
    assert limits == [300, 60, 100]


def test_rooms_import_only_rooms_before_them():
    for file in PACKAGE_FILES:
        for room in {room_of(file), *rooms(file)}:
            assert room in ROW_OF, f"{name_of(file)}: {room} is a new room; give it a place in ROWS"
        wrong = [other for other in rooms(file) if ROW_OF[other] >= ROW_OF[room_of(file)]]
        assert not wrong, f"{name_of(file)} imports {wrong}"
    assert set(ROW_OF) == set(map(room_of, PACKAGE_FILES))


def test_packages_are_the_named_ones():
    for file in FILES:
        foreign = (
            {name.split(".")[0] for name in imported(file)}
            - {PACKAGE.name}
            - set(sys.stdlib_module_names)
        )
        if PACKAGE in file.parents:
            allowed = {"numpy", "scipy"} if room_of(file) == "equations" else PACKAGES
        else:
            allowed = PACKAGES | {"pytest"} | {other.stem for other in file.parent.glob("*.py")}
        assert foreign <= allowed, f"{name_of(file)}: {foreign - allowed}"


def test_imports_are_seen_wherever_they_stand(tmp_path):
    """Inside functions, of packages, through one dot and two."""
    package = tmp_path / "p4dgs_ref"
    (package / "codec").mkdir(parents=True)
    file = package / "codec" / "new.py"
    file.write_text(
        "from .. import training\nfrom ..model import split\nfrom . import rans\nimport p4dgs_ref.cli.parser\n"
        "def late():\n    from ..experiments.report import pyplot\n    import torch.nn\n"
    )
    assert (
        rooms(file, package) == {"training", "model", "cli", "experiments"}
        and room_of(file, package) == "codec"
    )
    assert "torch.nn" in set(imported(file, package))


def test_what_is_installed_is_all_there_is():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    folders = {
        ".".join(file.parent.relative_to(ROOT).parts) for file in PACKAGE.rglob("__init__.py")
    }
    assert folders == {".".join(file.parent.relative_to(ROOT).parts) for file in PACKAGE_FILES}
    assert set(setup["options"]["packages"].split()) == folders | {"p4dgs_ref.tiny_scenes"}
    wanted = {
        re.split(r"\W", requirement)[0]
        for requirement in setup["options"]["install_requires"].split()
    }
    assert wanted == PACKAGES and setup["options.extras_require"]["test"].split() == ["pytest>=7"]


def test_top_level_holds_only_what_belongs_there():
    try:
        listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("git is not installed")
    if listed.returncode:
        pytest.skip("not a checkout")
    tops = {name.split("/")[0] for name in listed.stdout.splitlines()}
    assert tops <= {
        "setup.cfg",
        "p4dgs_ref",
        "tutorials",
        "tests",
        "tiny_scenes",
        "CHANGELOG.md",
        "README.md",
        "LICENSE",
        "pyproject.toml",
        ".ci",
        ".gitignore",
    }


def test_no_path_of_a_machine():
    texts = [
        ROOT / name
        for name in (
            "README.md",
            "CHANGELOG.md",
            "LICENSE",
            ".ci/run",
            "setup.cfg",
            "pyproject.toml",
        )
    ]
    for file in texts + PACKAGE_FILES:
        found = re.search(r"(?<![\w.<])/(home|root|tmp|work|Users|opt|mnt)/", read(file))
        assert not found, f"{name_of(file)}: {found[0]}"
