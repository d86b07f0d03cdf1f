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
from p4dgs_ref.lab.school import guard
from p4dgs_ref.lab.school.grading import parts_of
from p4dgs_ref.lab.school.guard import copies
from p4dgs_ref.lab.school.removal import functions_of, without_bodies
from p4dgs_ref.lab.school.room import TEACHER, parts_asked, source_of, text_of
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
            source = without_bodies(source, [name], lambda _: "HERE")
            mine = "".join(f"    {line}\n" for line in body.splitlines())
            source = source.replace('    raise NotImplementedError("HERE")\n', mine)
    (folder / "student" / f"{key}.py").write_text("import numpy as np\n" + source, encoding="utf-8")


@pytest.fixture
def room(tmp_path):
    school.classroom(tmp_path / "room", ["offsets"])
    return tmp_path / "room"


def graded(room, forward=None, backward=None, key="offsets", **options):
    write(room, key, forward, backward)
    (report,) = school.grade(room, **{"seed": 0, **options})
    return next(grade for grade in report.grades if grade.key == key)


def points(grade):
    return {part.name: round(part.points, 6) for part in grade.parts}


# --- points ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "keys",
    [
        pytest.param(("offsets", "rounding", "hash_rate", "compositing"), id="some"),
        pytest.param(KEYS, marks=pytest.mark.slow, id="all"),
    ],
)
def test_the_key_gets_all_points_and_files_not_begun_get_none(tmp_path, keys):
    school.classroom(tmp_path, keys)
    empty, full = school.grade(tmp_path, tmp_path / "key", seed=4)
    assert empty.seed == 4 and empty.points == 0 and empty.of == 10 * len(keys)
    assert all(grade.note == "not begun" for grade in empty.grades)
    found = {(g.key, g.earned, g.of, g.first) for g in full.grades}
    assert found == {(key, 10, 10, "") for key in keys}


@pytest.mark.parametrize("key", KEYS)
def test_every_equation_is_worth_ten(key):
    both = parts_asked(key, backward_only=False)
    for asked in (both, ["forward"], parts_asked(key, backward_only=True)):
        points_of = [part.of for part in parts_of(key, asked)]
        assert not asked or sum(points_of) == pytest.approx(10)


def test_forward_alone_gets_its_half(room):
    grade = graded(room, backward=LATER)
    assert points(grade) == {
        "forward": 3,
        "gradient of x_a": 0,
        "gradient of O_a": 0,
        "gradient of l_a": 0,
        "hard cases: outputs": 2,
        "hard cases: gradients": 0,
    }
    assert grade.first == "offsets/ordinary#1: backward: not written yet (later)"
    assert grade.explanation == ""


def test_backward_alone_gets_its_half_on_what_the_reference_saves(room):
    grade = graded(room, forward=LATER)
    assert grade.points == pytest.approx(5)
    assert points(grade)["gradient of l_a"] == 1
    assert grade.first == "offsets/ordinary#1: forward: not written yet (later)"


def test_one_wrong_gradient_costs_its_share(room):
    grade = graded(
        room,
        backward="""return {"x_a": x_bar[:, -1], "O_a": x_bar * l_a[:, None, :],
        "l_a": (x_bar * O_a).sum(axis=1)}""",
    )
    assert points(grade)["gradient of x_a"] == 0
    assert points(grade)["gradient of O_a"] == 1
    assert points(grade)["forward"] == 3 and 6.5 < grade.points < 8.5
    assert re.match(
        r"offsets/ordinary#1: in_bar.x_a\[\d, \d\]: got .*, which is wrong$", grade.first
    )


def test_known_mistake_is_named(room):
    grade = graded(room, forward=AS_LOGARITHM)
    assert "log" in grade.explanation and points(grade)["forward"] == 0
    assert points(grade)["gradient of x_a"] == 1  # the wrong forward is not punished twice


def test_mistake_that_explains_a_case_by_accident_is_not_named(room):
    body = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar, "l_a": (x_bar * O_a).sum(axis=1)}'
    grade = graded(room, backward=body)
    assert (
        grade.points < 8 and grade.explanation == grade.hint == ""
    )  # exp(l_a) is 1 in the case where l_a is 0


def test_missing_gradient_wrong_type_and_wrong_form_are_named(room):
    two = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar * l_a[:, None, :]}'
    assert "in_bar.l_a: missing" in graded(room, backward=two).first
    low = RIGHT + "return x.astype(np.float32), (O_a, l_a)"
    assert "float32, expected float64" in graded(room, forward=low).first
    assert "expected a pair" in graded(room, forward=RIGHT + "return x").first
    assert "expected a dictionary" in graded(room, backward="return x_bar").first
    assert "ZeroDivisionError" in graded(room, forward="return 1 / 0").first


def test_several_outputs_are_a_tuple(tmp_path):
    school.classroom(tmp_path, ["view"])
    body = "v = x_a - x_c\nd = np.sqrt((v * v).sum(axis=1, keepdims=True))\n"
    grade = graded(tmp_path, body + "return [d, v / d], (d, v)", key="view")
    assert "expected a tuple of delta_vc, d_vc" in grade.first


def test_only_the_hard_cases_fail(tmp_path):
    school.classroom(tmp_path, ["rounding"])
    away = """sign = np.where(f / q < 0, -1, 1)
symbols = (sign * np.floor(np.abs(f / q) + 0.5)).astype(np.int64)
return (symbols, symbols * q), ()"""
    grade = graded(tmp_path, away, key="rounding")
    assert points(grade)["forward"] == 6 and 0 < points(grade)["hard cases: outputs"] < 4
    assert "rounding/" in grade.first and grade.explanation == ""
    assert "even" in grade.hint  # beside a tie, adding a half rounds up: another mistake


def test_same_seed_same_report_another_seed_other_inputs(room):
    one, again, other = (graded(room, WITHOUT_SCALING, seed=seed) for seed in (7, 7, 8))
    assert one == again and one.first != other.first


# --- what students cannot break -------------------------------------------------------------------
@pytest.mark.parametrize(
    "body, said",
    few(
        [
            ("while True:\n    pass", "hung"),
            ("import os\nos._exit(3)", "exit code 3"),
            ("import sys\nsys.exit(0)", "SystemExit"),
            ("return forward(x_a, O_a, l_a)", "RecursionError"),
            ("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)", "signal 9"),
            ("return np.array(['x']), None", "out.x: missing"),
            ("input()", "EOFError"),
        ],
        2,
    ),
)
def test_forward_that_misbehaves_costs_only_itself(room, body, said):
    school.classroom(room, ["view"])
    (room / "student" / "view.py").write_text(source_of("view"))
    write(room, "offsets", forward=body)
    start = time.monotonic()
    view, offsets = school.grade(room, timeout=1.0)[0].grades
    assert view.points == 10 and offsets.points <= 5 and said in offsets.first
    assert time.monotonic() - start < 25


def test_time_of_an_equation_is_limited(room, monkeypatch):
    monkeypatch.setattr("p4dgs_ref.lab.school.grading.SECONDS", 0)
    grade = graded(room)
    assert grade.points == 0
    assert grade.first == "offsets/ordinary#1: not asked, because 0 s are over"


def test_prints_and_changed_inputs_do_no_harm(room):
    body = 'print("x" * 100_000)\n' + RIGHT + "x_a[:] = 7\nreturn x, (O_a, l_a)"
    assert graded(room, forward=body).points == 10


@pytest.mark.parametrize("text, note", [("def forward(:\n", "cannot be read"), ("", "not begun")])
def test_files_that_are_not_python(room, text, note):
    (room / "student" / "offsets.py").write_text(text)
    (grade,) = school.grade(room)[0].grades
    assert (grade.points, grade.note) == (0, note)


def test_missing_file_and_module_that_raises(room):
    (room / "student" / "offsets.py").unlink()
    assert "expected a file" in school.grade(room)[0].grades[0].note
    text = "def forward(x_a, O_a, l_a):\n    return 1\n\n\n1 / 0\n"
    (room / "student" / "offsets.py").write_text(text)
    (grade,) = school.grade(room)[0].grades
    assert grade.points == 0 and "ZeroDivisionError" in grade.first


# --- copies ---------------------------------------------------------------------------------------
BOTH = ("forward", "backward")


def renamed(source):
    """Another author's source: other local names, layout and comments, no docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            stored = {
                name.id: f"my_{name.id}"
                for name in ast.walk(node)
                if isinstance(name, ast.Name)
                and isinstance(name.ctx, ast.Store)
                and name.id not in [argument.arg for argument in node.args.args]
            }
            for name in ast.walk(node):
                if isinstance(name, ast.Name):
                    name.id = stored.get(name.id, name.id)
            node.body = [ast.parse('"""Mine."""').body[0], *node.body[1:], ast.Pass()]
    return "# written by me\n" + ast.unparse(tree)


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
    found = copies(source_of(key), key, BOTH)
    assert {name.split()[0] for name in found} >= set(functions_of(key, BOTH)) - SHORT


def test_renamed_copy_is_noticed_and_its_points_are_withheld(tmp_path):
    school.classroom(tmp_path, ["mlp"])
    mine = renamed(source_of("mlp"))
    assert "my_hidden" in mine and "The network" not in mine
    (tmp_path / "student" / "mlp.py").write_text(mine)
    reports = school.grade(tmp_path, seed=1)
    (grade,) = reports[0].grades
    assert grade.points == reports[0].points == 0 and grade.earned == 10 and len(grade.flags) == 2
    assert "10.00 points withheld, copied: forward (line " in school.text(reports)


def test_copy_from_another_file_of_the_package_is_noticed():
    given = without_bodies(source_of("compositing"), functions_of("compositing", BOTH), str)
    twin = text_of("p4dgs_ref.splatting.loop")
    found = copies(f"{given}\n\n{twin}", "compositing", BOTH)
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
    assert len(copies(source_of("mlp").replace(old, new), "mlp", BOTH)) == 2


@pytest.mark.parametrize("key", KEYS)
def test_files_as_handed_out_are_no_copies(key):
    for asked in (BOTH, ("backward",)):
        stub = without_bodies(source_of(key), functions_of(key, asked), str)
        assert copies(stub, key, asked) == []


@pytest.mark.parametrize("path", few([WHOLE_PAPER, *SOLUTIONS], 5), ids=lambda path: path.stem)
def test_answers_written_independently_are_far_from_copies(path, monkeypatch):
    monkeypatch.setattr(guard, "ALIKE", guard.ALIKE / 2)
    keys = next((t.keys for t in TUTORIALS if t.name == path.stem), ()) or KEYS
    source = path.read_text(encoding="utf-8")
    assert {key: copies(source, key, BOTH) for key in keys} == {key: [] for key in keys}


def test_short_equations_are_alike_by_chance_and_the_teacher_knows_them():
    short = [key for key in KEYS if not copies(source_of(key), key, BOTH)]
    assert "offsets" in short and "`, `".join(short) in " ".join(TEACHER.split())


def test_names_are_not_forbidden(room):
    body = "modules, eval, gc, EQUATIONS = x_a, O_a, l_a, None\nimport sys, inspect\n"
    grade = graded(room, forward=body + RIGHT + "return x, (O_a, l_a)")
    assert grade.points == 10 and grade.flags == ()


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


def test_the_reference_cannot_be_imported(room):
    body = f"""said = []
for line in {list(REFUSED)}:
    try:
        exec(line, globals())
        said.append("imported")
    except Exception as error:
        said.append(f"{{type(error).__name__}}: {{error}}")
raise ValueError("; ".join(said))"""
    grade = graded(room, forward=body)
    said = grade.first.split("ValueError: ")[1].split("; ")
    for (line, name), answer in zip(REFUSED.items(), said, strict=True):
        refused = f"ImportError: {name} cannot be imported by a file that is graded"
        assert answer == refused or answer.startswith(name), line
    assert points(grade)["forward"] == 0


def test_merged_file_cannot_be_imported_either(tmp_path):
    school.classroom(tmp_path, ["hash_grid"])
    line = "from p4dgs_ref.equations.grid_nodes import locate\nreturn 1, 2"
    grade = graded(tmp_path, forward=line, key="hash_grid")
    assert "equations.grid_nodes cannot be imported" in grade.first
    # What the reference's forward saves contains the weights, hence it is not lent.
    assert points(grade)["gradient of grids"] == 0


# --- reports --------------------------------------------------------------------------------------
def test_reports_agree(room):
    write(room, "offsets", forward=WITHOUT_SCALING)
    reports = school.grade(room, seed=2)
    school.write(reports, room)
    value = json.loads((room / "grades.json").read_text())
    (line,) = csv.DictReader(io.StringIO((room / "grades.csv").read_text()))
    assert value == json.loads(json.dumps(school.as_json(reports)))
    assert (room / "grades.csv").read_text() == school.as_csv(reports)
    (student,) = value["students"]
    (row,) = student["equations"]
    assert student["points"] == round(reports[0].points, 4)
    assert float(line["points"]) == float(line["offsets"]) == round(student["points"], 2)
    assert row["points"] == student["points"] and line["student"] == str(room)
    assert row["tutorial"] == "01_offsets" and value["seed"] == int(line["seed"]) == 2
    of_parts = sum(part["points"] for part in row["parts"])
    assert of_parts == pytest.approx(student["points"], abs=1e-3)
    text = school.text(reports)
    assert (room / "grades.txt").read_text() == text + "\n"
    assert f"{reports[0].points:5.2f} of 10" in text
    assert "first: offsets/ordinary#1: out.x" in text and "seed 2" in text


@pytest.fixture
def hand_in(tmp_path):
    """A course, and what three students handed in: the key, Eq. (11) as printed, nothing."""
    school.classroom(tmp_path / "course", ["offsets", "likelihood"])
    for name in ("anna", "ben", "carla"):
        shutil.copytree(tmp_path / "course" / "student", tmp_path / name / "student")
        shutil.copy(tmp_path / "course" / "classroom.json", tmp_path / name)
    shutil.copytree(tmp_path / "course" / "key", tmp_path / "anna" / "student", dirs_exist_ok=True)
    (tmp_path / "ben" / "student" / "likelihood.py").write_text(PRINTED)
    write(tmp_path / "ben", "offsets", forward=WITHOUT_SCALING)
    return tmp_path


def test_a_class_is_graded_by_the_same_inputs_in_one_table(hand_in, monkeypatch):
    monkeypatch.chdir(hand_in)
    reports = school.grade("anna", "ben", "carla", classroom="course")
    assert [report.student for report in reports] == ["anna", "ben", "carla"]
    assert len({report.seed for report in reports}) == 1
    anna, ben, carla = csv.DictReader(io.StringIO(school.as_csv(reports)))
    assert float(anna["offsets"]) == float(anna["points"]) == 10
    assert (anna["copied"], ben["copied"], carla["copied"]) == ("1", "0", "0")
    assert float(ben["points"]) == round(reports[1].points, 2) > float(carla["points"]) == 0
    assert 6 < float(ben["likelihood"]) < 8  # the printed formula has no digits in the tails
    head, *lines = school.text(reports).split("\n\n")[0].splitlines()
    assert head.split() == ["student", "anna", "ben", "carla"]
    assert lines[0].split() == ["offsets", "10.00", ben["offsets"], "0.00"]
    names = [line.split()[0] for line in lines[1:]]
    assert names == ["likelihood", "points", "of", "copied", "seed"]
    # the points of one student alone, by the seed that was printed
    again = school.grade("ben", classroom="course", seed=reports[0].seed)
    assert again == reports[1:2]


def test_long_side_of_the_table_goes_down(hand_in):
    lines = school.table(school.grade(hand_in / "carla") * 9).splitlines()
    assert len(lines) == 10
    figures = ["student", "offsets", "likelihood", "points", "of", "copied", "seed"]
    assert lines[0].split() == figures


def test_students_do_not_choose_their_equations(hand_in):
    (hand_in / "carla" / "classroom.json").write_text('{"p4dgs_classroom": 1, "equations": {}}')
    (report,) = school.grade(hand_in / "carla", classroom=hand_in / "course")
    assert report.of == 20


def test_right_values_are_printed_with_reveal_only(room):
    write(room, "offsets", forward=WITHOUT_SCALING)
    hidden, shown = (school.grade(room, seed=3, reveal=reveal) for reveal in (False, True))
    right = re.search(r"expected (\S+) ", shown[0].grades[0].first)[1]
    for text in (school.text(hidden), json.dumps(school.as_json(hidden)), school.as_csv(hidden)):
        assert "expected" not in text and right not in text
    assert right in school.text(shown)
    assert hidden[0].points == shown[0].points
    assert hidden[0].grades[0].first.endswith(", which is wrong")


def test_seed_is_drawn_and_no_file_contains_it(room):
    one, other = (school.grade(room)[0].seed for _ in range(2))
    assert one != other
    assert "seed" not in json.loads((room / "classroom.json").read_text())


def test_command_line_grades_and_refuses_in_one_line(room, capsys):
    write(room, "offsets", forward=WITHOUT_SCALING)
    options = ["--seed", "3", "--reveal", "-o", str(room / "marks")]
    assert run(["grade", str(room), str(room / "key"), *options], 0) == 0
    text = capsys.readouterr().out
    assert (room / "marks" / "grades.txt").read_text() == text
    assert "expected" in text and text.count("seed 3") == 2
    file = room / "README.md"  # found before anything is graded
    assert run(["grade", str(room), "-o", str(file)], 0) == 2
    assert run(["grade", str(room), str(room / "nobody")], 0) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 2 and "grading" not in err
