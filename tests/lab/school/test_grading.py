"""The grader: its points for what students write, what they cannot break, and its reports."""

import ast
import csv
import io
import json
import re
import shutil
import time
from pathlib import Path

import pytest

from p4dgs_ref.cli.parser import run
from p4dgs_ref.lab import school
from p4dgs_ref.lab.school import grading
from p4dgs_ref.lab.school.guard import ALIKE, copies
from p4dgs_ref.lab.school.room import (
    TEACHER,
    functions_in,
    functions_of,
    kept,
    source_of,
    stub_of,
    text_of,
)
from p4dgs_ref.lab.school.syllabus import TUTORIALS
from p4dgs_ref.oracle import published
from tests.sampling import few

KEYS = published.equations()
RIGHT = "x = x_a[:, None, :] + O_a * l_a[:, None, :]\n"
AS_LOGARITHM = "return x_a[:, None, :] + O_a * np.exp(l_a)[:, None, :], (O_a, l_a)"
WITHOUT_SCALING = "return x_a[:, None, :] + O_a, (O_a, l_a)"
FOLDER = Path(__file__).resolve().parents[3] / "tutorials"
WHOLE_PAPER, SOLUTIONS = FOLDER / "00_whole_paper.py", sorted((FOLDER / "solutions").glob("*.py"))
PRINTED = '''"""Eq. (11) as printed, and its gradients by the textbook."""
import numpy as np
from scipy.special import ndtr


def forward(f_noisy, mu, sigma, q):
    above, below = (f_noisy + q / 2 - mu) / sigma, (f_noisy - q / 2 - mu) / sigma
    p = ndtr(above) - ndtr(below)
    return -np.log2(p), (above, below, p, sigma)


def backward(saved, bits_bar):
    above, below, p, sigma = saved
    p_bar = -bits_bar / (p * np.log(2))
    above_bar = p_bar * np.exp(-above * above / 2) / np.sqrt(2 * np.pi)
    below_bar = -p_bar * np.exp(-below * below / 2) / np.sqrt(2 * np.pi)
    f_noisy_bar = (above_bar + below_bar) / sigma
    return {
        "f_noisy": f_noisy_bar,
        "mu": -f_noisy_bar,
        "sigma": -(above_bar * above + below_bar * below) / sigma,
        "q": (above_bar - below_bar) / (2 * sigma),
    }
'''
LATER = 'raise NotImplementedError("later")'


def write(folder, key, forward=None, backward=None):
    """Write a student's file with these bodies; None stands for the reference's body."""
    source = source_of(key)
    for name, body in (("forward", forward), ("backward", backward)):
        if body is not None:
            node, lines = functions_in(source)[name], source.splitlines()
            mine = [f"    {line}" for line in body.splitlines()]
            lines[kept(node)[-1].end_lineno : node.end_lineno] = mine
            source = "\n".join(lines) + "\n"
    (folder / "student" / f"{key}.py").write_text("import numpy as np\n" + source, encoding="utf-8")


@pytest.fixture
def room(tmp_path):
    school.classroom(tmp_path / "room", ["offsets"])
    return tmp_path / "room"


def graded(room, forward=None, backward=None, key="offsets", **options):
    """The row of one equation with these bodies."""
    school.classroom(room, [key])
    write(room, key, forward, backward)
    (student,) = school.grade(room, **{"seed": 0, **options})["students"]
    return next(row for row in student["equations"] if row["key"] == key)


def points(row):
    return {part["name"]: round(part["points"], 6) for part in row["parts"]}


# --- points ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "keys", [["offsets", "rounding"], pytest.param(KEYS, marks=pytest.mark.slow)], ids=len
)
def test_the_key_gets_all_points_and_files_not_begun_get_none(tmp_path, keys):
    school.classroom(tmp_path, keys)
    grades = school.grade(tmp_path, tmp_path / "key", seed=4)
    empty, full = grades["students"]
    assert grades["seed"] == 4 and empty["points"] == 0 and empty["of"] == 10 * len(keys)
    assert {row["note"] for row in empty["equations"]} == {"not begun"}
    for row in full["equations"]:
        assert sum(part["points"] for part in row["parts"]) == pytest.approx(10), row
        assert row["first"] == ""


def test_every_equation_is_worth_ten():
    for key in KEYS:
        assert sum(of for _, of, _, _ in grading.points_of(key)) == pytest.approx(10), key


NO_SUM = """return {"x_a": x_bar[:, -1], "O_a": x_bar * l_a[:, None, :],
"l_a": (x_bar * O_a).sum(axis=1)}"""
NO_FACTOR = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar, "l_a": (x_bar * O_a).sum(axis=1)}'
TWO = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar * l_a[:, None, :]}'
AWAY = """sign = np.where(f / q < 0, -1, 1)
symbols = (sign * np.floor(np.abs(f / q) + 0.5)).astype(np.int64)
return (symbols, symbols * q), ()"""
LIST = """v = x_a - x_c
d = np.sqrt((v * v).sum(axis=1, keepdims=True))
return [d, v / d], (d, v)"""
# key, forward, backward, least and most points, points of some parts, what `first` says, and what
# the explanation or the hint says
GRADED = {
    "right": ("offsets", RIGHT + "return x, (O_a, l_a)", None, 10, 10, {}, "", ""),
    "forward alone": (
        *("offsets", None, LATER, 5, 5),
        {"forward": 3, "gradient of x_a": 0, "hard cases: outputs": 2, "hard cases: gradients": 0},
        *("offsets/ordinary#1: backward: not written yet (later)", ""),
    ),
    "backward alone, on what the reference saves": (
        *("offsets", LATER, None, 5, 5, {"gradient of l_a": 1}),
        *("offsets/ordinary#1: forward: not written yet (later)", ""),
    ),
    "a gradient without its sum": (
        *("offsets", None, NO_SUM, 6.5, 8.5),
        {"gradient of x_a": 0, "gradient of O_a": 1, "forward": 3},
        *("offsets/ordinary#1: in_bar.x_a[", ""),
    ),
    "a known mistake, not punished twice": (
        *("offsets", AS_LOGARITHM, None, 4, 6, {"forward": 0, "gradient of x_a": 1}, "got", "log"),
    ),
    # exp(l_a) is 1 in the case where l_a is 0: explains that case by accident
    "an unknown mistake": ("offsets", None, NO_FACTOR, 4, 8, {}, "in_bar.O_a", ""),
    "a missing gradient": ("offsets", None, TWO, 6, 9, {}, "in_bar.l_a: missing", ""),
    "float32": (
        *("offsets", RIGHT + "return x.astype(np.float32), (O_a, l_a)", None, 4, 6, {}),
        *("float32, expected float64", ""),
    ),
    "no pair": ("offsets", RIGHT + "return x", None, 5, 5, {}, "expected a pair", ""),
    "no dictionary": ("offsets", None, "return x_bar", 5, 5, {}, "expected a dictionary", ""),
    "an error": ("offsets", "return 1 / 0", None, 5, 5, {}, "ZeroDivisionError", ""),
    "a list of outputs": ("view", LIST, None, 4, 6, {}, "tuple of delta_vc, d_vc", ""),
    # beside a tie, adding a half rounds up, which is another mistake than the known one
    "only hard cases": ("rounding", AWAY, None, 6, 9.9, {"forward": 6}, "rounding/", "even"),
    "prints and changed inputs": (
        *("offsets", 'print("x" * 100_000)\n' + RIGHT + "x_a[:] = 7\nreturn x, (O_a, l_a)"),
        *(None, 10, 10, {}, "", ""),
    ),
    "names that mean something else": (
        "offsets",
        "modules, eval, gc, EQUATIONS = x_a, O_a, l_a, None\nimport sys, inspect\n"
        + RIGHT
        + "return x, (O_a, l_a)",
        *(None, 10, 10, {}, "", ""),
    ),
    # what the reference's forward saves contains the weights, hence it is not lent
    "the merged file": (
        *("hash_grid", "from p4dgs_ref.equations.grid_nodes import locate\nreturn 1, 2", None),
        *(0, 0, {"gradient of grids": 0}, "equations.grid_nodes cannot be imported", ""),
    ),
    # each costs only its own function
    "hangs": ("offsets", "while True:\n    pass", None, 0, 5, {}, "hung", ""),
    "ends the process": ("offsets", "import os\nos._exit(3)", None, 0, 5, {}, "exit code 3", ""),
    "ends politely": ("offsets", "import sys\nsys.exit(0)", None, 5, 5, {}, "SystemExit", ""),
    "recursion": ("offsets", "return forward(x_a, O_a, l_a)", None, 5, 5, {}, "RecursionErr", ""),
    "is killed": (
        *("offsets", "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)", None, 0, 5),
        *({}, "signal 9", ""),
    ),
    "no numbers": ("offsets", "return np.array(['x']), None", None, 5, 5, {}, "out.x: missing", ""),
    "reads": ("offsets", "input()", None, 5, 5, {}, "EOFError", ""),
    "prints endlessly": (
        *("offsets", "while True:\n    print('x' * 10000)", None, 0, 5, {}, "hung", ""),
    ),
}


@pytest.mark.parametrize("name", few(list(GRADED), 3))
def test_points_and_reasons(name, tmp_path):
    key, forward, backward, least, most, parts, first, known = GRADED[name]
    start = time.monotonic()
    row = graded(tmp_path, forward, backward, key, timeout=1.0 if most <= 5 else 5.0)
    assert least - 1e-9 <= row["points"] <= most + 1e-9
    assert points(row) | parts == points(row)
    assert first in row["first"] and bool(first) == bool(row["first"])
    assert "expected " not in row["first"].replace("expected a", "").replace("expected fl", "")
    said = row["explanation"] or row["hint"]
    assert known in said and bool(known) == bool(said)
    assert time.monotonic() - start < 60


def test_time_of_an_equation_is_limited(room, monkeypatch):
    monkeypatch.setattr(grading, "SECONDS", 0)
    row = graded(room)
    assert row["points"] == 0
    assert row["first"] == "offsets/ordinary#1: not asked, because 0 s are over"


@pytest.mark.parametrize(
    "text, note, first",
    [
        ("def forward(:\n", "cannot be read", "SyntaxError"),
        ("", "not begun", ""),
        (None, "offsets.py: expected a file of Python text", ""),
        pytest.param("def forward(a):\n    1\n\n\n1 / 0\n", "", "ZeroDiv", marks=pytest.mark.slow),
    ],
)
def test_files_that_are_not_equations(room, text, note, first):
    file = room / "student" / "offsets.py"
    file.unlink() if text is None else file.write_text(text)
    (row,) = school.grade(room)["students"][0]["equations"]
    assert (row["points"], row["note"]) == (0, note) and first in row["first"]


# --- copies ---------------------------------------------------------------------------------------


SHORT = {"forward", "backward", "moved"}  # lines that are in the stub as well, such as `saved`
COPIED = (
    "mlp",
    "masking",
    "deformation",
    "projection",
    "compositing",
    "ssim",
    "hash_grid",
    "prior",
    "rounding",
    "likelihood",
    "hash_rate",
)


@pytest.mark.parametrize("key", COPIED)
def test_copies_are_noticed_whatever_their_names_and_comments(key):
    found = copies(source_of(key), key)
    assert {name.split()[0] for name in found} >= set(functions_of(key)) - SHORT


@pytest.mark.slow
def test_renamed_copy_is_noticed_and_its_points_are_withheld(tmp_path):
    school.classroom(tmp_path, ["mlp"])
    mine = "# written by me\n" + source_of("mlp").replace("hidden", "my_hidden")
    assert "my_hidden" in mine
    (tmp_path / "student" / "mlp.py").write_text(mine)
    grades = school.grade(tmp_path, seed=1)
    (student,) = grades["students"]
    assert student["points"] == 0 and len(student["equations"][0]["flags"]) == 2
    assert "10.00 points withheld, copied: forward (line " in school.text(grades)


def test_copy_from_another_file_of_the_package_is_noticed():
    twin = text_of("p4dgs_ref.splatting.loop")
    found = copies(f"{stub_of('compositing')}\n\n{twin}", "compositing")
    names = [node.name for node in ast.parse(twin).body if isinstance(node, ast.FunctionDef)]
    assert {name.split()[0] for name in found} == set(names)


@pytest.mark.parametrize(
    "old, new",
    [
        ("    inputs = [x]\n", "    unused = len(x)\n    inputs = [x]\n"),
        ("range(len(weights))", "range(0, len(weights))"),
        ("hidden += b", "hidden = hidden + b"),
        ("def forward(", "class Mine:\n    pass\n\n\ndef forward("),
        ("def ", "def my_"),
    ],
)
def test_copy_with_small_changes_is_noticed(old, new):
    assert old in source_of("mlp")
    assert len(copies(source_of("mlp").replace(old, new), "mlp")) == 2


def test_files_as_handed_out_are_no_copies():
    assert [key for key in KEYS if copies(stub_of(key), key)] == []


@pytest.mark.parametrize("path", few([*SOLUTIONS, WHOLE_PAPER], 3), ids=lambda path: path.stem)
def test_answers_written_independently_are_far_from_copies(path):
    keys = next((t.keys for t in TUTORIALS if t.name == path.stem), ()) or KEYS
    source = path.read_text(encoding="utf-8")
    assert {key: copies(source, key, ALIKE / 2) for key in keys} == {key: [] for key in keys}


def test_short_equations_are_alike_by_chance_and_the_teacher_knows_them():
    short = [key for key in KEYS if not copies(source_of(key), key)]
    assert "offsets" in short and "`, `".join(short) in " ".join(TEACHER.split())


# --- the lock on the reference --------------------------------------------------------------------
REFUSED = {
    "from p4dgs_ref.equations import offsets": "p4dgs_ref.equations.offsets",
    "from p4dgs_ref.equations.offsets import forward": "p4dgs_ref.equations.offsets",
    "from . import offsets": "p4dgs_ref.equations.offsets",
    "from .offsets import forward": "p4dgs_ref.equations.offsets",
    "import p4dgs_ref.equations.offsets": "p4dgs_ref.equations.offsets",
    "from ..table import EQUATIONS": "p4dgs_ref.table",
    "from p4dgs_ref import model": "p4dgs_ref.model",
    "from p4dgs_ref import EQUATIONS": "p4dgs_ref.table",
    "import importlib; importlib.import_module('p4dgs_ref.oracle')": "p4dgs_ref.oracle",
    "__import__('p4dgs_ref.lab.school.held_back')": "p4dgs_ref.lab",
    "import sys; sys.modules['p4dgs_ref.equations.offsets']": "KeyError",
    "import p4dgs_ref; p4dgs_ref.equations.offsets": "AttributeError",
}


@pytest.mark.slow
def test_the_reference_cannot_be_imported(room):
    body = f"""said = []
for line in {list(REFUSED)}:
    try:
        exec(line, globals())
        said.append("imported")
    except Exception as error:
        said.append(f"{{type(error).__name__}}: {{error}}")
raise ValueError("; ".join(said))"""
    row = graded(room, forward=body)
    said = row["first"].split("ValueError: ")[1].split("; ")
    for (line, name), answer in zip(REFUSED.items(), said, strict=True):
        refused = f"ImportError: {name} cannot be imported by a file that is graded"
        assert answer == refused or answer.startswith(name), line
    assert points(row)["forward"] == 0


# --- reports --------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def course(tmp_path_factory):
    """A course, and what three students handed in: the key, Eq. (11) as printed, nothing."""
    folder = tmp_path_factory.mktemp("course")
    school.classroom(folder / "course", ["offsets", "likelihood"])
    for name in ("anna", "ben", "carla"):
        shutil.copytree(folder / "course" / "student", folder / name / "student")
        # students do not choose their equations
        (folder / name / "classroom.json").write_text('{"p4dgs_classroom": 1, "equations": {}}')
    shutil.copytree(folder / "course" / "key", folder / "anna" / "student", dirs_exist_ok=True)
    (folder / "ben" / "student" / "likelihood.py").write_text(PRINTED)
    write(folder / "ben", "offsets", forward=WITHOUT_SCALING)
    return folder


def grade_all(folder, *names, **options):
    return school.grade(*(folder / n for n in names), classroom=folder / "course", **options)


@pytest.mark.slow
def test_a_class_is_graded_by_the_same_inputs_in_one_table(course, tmp_path):
    grades = grade_all(course, "anna", "ben", "carla")
    anna, ben, carla = csv.DictReader(io.StringIO(school.as_csv(grades)))
    assert float(anna["offsets"]) == float(anna["points"]) == 10
    assert (anna["copied"], ben["copied"], carla["copied"]) == ("1", "0", "0")
    assert float(ben["points"]) == round(grades["students"][1]["points"], 2) > 0
    assert float(carla["points"]) == 0 and float(carla["of"]) == 20
    assert 6 < float(ben["likelihood"]) < 8  # the printed formula has no digits in the tails
    lines = [line.split() for line in school.text(grades).split("\n\n")[0].splitlines()]
    assert lines[1] == ["offsets", "10.00", ben["offsets"], "0.00"]
    assert [line[0] for line in lines[2:]] == ["likelihood", "points", "of", "copied", "seed"]
    # the points of one student alone, by the seed that was printed
    again = grade_all(course, "ben", seed=grades["seed"])
    assert again["students"] == grades["students"][1:2]
    many = {**grades, "students": 9 * grades["students"][2:]}  # the longer side goes down
    assert len(school.table(many).splitlines()) == 10
    school.write(grades, tmp_path)
    value = json.loads((tmp_path / "grades.json").read_text())
    assert value == json.loads(json.dumps(school.as_json(grades)))
    assert value["students"][1]["points"] == round(grades["students"][1]["points"], 4)
    assert value["students"][1]["equations"][0]["tutorial"] == "01_offsets"
    assert (tmp_path / "grades.csv").read_text() == school.as_csv(grades)
    assert (tmp_path / "grades.txt").read_text() == school.text(grades) + "\n"


def test_right_values_are_printed_with_reveal_only_and_seeds_change_inputs(room):
    write(room, "offsets", forward=WITHOUT_SCALING)
    hidden, shown, other = (
        school.grade(room, seed=seed, reveal=reveal)
        for seed, reveal in ((3, False), (3, True), (4, False))
    )
    first, revealed, another = (g["students"][0]["equations"][0] for g in (hidden, shown, other))
    right = re.search(r"expected (\S+) ", revealed["first"])[1]
    for text in (school.text(hidden), json.dumps(school.as_json(hidden)), school.as_csv(hidden)):
        assert "expected" not in text and right not in text
    assert right in school.text(shown) and first["points"] == revealed["points"]
    assert first["first"].endswith(", which is wrong") and first["first"] != another["first"]
    assert "seed" not in json.loads((room / "classroom.json").read_text())


def test_command_line_grades_and_refuses_in_one_line(room, capsys):
    options = ["--seed", "3", "--reveal", "-o", str(room / "marks")]
    assert run(["grade", str(room), str(room), *options], 0) == 0
    text = capsys.readouterr().out
    assert (room / "marks" / "grades.txt").read_text() == text
    assert text.count("seed 3") == 2
    file = room / "README.md"  # found before anything is graded
    assert run(["grade", str(room), "-o", str(file)], 0) == 2
    assert run(["grade", str(room), str(room / "nobody")], 0) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 2 and "grading" not in err
