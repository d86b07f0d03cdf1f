"""The grader: its points for what students write, what they cannot break, and its reports."""

import csv
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.cli.parser import run
from p4dgs_ref.lab import classroom
from p4dgs_ref.lab.classroom import grading, similar, student
from p4dgs_ref.lab.classroom.room import (
    MAX_STUDENT_BYTES,
    STUDENT,
    TEACHER,
    functions_of,
    source_of,
    stub,
)
from p4dgs_ref.lab.classroom.similar import are_alike
from p4dgs_ref.lessons import TUTORIALS
from p4dgs_ref.oracle import published
from p4dgs_ref.splatting.table import EQUATIONS
from tests import processes
from tests.sampling import WHOLE, few

KEYS = list(EQUATIONS)
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
    """Write a student's file with these bodies; None is the reference's, without its comments.

    It begins with a byte order mark, as some editors write it.
    """
    lines = [line.partition("# ")[0].rstrip() for line in source_of(key).splitlines()]
    bodies = {"forward": forward, "backward": backward}
    for name, node in reversed(functions_of(key).items()):
        if bodies.get(name) is not None:
            mine = [f"    {line}" for line in bodies[name].splitlines()]
            lines[node.body[0].end_lineno : node.end_lineno] = mine
    text = "\n".join(["import numpy as np", *lines, ""])
    (folder / "student" / f"{key}.py").write_text(text, encoding="utf-8-sig")


@pytest.fixture
def room(tmp_path):
    classroom.hand_out(tmp_path / "room", ["offsets"])
    return tmp_path / "room"


def graded(room, forward=None, backward=None, key="offsets"):
    """The row of one equation with these bodies."""
    classroom.hand_out(room, [key])
    write(room, key, forward, backward)
    (one,) = classroom.grade(room, seed=0)["students"]
    return next(row for row in one["equations"] if row["key"] == key)


# --- points ---------------------------------------------------------------------------------------
SOME = KEYS if WHOLE else [key.values[0] for key in few(KEYS, 8) if not key.marks]


@pytest.mark.parametrize(
    "keys", [["offsets", "rounding"], pytest.param(SOME, marks=pytest.mark.slow)], ids=len
)
def test_the_key_gets_all_points_and_files_not_begun_get_none(tmp_path, keys):
    classroom.hand_out(tmp_path, keys)
    grades = classroom.grade(tmp_path, tmp_path / "key", seed=4)
    empty, full = grades["students"]
    assert grades["seed"] == 4 and empty["points"] == 0 and empty["of"] == 10 * len(keys)
    assert {row["says"] for row in empty["equations"]} == {"not begun"}
    assert [row["points"] for row in full["equations"]] == [10] * len(keys)
    assert {row["says"] for row in full["equations"]} == {""}
    lines = grading.to_text(grades).splitlines()
    assert f"not begun: {', '.join(keys)}" in lines and "not begun" not in "".join(
        lines[-len(keys) :]
    )
    (pair,) = grades["alike"]
    assert pair == {"students": [str(tmp_path / "key"), "the key"], "keys": keys}


NO_SUM = """return {"x_a": x_bar[:, -1], "O_a": x_bar * saved[1][:, None, :],
"l_a": (x_bar * saved[0]).sum(axis=1)}"""
NO_FACTOR = """O_a = saved[0]
return {"x_a": x_bar.sum(axis=1), "O_a": x_bar, "l_a": (x_bar * O_a).sum(axis=1)}"""
TWO = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar * saved[1][:, None, :]}'
LISTS = """return {"x_a": x_bar.sum(axis=1).tolist(), "O_a": (x_bar * saved[1][:, None]).tolist(),
"l_a": (x_bar * saved[0]).sum(axis=1).tolist()}"""
SAVES_MORE = RIGHT + "return x, (O_a, l_a, 1)"
AWAY = """sign = np.where(f / q < 0, -1, 1)
symbols = (sign * np.floor(np.abs(f / q) + 0.5)).astype(np.int64)
return (symbols, symbols * q), ()"""
LIST = """v = x_a - x_c
d = np.sqrt((v * v).sum(axis=1, keepdims=True))
return [d, v / d], (d, v / d)"""
# key, forward, backward, points, some parts, what `says` says
NO_FORWARD = {"forward": "0 of 3", "gradients": "9 of 9", "hard cases": "9 of 12"}
NOTHING = {"forward": "0 of 3", "gradients": "0 of 9", "hard cases": "0 of 12"}
NO_BACKWARD = {"forward": "3 of 3", "gradients": "0 of 9", "hard cases": "3 of 12"}
GRADED = {
    "right": ("offsets", RIGHT + "return x, (O_a, l_a)", None, 10, {}, ""),
    "forward alone": (
        *("offsets", None, LATER, 4, NO_BACKWARD),
        "backward: error in offsets/ordinary: NotImplementedError: later",
    ),
    "a gradient without its sum": (
        *("offsets", None, NO_SUM, 8.3, {"forward": "3 of 3", "gradients": "6 of 9"}),
        "backward: the gradient of x_a: 15 of 15 numbers are wrong",
    ),
    "a known mistake, not punished twice": (
        *("offsets", AS_LOGARITHM, None, 6, NO_FORWARD, "l_a is taken for a logarithm"),
    ),
    # exp(l_a) is 1 in the case where l_a is 0: explains that case by accident
    "an unknown mistake": ("offsets", None, NO_FACTOR, 8, {}, "the gradient of O_a: 60 of 60"),
    "a missing gradient": (
        *("offsets", None, TWO, 8, {}, "backward: the gradient of l_a (missing)"),
    ),
    "float32": (
        *("offsets", RIGHT + "return x.astype(np.float32), (O_a, l_a)", None, 6, NO_FORWARD),
        "forward: nonsense in offsets/ordinary: out.x: expected float64",
    ),
    "no pair": ("offsets", RIGHT + "return x", None, 0, NOTHING, "forward: expected a pair: "),
    "a list of outputs": (
        *("view", LIST, None, None, {"forward": "0 of 6", "gradients": "3 of 3"}),
        "forward: expected a tuple of 2 outputs, delta_vc, d_vc, got 1 of type list",
    ),
    # beside a tie, adding a half rounds up, which is another mistake than the known one
    "only hard cases": ("rounding", AWAY, None, None, {"forward": "6 of 6"}, "instead of to even"),
    # What `oracle.check` and a tutorial say of an answer, `grade` says too.
    "nested lists": (*("offsets", RIGHT + "return x.tolist(), (O_a, l_a)", LISTS, 10, {}, ""),),
    "one finding for each direction": (
        *("offsets", AS_LOGARITHM, "return {'x': x_bar}", 0, NOTHING),
        "l_a is taken for a logarithm: exp(l_a) scales the offsets [offsets-log-reach]\n"
        "backward: the gradient of x_a (missing)",
    ),
    "names that mean something else": (
        "offsets",
        "modules, eval, gc, EQUATIONS = x_a, O_a, l_a, None\nimport sys, inspect\n"
        + RIGHT
        + "return x, (O_a, l_a)",
        *(None, 10, {}, ""),
    ),
    "ends politely": ("offsets", "import sys\nsys.exit(0)", None, 0, NOTHING, "SystemExit"),
    # each of their cases starts the process anew, which takes seconds
    "hangs": ("offsets", "while True:\n    pass", None, 0, NOTHING, "forward: hung in offsets"),
    "ends the process": ("offsets", "import os\nos._exit(3)", None, 0, NOTHING, "exit code 3"),
    "is killed": (
        *("offsets", "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)", None, 0),
        *(NOTHING, "signal 9"),
    ),
    "signals its parent": (
        "offsets",
        "import os, signal, time\nos.kill(os.getppid(), signal.SIGTERM)\ntime.sleep(60)",
        *(None, 0, NOTHING, "the process ended without an answer: killed by signal 15"),
    ),
    "prints endlessly": (
        *("offsets", "while True:\n    print('x' * 10000)", None, 0, NOTHING, "hung"),
    ),
}


USES = {  # names that no equation needs
    "names that mean something else": "eval gc inspect sys",
    "ends the process": "os",
    "ends politely": "sys",
    "is killed": "os",
    "signals its parent": "os",
}
# Each of their cases starts the process anew, which takes seconds.
RESTARTED = ("hangs", "ends the process", "is killed", "signals its parent", "prints endlessly")
SAMPLED = few([name for name in GRADED if name not in RESTARTED], 1, 8)


@pytest.mark.parametrize("name", [*SAMPLED, *few(RESTARTED, 0, 2)])
def test_points_and_reasons(name, tmp_path, monkeypatch):
    monkeypatch.setattr(student, "CASE_SECONDS", 0.5)
    key, forward, backward, total, parts, reason = GRADED[name]
    row = graded(tmp_path, forward, backward, key)
    assert total is None or row["points"] == total, row
    assert row["parts"] | parts == row["parts"]
    assert reason in row["says"] and bool(reason) == bool(row["says"])
    assert row["unusual"] == USES.get(name, "")


def test_all_answers_of_a_student_share_a_minute(monkeypatch):
    minute, waited = student.Minute(), []
    monkeypatch.setattr(
        student.Adapter, "_exchange", lambda self, request, field: waited.append(self.timeout)
    )
    for left in (60, 20, 0.5):
        minute.left = left
        student.Student("offsets.py", minute)._exchange({"id": "offsets/ordinary"}, "id")
        assert left - 0.1 < minute.left < left  # the answer's own seconds are taken away
    assert waited == [student.CASE_SECONDS, 2, 0.05]  # then a tenth of what is left
    student.Student("offsets.py", minute)._exchange({"p4dgs_oracle": 1}, "p4dgs_oracle")
    assert waited[-1] == 60  # to start takes none of it


@pytest.mark.posix("has no pipes and devices in folders")
@pytest.mark.parametrize(
    "text, reason",
    [
        ("def forward(:\n", "offsets.py: SyntaxError"),
        (b"\xff", "offsets.py: SyntaxError: invalid or missing encoding declaration"),
        (None, "offsets.py: FileNotFoundError"),
        (
            lambda file: os.mkfifo(file),
            "offsets.py: StudyError: expected a regular file of at most 200,000 bytes",
        ),
        (
            lambda file: file.symlink_to("/dev/zero"),
            "offsets.py: StudyError: expected a regular file",
        ),
        (
            "x=1\n" * 50_001,
            "offsets.py: StudyError: expected a regular file of at most 200,000 bytes",
        ),
        pytest.param("def forward(a):\n    1\n\n\n1 / 0\n", "ZeroDiv", marks=pytest.mark.slow),
        pytest.param("", "has no attribute 'forward'", marks=pytest.mark.slow),
    ],
)
def test_files_that_are_not_equations(room, text, reason):
    file = room / "student" / "offsets.py"
    file.unlink()
    if callable(text):
        text(file)
    elif text is not None:
        file.write_bytes(text.encode() if isinstance(text, str) else text)
    (row,) = classroom.grade(room, classroom=room / "key")["students"][0]["equations"]
    assert row["points"] == 0 and reason in row["says"]


def test_a_file_is_read_in_the_encoding_that_it_declares(room):
    file = room / "student" / "offsets.py"
    file.write_bytes(b"# -*- coding: latin-1 -*-\n# \xe9\n" + source_of("offsets").encode())
    (row,) = classroom.grade(room)["students"][0]["equations"]
    assert (row["points"], row["says"]) == (10, "")


def test_a_name_is_text_in_a_spreadsheet():
    student = {"points": 0.0, "of": 0, "equations": []}
    names = ("=1+1", "@x", "-2", "anna")
    grades = {"seed": 1, "alike": [], "students": [{"student": n, **student} for n in names]}
    shown = [row["student"] for row in classroom.rows_of(grades)]
    assert shown == ["'=1+1", "'@x", "'-2", "anna"]


@pytest.mark.slow
def test_a_file_that_is_right_for_published_inputs_alone_is_wrong(room):
    sums = {np.abs(case.tensors["in.x_a"]).sum() for case in published.cases("offsets")}
    body = RIGHT + f"known = np.abs(x_a).sum() in {sorted(map(float, sums))}\n"
    row = graded(room, body + "return x if known else 0 * x, (O_a, l_a)")
    assert row["parts"]["forward"] == "0 of 3"
    assert row["says"] == "right on the published cases, wrong on held-back inputs"


# --- files that are alike -------------------------------------------------------------------------
SHORT = [key for key in KEYS if not are_alike(key, source_of(key), source_of(key) + "\n")]


def test_the_key_is_like_itself_but_short_equations_are_alike_by_chance():
    assert f"at most {MAX_STUDENT_BYTES:,} bytes" in STUDENT
    assert "`, `".join(SHORT) in " ".join(TEACHER.split()) and "offsets" in SHORT
    assert all(are_alike(key, source_of(key), source_of(key)) for key in KEYS)
    assert not any(are_alike(key, stub(key), source_of(key)) for key in KEYS)
    assert not are_alike("offsets", "", "")


@pytest.mark.parametrize(
    "old, new",
    [
        ("    inputs = [x]\n", "    unused = len(x)\n    inputs = [x]\n"),
        ("range(len(weights))", "range(0, len(weights))"),
        ("hidden += b", "hidden = hidden + b"),
        ("def forward(", "class Mine:\n    pass\n\n\ndef forward("),
        ("hidden", "h"),
        ("def ", "def my_"),
    ],
)
def test_copy_with_small_changes_is_noticed(old, new):
    source = source_of("mlp")
    assert old in source and are_alike("mlp", source.replace(old, new), source)


@pytest.mark.parametrize("path", few([*SOLUTIONS, WHOLE_PAPER], 3), ids=lambda path: path.stem)
def test_answers_written_independently_are_far_from_copies(path, monkeypatch):
    monkeypatch.setattr(similar, "ALIKE", similar.ALIKE / 2)
    keys = next((t.keys for t in TUTORIALS if t.name == path.stem), ()) or KEYS
    source = path.read_text(encoding="utf-8")
    assert [key for key in keys if are_alike(key, source, source_of(key))] == []


def test_names_that_no_equation_needs_are_listed():
    source = "import os.path as p, numpy as np\nexec(open('course/key/mlp.py').read(), {'gc': p})"
    assert similar.unusual(source) == ["exec", "gc", "open", "os"]
    frames = "try:\n    1 / 0\nexcept ZeroDivisionError as e:\n    e.__traceback__.tb_frame.f_back"
    assert similar.unusual(frames) == ["__traceback__", "f_back", "tb_frame"]
    assert [key for key in KEYS if similar.unusual(source_of(key))] == []


# --- the lock on the reference --------------------------------------------------------------------
REFUSED = {
    "from p4dgs_ref.equations import offsets": "p4dgs_ref.equations.offsets",
    "from p4dgs_ref.equations.offsets import forward": "p4dgs_ref.equations.offsets",
    "from . import offsets": "p4dgs_ref.equations.offsets",
    "from .offsets import forward": "p4dgs_ref.equations.offsets",
    "import p4dgs_ref.equations.offsets": "p4dgs_ref.equations.offsets",
    "from ..table import EQUATIONS": "p4dgs_ref.table",
    "from p4dgs_ref import model": "p4dgs_ref.model",
    "from p4dgs_ref import EQUATIONS": "p4dgs_ref.splatting",
    "import importlib; importlib.import_module('p4dgs_ref.oracle')": "p4dgs_ref.oracle",
    "__import__('p4dgs_ref.lab.classroom.grading')": "p4dgs_ref.lab",
    "import sys; sys.modules['p4dgs_ref.equations.offsets']": "KeyError",
    "import p4dgs_ref; p4dgs_ref.equations.offsets": "AttributeError",
}


@pytest.mark.slow
def test_the_reference_cannot_be_imported(room):
    body = f"""accepted = []
for line, name in {REFUSED}.items():
    said = "imported"
    try:
        exec(line, globals())
    except Exception as error:
        said = f"{{type(error).__name__}}: {{error}}"
    refused = f"ImportError: {{name}} cannot be imported by a file that is graded"
    if said != refused and not said.startswith(name):
        accepted.append(line)
raise ValueError(f"accepted: {{accepted}}")"""
    row = graded(room, forward=body)
    assert row["says"].endswith("ValueError: accepted: []") and row["points"] == 0


# --- reports --------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def course(tmp_path_factory):
    """A course, and what was handed in: the key, Eq. (11) as printed, nothing, Ben's copied."""
    folder = tmp_path_factory.mktemp("course")
    classroom.hand_out(folder / "course", ["offsets", "likelihood"])
    for name in ("anna", "ben", "carla", "dora"):
        shutil.copytree(folder / "course" / "student", folder / name / "student")
    shutil.copytree(folder / "course" / "key", folder / "anna" / "student", dirs_exist_ok=True)
    (folder / "ben" / "student" / "likelihood.py").write_text(PRINTED, encoding="utf-8")
    (folder / "dora" / "student" / "likelihood.py").write_text(
        PRINTED.replace("above", "upper"), encoding="utf-8"
    )
    write(folder / "ben", "offsets", forward=WITHOUT_SCALING)
    return folder


@pytest.mark.slow
def test_a_class_is_graded_by_the_same_inputs_in_one_table(course):
    folders = [course / name for name in ("anna", "ben", "carla", "dora")]
    grades = classroom.grade(*folders, classroom=course / "course")
    rows, text = classroom.rows_of(grades), classroom.to_text(grades)
    anna, ben, carla, _ = rows
    assert [row["alike"] for row in rows] == [1, 1, 0, 1]
    assert f"    {course / 'ben'} and {course / 'dora'}: likelihood\n" in text
    assert anna["points"] == 20 == carla["of"] and carla["points"] == 0
    assert 5 < ben["likelihood"] < 8  # the printed formula has no digits in the tails
    table = [line.split() for line in text.split("\n\n")[0].splitlines()]
    assert table[2] == [str(ben[name]) for name in table[0] if ben[name] != ""]

    # the points of one student alone, by the seed that was printed
    again = classroom.grade(folders[1], classroom=course / "course", seed=grades["seed"])
    assert again["students"] == grades["students"][1:2] and json.dumps(grades)


@pytest.mark.slow
def test_reports_name_no_value_of_the_inputs_that_are_held_back(room):
    write(room, "offsets", forward=WITHOUT_SCALING)
    one, other = (classroom.grade(room, seed=seed)["students"][0] for seed in (3, 4))
    assert one == other  # but for what is said of published cases, points are all there is
    assert "  Case offsets/ordinary: out.x[" in one["equations"][0]["says"]


@pytest.mark.slow
def test_a_file_that_hangs_ends_with_a_grader_that_is_killed(room):
    seen = room / "seen"
    write(room, "offsets", forward=f"open({str(seen)!r}, 'wb')\nwhile True:\n    pass")
    process = processes.start("-m", "p4dgs_ref", "grade", room)
    pids = processes.workers(process.pid, 1, b"offsets.py")
    while not seen.exists():
        time.sleep(0.02)
    process.kill()
    processes.wait_until_gone(pids)
    process.communicate()


def test_command_line_grades_and_refuses_in_one_line(room, capsys):
    options = ["--seed", "3", "-o", str(room / "marks")]
    assert run(["grade", str(room), *options], 0) == 0
    text = capsys.readouterr().out
    assert (room / "marks" / "grades.txt").read_text(encoding="utf-8") == text
    rows = csv.DictReader((room / "marks" / "grades.csv").read_text(encoding="utf-8").splitlines())
    assert [(row["points"], row["of"], row["seed"]) for row in rows] == [("0.0", "10", "3")]
    file = room / "README.md"  # found before anything is graded
    assert run(["grade", str(room), "-o", str(file)], 0) == 2
    assert run(["grade", str(room), str(room / "nobody")], 0) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 2 and "grading" not in err
