"""The grader: its points for what students write, what they cannot break, and its reports."""

import csv
import io
import json
import re
import time

import pytest

from p4dgs_ref import school
from p4dgs_ref.oracle import published
from p4dgs_ref.school.grading import parts_of
from p4dgs_ref.school.guard import suspicions
from p4dgs_ref.school.removal import without_bodies
from p4dgs_ref.school.room import parts_asked, source_of

KEYS = published.equations()
RIGHT = "x = x_a[:, None, :] + O_a * l_a[:, None, :]\n"
AS_LOGARITHM = "return x_a[:, None, :] + O_a * np.exp(l_a)[:, None, :], (O_a, l_a)"
WITHOUT_SCALING = "return x_a[:, None, :] + O_a, (O_a, l_a)"
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
    report = school.grade(room, **options)
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
    school.classroom(tmp_path, keys, seed=4)
    empty = school.grade(tmp_path)
    assert empty.seed == 4 and empty.points == 0 and empty.of == 10 * len(keys)
    assert all(grade.note == "not begun" for grade in empty.grades)
    full = school.grade(tmp_path, student=tmp_path / "key")
    found = {(g.key, g.points, g.of, g.first, g.flags) for g in full.grades}
    assert found == {(key, 10, 10, "", ()) for key in keys}


@pytest.mark.parametrize("key", KEYS)
def test_every_equation_is_worth_ten(key):
    both = parts_asked(key, backward_only=False)
    for asked in (both, ["forward"], parts_asked(key, backward_only=True)):
        points_of = [part.of for part in parts_of(key, asked)]
        assert not asked or sum(points_of) == pytest.approx(10)


def test_forward_alone_gets_its_half(room):
    grade = graded(room, backward=LATER)
    assert points(grade) == {
        "forward": 4,
        "gradient of x_a": 0,
        "gradient of O_a": 0,
        "gradient of l_a": 0,
        "hard cases: outputs": 1,
        "hard cases: gradients": 0,
    }
    assert grade.first == "offsets/ordinary#1: backward: not written yet (later)"
    assert grade.explanation == ""


def test_backward_alone_gets_its_half_on_what_the_reference_saves(room):
    grade = graded(room, forward=LATER)
    assert grade.points == pytest.approx(5)
    assert points(grade)["gradient of l_a"] == pytest.approx(4 / 3, abs=1e-6)
    assert grade.first == "offsets/ordinary#1: forward: not written yet (later)"


def test_one_wrong_gradient_costs_its_share(room):
    grade = graded(
        room,
        backward="""return {"x_a": x_bar[:, -1], "O_a": x_bar * l_a[:, None, :],
        "l_a": (x_bar * O_a).sum(axis=1)}""",
    )
    assert points(grade)["gradient of x_a"] == 0
    assert points(grade)["gradient of O_a"] == round(4 / 3, 6)
    assert points(grade)["forward"] == 4 and 7.5 < grade.points < 9
    assert re.match(r"offsets/ordinary#1: in_bar.x_a\[\d, \d\]: got .*, expected ", grade.first)


def test_known_mistake_is_named(room):
    grade = graded(room, forward=AS_LOGARITHM)
    assert "log" in grade.explanation and points(grade)["forward"] == 0
    assert points(grade)["gradient of x_a"] > 1  # the wrong forward is not punished twice


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
    assert points(grade)["forward"] == 8 and 0 < points(grade)["hard cases: outputs"] < 2
    assert "rounding/" in grade.first and grade.explanation == ""
    assert "even" in grade.hint  # beside a tie, adding a half rounds up: another mistake


def test_same_seed_same_report_another_seed_other_inputs(room):
    one, again, other = (graded(room, WITHOUT_SCALING, seed=seed) for seed in (7, 7, 8))
    assert one == again and one.first != other.first


# --- what students cannot break -------------------------------------------------------------------
@pytest.mark.parametrize(
    "body, said",
    [
        ("while True:\n    pass", "hung"),
        ("import os\nos._exit(3)", "exit code 3"),
        ("import sys\nsys.exit(0)", "SystemExit"),
        ("return forward(x_a, O_a, l_a)", "RecursionError"),
        ("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)", "signal 9"),
        ("return np.array(['x']), None", "out.x: missing"),
        ("input()", "EOFError"),
    ],
)
def test_forward_that_misbehaves_costs_only_itself(room, body, said):
    school.classroom(room, ["view"])
    (room / "student" / "view.py").write_text(source_of("view"))
    write(room, "offsets", forward=body)
    start = time.monotonic()
    view, offsets = school.grade(room, timeout=1.0).grades
    assert view.points == 10 and offsets.points <= 5 and said in offsets.first
    assert time.monotonic() - start < 25


def test_time_of_an_equation_is_limited(room, monkeypatch):
    monkeypatch.setattr("p4dgs_ref.school.grading.SECONDS", 0)
    grade = graded(room)
    assert grade.points == 0
    assert grade.first == "offsets/ordinary#1: not asked, because 0 s are over"


def test_prints_and_changed_inputs_do_no_harm(room):
    body = 'print("x" * 100_000)\n' + RIGHT + "x_a[:] = 7\nreturn x, (O_a, l_a)"
    assert graded(room, forward=body).points == 10


@pytest.mark.parametrize("text, note", [("def forward(:\n", "cannot be read"), ("", "not begun")])
def test_files_that_are_not_python(room, text, note):
    (room / "student" / "offsets.py").write_text(text)
    (grade,) = school.grade(room).grades
    assert (grade.points, grade.note) == (0, note)


def test_missing_file_and_module_that_raises(room):
    (room / "student" / "offsets.py").unlink()
    assert "expected a file" in school.grade(room).grades[0].note
    text = "def forward(x_a, O_a, l_a):\n    return 1\n\n\n1 / 0\n"
    (room / "student" / "offsets.py").write_text(text)
    (grade,) = school.grade(room).grades
    assert grade.points == 0 and "ZeroDivisionError" in grade.first


@pytest.mark.parametrize(
    "line",
    [
        "from p4dgs_ref.equations import offsets",
        "from p4dgs_ref.equations.offsets import forward",
        "from . import offsets",
        "from .offsets import forward",
        "import p4dgs_ref.equations.offsets",
        "from ..table import EQUATIONS",
        "from p4dgs_ref import model",
        "import importlib",
    ],
)
def test_asking_the_reference_is_flagged(line):
    (found,) = suspicions(source_of("offsets") + f"\n\n{line}\n", "offsets")
    last = len(source_of("offsets").splitlines()) + 3
    assert found.startswith(f"line {last}: imports ")


@pytest.mark.parametrize(
    "call",
    [
        "EQUATIONS['offsets'](x_a, O_a, l_a)",
        "__import__('p4dgs_ref')",
        "eval('x_a')",
        "sys.modules['p4dgs_ref']",
    ],
)
def test_doors_to_the_reference_are_flagged(call):
    help_ = f"\n\ndef help(x_a, O_a, l_a):\n    return {call}\n"
    assert suspicions(source_of("offsets") + help_, "offsets")


def test_flagged_file_gets_no_points(room):
    write(room, "offsets")
    path = room / "student" / "offsets.py"
    path.write_text(path.read_text() + "\n\nfrom p4dgs_ref.equations.offsets import forward\n")
    report = school.grade(room)
    (grade,) = report.grades
    assert report.points == 0 and grade.earned == 10 and len(grade.flags) == 1
    assert "points withheld (10.00): line " in school.text(report)


@pytest.mark.parametrize("key", KEYS)
def test_reference_and_helpers_from_numpy_are_not_suspicious(key):
    source = source_of(key) + "\n\nimport math, itertools, sys\nfrom scipy.special import erfc\n"
    assert suspicions(source, key) == []


# --- reports --------------------------------------------------------------------------------------
def test_reports_agree(room):
    write(room, "offsets", forward=WITHOUT_SCALING)
    report = school.grade(room, seed=2)
    school.write(report, room)
    value = json.loads((room / "grades.json").read_text())
    (table,) = csv.DictReader(io.StringIO((room / "grades.csv").read_text()))
    assert value == json.loads(json.dumps(school.as_json(report)))
    assert (room / "grades.csv").read_text() == school.as_csv(report)
    assert float(table["points"]) == value["points"] == round(report.points, 4)
    assert table["tutorial"] == "01_offsets"
    of_parts = sum(part["points"] for part in value["equations"][0]["parts"])
    assert of_parts == pytest.approx(value["points"], abs=1e-3)
    text = school.text(report)
    assert (room / "grades.txt").read_text() == text + "\n"
    assert f"{report.points:5.2f} of 10" in text
    assert "first: offsets/ordinary#1: out.x" in text and "seed 2" in text
