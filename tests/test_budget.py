"""The house stays readable: budgets in statements, short lines, imports that point one way."""

import ast
import configparser
import json
import re
import sys
from functools import cache

import pytest

from tests import processes
from tests.budget import (
    PACKAGE,
    ROOT,
    budget,
    imported,
    inside,
    is_docstring,
    parse,
    room_of,
    rooms,
    statements,
)

PACKAGE_FILES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
TUTORIALS = sorted((ROOT / "tutorials").rglob("*.py"))
FILES = [*PACKAGE_FILES, *TESTS, *TUTORIALS]

BUDGET = json.loads((ROOT / "tests" / "budget.json").read_text(encoding="utf-8"))
WIDTH = 100

# A room imports itself and the rooms before it.
ORDER = (
    "version",
    "signals",
    "arithmetic",
    "limits",
    "equations",
    "splatting",
    "attributes",
    "effects",
    "model",
    "output",
    "scenes",
    "training",
    "codec",
    "beyond",
    "designs",
    "report",
    "oracle",
    "lessons",
    "lab",
    "cli",
    "__main__",
    "__init__",
)
PACKAGES = {"numpy", "scipy", "imageio", "matplotlib"}


def name_of(file):
    return str(file.relative_to(ROOT))


@cache
def read(file):
    return file.read_text(encoding="utf-8")


def imported_rooms(file, package=PACKAGE):
    """The other rooms of the package that a file imports."""
    parts = [name.split(".") for name in imported(file, package)]
    found = {p[1] for p in parts if p[0] == package.name and len(p) > 1 and p[1] != "__version__"}
    return found - {file.relative_to(package).parts[0].removesuffix(".py")}


@cache
def counted():
    return budget()


@pytest.mark.parametrize("kind", BUDGET)
def test_counts_stay_within_their_budget(kind):
    """An entry that grows needs a sentence in the changelog that says what a reader gains."""
    assert counted()[kind] <= BUDGET[kind]


def test_everything_is_counted():
    assert counted().keys() == BUDGET.keys()


def test_statements_are_counted_without_docstrings(tmp_path):
    file = tmp_path / "sample.py"
    file.write_text(
        '"""A module."""\nx = 1\ndef f():\n    """A function."""\n    return [x]\n',
        encoding="utf-8",
    )
    assert statements(file) == 3
    assert sum(rooms().values()) == counted()["package"]


def test_lines_are_short():
    long = [
        f"{name_of(file)}:{number}"
        for file in FILES
        for number, line in enumerate(read(file).splitlines(), 1)
        if len(line) > WIDTH
    ]
    assert not long


def as_text(call):
    """Whether a call opens, reads or writes text, or pipes it, in the encoding of the system."""
    name, given = ast.unparse(call.func), {word.arg: word.value for word in call.keywords}
    mode = given.get("mode") or (call.args[1] if len(call.args) > 1 else ast.Constant("r"))
    if name in ("open", "os.fdopen") or name.endswith((".read_text", ".write_text")):
        return "encoding" not in given and "b" not in ast.literal_eval(mode)
    return "text" in given or "universal_newlines" in given


def test_text_is_utf_8_on_every_system():
    calls = [(f, node) for f in FILES for node in ast.walk(parse(f)) if isinstance(node, ast.Call)]
    assert [f"{name_of(f)}:{call.lineno}" for f, call in calls if as_text(call)] == []


def test_functions_hold_one_idea():
    """Counted in statements, like the rooms; nested functions count for the one around them."""
    long = {}
    for file in FILES:
        for node in inside(parse(file)):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                count = sum(not is_docstring(n) for n in inside(node))
                if count > 45:
                    long[f"{name_of(file)}: {node.name}"] = count
    assert not long


def test_files_say_what_they_are_for():
    """In the first line: a docstring, or in a tutorial the comment that opens its first cell."""
    for file in FILES:
        if file.name == "__init__.py" and file in TESTS:
            continue
        first = read(file).split("\n", 1)[0]
        is_tutorial = file in TUTORIALS and first.startswith("#")
        assert first.lstrip("r").startswith('"""') or is_tutorial, file


def test_nothing_is_left_to_do():
    marks = re.compile(r"\b(TO" r"DO|FIX" r"ME|XX" r"X)\b")
    written = [*FILES, *ROOT.glob("*.md")]
    assert not [name_of(file) for file in written if marks.search(read(file))]


def test_rooms_import_only_rooms_before_them():
    rank = {room: i for i, room in enumerate(ORDER)}
    for file in PACKAGE_FILES:
        room = room_of(file)
        assert room in rank, f"{name_of(file)}: {room} is a new room; give it a place in ORDER"
        if room == "__init__":
            continue
        wrong = {other for other in imported_rooms(file) if rank[other] >= rank[room]}
        assert not wrong, f"{name_of(file)} imports {wrong}"


def test_only_commands_and_tests_know_the_laboratory():
    """The paper never imports `lab/`, not even late."""
    knowing = {room_of(file) for file in PACKAGE_FILES if "lab" in imported_rooms(file)}
    assert knowing <= {"cli"}


def test_only_its_commands_and_tests_know_the_classroom():
    files = [*PACKAGE_FILES, *TUTORIALS, *(ROOT / "tests" / "oracle").rglob("*.py")]
    knowing = {
        name_of(file)
        for file in files
        if any(name.startswith("p4dgs_ref.lab.classroom") for name in imported(file))
    }
    assert {name for name in knowing if "/classroom/" not in name} == {"p4dgs_ref/cli/lab.py"}


def test_the_package_knows_no_module_of_the_tutorials():
    """Not even by a name that `import_module` would read."""
    strings = {
        (name_of(file), node.value)
        for file in PACKAGE_FILES
        for node in ast.walk(parse(file))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert not {pair for pair in strings if re.match(r"tutorials(\.\w+)*$", pair[1])} - {
        ("p4dgs_ref/lessons.py", "tutorials")  # the folder
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "run(['train', 'static', '--preset', 'smoke', '--quiet', '-o', sys.argv[1]], 0)",
        "p4.main_job(p4.load_scene('static'), folder=sys.argv[1], stage_ends=(1,2,3,4))",
    ],
)
def test_the_main_job_loads_nothing_of_the_laboratory(line, tmp_path):
    program = (
        "import sys; import p4dgs_ref as p4; from p4dgs_ref.cli.parser import run; "
        f"{line}; rooms = ('p4dgs_ref.lab', 'p4dgs_ref.lessons', 'p4dgs_ref.oracle'); "
        "print([name for name in sys.modules if name.startswith(rooms)])"
    )
    done = processes.run("-c", program, str(tmp_path / "report"))
    assert done.stdout.splitlines()[-1:] == ["[]"], done.stderr


def patches(tree):
    """The statements that assign to an attribute of an imported name, and calls that patch."""
    imports = [n for n in ast.walk(tree) if isinstance(n, (ast.Import, ast.ImportFrom))]
    names = {(a.asname or a.name).split(".")[0] for node in imports for a in node.names}
    for node in ast.walk(tree):
        target = isinstance(node, ast.Attribute) and not isinstance(node.ctx, ast.Load)
        if target and ast.unparse(node.value).split(".")[0] in names:
            yield ast.unparse(node)
        if isinstance(node, ast.Call) and ast.unparse(node.func) in (
            "setattr",
            "patch",
            "mock.patch",
        ):
            yield ast.unparse(node)


def test_no_module_assigns_to_an_attribute_of_another():
    """Who looks uses `training.watch`; who changes something passes it as an argument."""
    # what Python's documentation wants assigned, and an object of the function's own
    allowed = ("warnings.showwarning", "setattr(sys, name, stream)", "setattr(values,")
    found = [(name_of(file), patch) for file in PACKAGE_FILES for patch in patches(parse(file))]
    assert [(file, patch) for file, patch in found if not patch.startswith(allowed)] == []


@pytest.mark.parametrize(
    "line",
    [
        "np.rint = f",
        "fast.forward, x = f, 1",
        "setattr(fast, 'a', 1)",
        "del fast.a.b",
        "fast.n += 1",
    ],
)
def test_patches_are_found(line):
    tree = ast.parse(f"import numpy as np\nfrom .splatting import fast\nmine.a = 3\n{line}")
    assert len(list(patches(tree))) == 1


MAKES_FIGURES = re.compile(r"(?<![.\w])(figures\.)?(new_figure|subplots|save_figure)\(")


def test_every_figure_is_drawn_in_a_style_of_the_project():
    """And only tutorials use pyplot, whose figures and backend belong to the program."""
    plain = [
        f"{file.stem}: {node.name}"
        for file in [*PACKAGE_FILES, *(ROOT / "tutorials" / "tools").glob("*.py")]
        for node in inside(parse(file))
        if isinstance(node, ast.FunctionDef) and MAKES_FIGURES.search(ast.unparse(node.body))
        if "styled(" not in "".join(map(ast.unparse, node.decorator_list))
    ]
    assert plain == ["figures: subplots"]
    users = [name_of(file) for file in PACKAGE_FILES if "import matplotlib.pyplot" in read(file)]
    assert users == ["p4dgs_ref/lessons.py"]


def test_the_package_imports_only_the_named_packages():
    for file in PACKAGE_FILES:
        allowed = {"numpy", "scipy"} if room_of(file) == "equations" else PACKAGES
        roots = {name.split(".")[0] for name in imported(file)}
        foreign = roots - {PACKAGE.name} - set(sys.stdlib_module_names)
        assert foreign <= allowed, f"{name_of(file)}: {foreign - allowed}"


def test_tests_and_tutorials_import_only_the_named_packages():
    allowed = PACKAGES | {"pytest", "p4dgs_ref", "tests", "tutorials"}
    for file in [*TESTS, *TUTORIALS]:
        roots = {name.split(".")[0] for name in imported(file)}
        foreign = roots - set(sys.stdlib_module_names) - allowed
        assert not foreign, f"{name_of(file)}: {foreign}"


def test_no_test_module_imports_another():
    for file in TESTS:
        wrong = [name for name in imported(file) if re.search(r"\btests\.(\w+\.)*test_", name)]
        assert not wrong, f"{name_of(file)} imports {wrong}"


def test_tests_mirror_the_package():
    folders = {file.parent.name for file in TESTS if file.parent != ROOT / "tests"}
    rooms = {"equations", "splatting", "scenes", "training", "codec"}
    assert rooms | {"report", "oracle", "lab", "cli", "golden"} <= folders


def test_imports_are_seen_wherever_they_stand(tmp_path):
    """Inside functions, of packages, through one dot and two."""
    package = tmp_path / "p4dgs_ref"
    (package / "codec").mkdir(parents=True)
    file = package / "codec" / "new.py"
    file.write_text(
        "from .. import training\n"
        "from ..model import split\n"
        "from . import rans\n"
        "import p4dgs_ref.cli.parser\n"
        "def late():\n"
        "    from ..report.figures import pyplot\n"
        "    import torch.nn\n",
        encoding="utf-8",
    )
    assert imported_rooms(file, package) == {"training", "model", "cli", "report"}
    assert "torch.nn" in set(imported(file, package))


SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg")


def test_every_package_is_installed():
    made = {".".join(f.parent.relative_to(ROOT).parts) for f in PACKAGE.rglob("__init__.py")}
    used = {".".join(file.parent.relative_to(ROOT).parts) for file in PACKAGE_FILES}
    used -= {"p4dgs_ref.oracle.v1"}  # data, with a program among them
    assert made == used
    assert set(SETUP["options"]["packages"].split()) == made | {"p4dgs_ref.tiny_scenes"}


def test_every_data_file_is_installed():
    """A file that no pattern of setup.cfg names is in the checkout alone."""
    installed = set(PACKAGE_FILES)
    for name, patterns in SETUP["options.package_data"].items():
        folder = ROOT.joinpath(*name.split("."))
        installed |= {file for p in patterns.split(",") for file in folder.glob(p.strip())}
    files = {file for file in PACKAGE.rglob("*") if file.is_file() and file.suffix != ".pyc"}
    assert files <= installed, files - installed


def test_requirements_are_the_named_packages():
    required = SETUP["options"]["install_requires"].split()
    assert {re.split(r"\W", requirement)[0] for requirement in required} == PACKAGES
    assert SETUP["options.extras_require"]["test"].split() == ["pytest>=7.0.0"]
