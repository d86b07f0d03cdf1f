"""The grader: its points for what students write, what they cannot break, and its reports."""

import csv
import inspect
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.cli.parser import run
from p4dgs_ref.lab import classroom
from p4dgs_ref.lab.classroom import student
from p4dgs_ref.lab.classroom.room import (
    MAX_STUDENT_BYTES,
    STUDENT,
    TEACHER,
    functions_in,
    functions_of,
    kept,
    sources_of,
    stubs_of,
)
from p4dgs_ref.lab.classroom.student import ALIKE, alike, copies, joined, same_lines
from p4dgs_ref.lessons import TUTORIALS
from p4dgs_ref.oracle import published
from p4dgs_ref.splatting import loop
from p4dgs_ref.splatting.table import EQUATIONS
from tests import processes
from tests.sampling import few

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


def source_of(key):
    """The complete files of an equation as one text."""
    return joined(sources_of(key))


def stub_of(key):
    """The files of an equation as handed out, as one text."""
    return joined(stubs_of(key))


def write(folder, key, forward=None, backward=None):
    """Write a student's files with these bodies; None is the reference's, without its comments.

    They begin with a byte order mark, as some editors write it.
    """
    for name, source in sources_of(key).items():
        source = "\n".join(line.partition("# ")[0].rstrip() for line in source.splitlines())
        for function, body in {"forward": forward, "backward": backward}.items():
            if name == key and body is not None:
                node, lines = functions_in(source)[function], source.splitlines()
                lines[kept(node)[-1].end_lineno : node.end_lineno] = [
                    f"    {line}" for line in body.splitlines()
                ]
                source = "\n".join(lines) + "\n"
        (folder / "student" / f"{name}.py").write_text(
            "import numpy as np\n" + source, encoding="utf-8-sig"
        )


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


def points(row):
    return {part["name"]: round(part["points"], 6) for part in row["parts"]}


# --- points ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "keys", [["offsets", "rounding"], pytest.param(KEYS, marks=pytest.mark.slow)], ids=len
)
def test_the_key_gets_all_points_and_files_not_begun_get_none(tmp_path, keys):
    classroom.hand_out(tmp_path, keys)
    grades = classroom.grade(tmp_path, tmp_path / "key", seed=4)
    empty, full = grades["students"]
    assert grades["seed"] == 4 and empty["points"] == 0 and empty["of"] == 10 * len(keys)
    assert {row["says"] for row in empty["equations"]} == {"not begun"}
    for row in full["equations"]:
        assert sum(part["points"] for part in row["parts"]) == pytest.approx(10), row
        assert row["says"].startswith("10 points withheld, copied: ")
        assert row["points"] == 0 and row["flags"]


NO_SUM = """return {"x_a": x_bar[:, -1], "O_a": x_bar * l_a[:, None, :],
"l_a": (x_bar * O_a).sum(axis=1)}"""
NO_FACTOR = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar, "l_a": (x_bar * O_a).sum(axis=1)}'
TWO = 'return {"x_a": x_bar.sum(axis=1), "O_a": x_bar * l_a[:, None, :]}'
SWAPPED = """l_a, O_a = O_a, l_a
return {"x_a": x_bar.sum(axis=1), "O_a": x_bar * l_a[:, None, :],
"l_a": (x_bar * O_a).sum(axis=1)}"""
AWAY = """sign = np.where(f / q < 0, -1, 1)
symbols = (sign * np.floor(np.abs(f / q) + 0.5)).astype(np.int64)
return (symbols, symbols * q), ()"""
LIST = """v = x_a - x_c
d = np.sqrt((v * v).sum(axis=1, keepdims=True))
return [d, v / d], (d, v)"""
# key, forward, backward, least and most points, points of some parts, what `says` says
FULL = {"forward": 3, "gradient of x_a": 1, "hard cases: outputs": 2, "hard cases: gradients": 2}
NO_FORWARD = {**FULL, "forward": 0, "hard cases: outputs": 0}
NO_BACKWARD = {**FULL, "gradient of x_a": 0, "hard cases: gradients": 0}
GRADED = {
    "right": ("offsets", RIGHT + "return x, (O_a, l_a)", None, 10, FULL, ""),
    "forward alone": (
        *("offsets", None, LATER, 5, NO_BACKWARD),
        "backward: error in offsets/ordinary: NotImplementedError: later",
    ),
    "backward alone, on what the reference saves": (
        *("offsets", LATER, None, 5, NO_FORWARD),
        "forward: error in offsets/ordinary: NotImplementedError: later",
    ),
    "a gradient without its sum": (
        *("offsets", None, NO_SUM, 7.6667, {"gradient of x_a": 0, "gradient of O_a": 1}),
        "backward: the gradient of x_a: 15 of 15 numbers are wrong",
    ),
    "a known mistake, not punished twice": (
        *("offsets", AS_LOGARITHM, None, 5, NO_FORWARD, "l_a is taken for a logarithm"),
    ),
    "a wrong forward that saves something else": (
        *("offsets", "return x_a[:, None, :] + O_a, (l_a, O_a)", SWAPPED, 5, NO_FORWARD),
        "forward: the output x: 60 of 60 numbers are wrong",
    ),
    # exp(l_a) is 1 in the case where l_a is 0: explains that case by accident
    "an unknown mistake": ("offsets", None, NO_FACTOR, 7, {}, "the gradient of O_a: 60 of 60"),
    "a missing gradient": ("offsets", None, TWO, 7, {}, "backward: the gradient of l_a is missing"),
    "float32": (
        *("offsets", RIGHT + "return x.astype(np.float32), (O_a, l_a)", None, 5, NO_FORWARD),
        "forward: the output x is of type float32; expected [A, k, 3] = [5, 4, 3] of float64",
    ),
    "a list": (
        *("offsets", RIGHT + "return x.tolist(), (O_a, l_a)", None, 5, NO_FORWARD),
        "forward: the output x is of type list; expected [A, k, 3] = [5, 4, 3] of float64",
    ),
    "a gradient in float32": (
        *("offsets", None, TWO[:-1] + ', "l_a": l_a.astype("f")}', 7, {}),
        "backward: the gradient of l_a is of type float32; expected [A, 3] = [5, 3] of float64",
    ),
    "no pair": ("offsets", RIGHT + "return x", None, 5, NO_FORWARD, "forward: expected a pair, "),
    "no dictionary": (
        *("offsets", None, "return x_bar, x_bar", 5, NO_BACKWARD),
        "backward: expected a dictionary {input name: gradient}, got tuple",
    ),
    "an error": ("offsets", "return 1 / 0", None, 5, NO_FORWARD, "ZeroDivisionError"),
    "a list of outputs": (
        *("view", LIST, None, 5, {"forward": 0}),
        "forward: expected a tuple of 2 outputs, delta_vc, d_vc, got 1 of type list",
    ),
    # beside a tie, adding a half rounds up, which is another mistake than the known one
    "only hard cases": ("rounding", AWAY, None, 7.5, {"forward": 6}, "instead of to even"),
    "prints and changed inputs": (
        *("offsets", 'print("x" * 100_000)\n' + RIGHT + "x_a[:] = 7\nreturn x, (O_a, l_a)"),
        *(None, 10, FULL, ""),
    ),
    "names that mean something else": (
        "offsets",
        "modules, eval, gc, EQUATIONS = x_a, O_a, l_a, None\nimport sys, inspect\n"
        + RIGHT
        + "return x, (O_a, l_a)",
        *(None, 10, FULL, ""),
    ),
    # what the reference's forward saves contains the weights, hence it is not lent
    "the reference's nodes": (
        *("hash_grid", "from p4dgs_ref.equations.grid_nodes import locate\nreturn 1, 2", None),
        *(0, {"gradient of grids": 0}, "equations.grid_nodes cannot be imported"),
    ),
    "no pair of two files": (
        *("hash_grid", "return locate(x_a, lo, hi, resolutions, [len(g) for g in grids])", None),
        *(0, {"gradient of grids": 0}, "expected a pair"),
    ),
    # each costs only its own function
    "hangs": ("offsets", "while True:\n    pass", None, 5, NO_FORWARD, "forward: hung in offsets"),
    "ends the process": (
        *("offsets", "import os\nos._exit(3)", None, 5, NO_FORWARD, "exit code 3"),
    ),
    "ends politely": ("offsets", "import sys\nsys.exit(0)", None, 5, NO_FORWARD, "SystemExit"),
    "recursion": ("offsets", "return forward(x_a, O_a, l_a)", None, 5, NO_FORWARD, "RecursionErr"),
    "is killed": (
        *("offsets", "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)", None, 5),
        *(NO_FORWARD, "signal 9"),
    ),
    "no numbers": (
        "offsets",
        "return np.array(['x']), None",
        None,
        5,
        {},
        "output x is of type str32",
    ),
    "reads": ("offsets", "input()", None, 5, NO_FORWARD, "EOFError"),
    "prints endlessly": (
        *("offsets", "while True:\n    print('x' * 10000)", None, 5, NO_FORWARD, "hung"),
    ),
}


USES = {  # names that no equation needs
    "names that mean something else": ["eval", "gc", "inspect", "sys"],
    "ends the process": ["os"],
    "ends politely": ["sys"],
    "is killed": ["os"],
}
# Each of their cases starts the process anew, which takes seconds.
RESTARTED = ("hangs", "ends the process", "is killed", "prints endlessly")
SAMPLED = few([name for name in GRADED if name not in RESTARTED], 2)


@pytest.mark.parametrize(
    "name", [*SAMPLED, *(pytest.param(name, marks=pytest.mark.slow) for name in RESTARTED)]
)
def test_points_and_reasons(name, tmp_path, monkeypatch):
    monkeypatch.setattr(student, "CASE_SECONDS", 0.5)
    key, forward, backward, total, parts, reason = GRADED[name]
    row = graded(tmp_path, forward, backward, key)
    assert row["points"] == total
    assert points(row) | parts == points(row)
    assert reason in row["says"] and bool(reason) == bool(row["says"])
    assert row["unusual"] == USES.get(name, [])


def test_time_of_an_equation_is_limited(room, monkeypatch):
    monkeypatch.setattr(student, "ALL_SECONDS", 0)
    assert "not asked, because 0 s are over" in graded(room)["says"]


@pytest.mark.parametrize(
    "text, reason",
    [
        ("def forward(:\n", "offsets.py cannot be read: SyntaxError"),
        (b"\xff", "offsets.py cannot be read: UnicodeDecodeError"),
        (None, "offsets.py cannot be read: FileNotFoundError"),
        (os.mkfifo, "offsets.py: expected a regular file of at most 200,000 bytes"),
        (lambda file: file.symlink_to("/dev/zero"), "offsets.py: expected a regular file"),
        ("x=1\n" * 50_001, "offsets.py: expected a regular file of at most 200,000 bytes"),
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


@pytest.mark.slow
def test_a_file_that_is_right_for_published_inputs_alone_is_wrong(room):
    sums = {np.abs(case.tensors["in.x_a"]).sum() for case in published.cases("offsets")}
    body = RIGHT + f"known = np.abs(x_a).sum() in {sorted(map(float, sums))}\n"
    row = graded(room, body + "return x if known else 0 * x, (O_a, l_a)")
    assert points(row)["forward"] == 0
    assert row["says"] == "right on the published cases, wrong on inputs that are held back"


# --- copies ---------------------------------------------------------------------------------------


SHORT = {"forward", "backward"}  # lines that are in the stub as well, such as `saved`
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
    names = {name.split()[0] for name in copies(source_of(key), key)}
    assert names >= set(functions_of(key)) - SHORT


@pytest.mark.parametrize(
    "copied, flagged",
    [
        (["offsets"], True),  # with its comment
        (["color", "rotation"], False),  # may be chance
        (["color", "rotation", "total_loss"], True),
        (["color", "noise"], True),
        ([], False),
    ],
)
def test_short_equations_are_copies_where_the_text_excludes_chance(copied, flagged):
    full = {key: source_of(key) for key in ("color", "noise", "offsets", "rotation", "total_loss")}
    mine = {key: full[key] if key in copied else stub_of(key) for key in full}
    mine["color"] = "# my file\n" + mine["color"].replace(
        "    return", "    unused = 1\n    return"
    )
    assert set(same_lines(mine, full)) == set(copied if flagged else ())


@pytest.mark.parametrize(
    "old, new, same",
    [
        ("above", "upper", {"likelihood"}),
        ("    return {", "    unused = sigma * 1e9\n    return {", {"likelihood"}),
        (PRINTED, "def forward(f):\n    return f, f\n", set()),
    ],
)
def test_students_are_alike_whatever_the_names_but_not_in_short_equations(old, new, same):
    assert old in PRINTED
    short = stub_of("offsets").replace("raise NotImplementedError", "return str")
    one, other = (
        {"likelihood": text, "offsets": short} for text in (PRINTED, PRINTED.replace(old, new))
    )
    assert alike(one, other) == alike(other, one) == same


def test_copy_from_another_file_of_the_package_is_noticed():
    twin = inspect.getsource(loop)
    copied = copies(f"{stub_of('compositing')}\n\n{twin}", "compositing")
    assert {name.split()[0] for name in copied} == set(functions_in(twin))


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


@pytest.mark.parametrize("path", few([*SOLUTIONS, WHOLE_PAPER], 3), ids=lambda path: path.stem)
def test_answers_written_independently_are_far_from_copies(path):
    keys = next((t.keys for t in TUTORIALS if t.name == path.stem), ()) or KEYS
    source = path.read_text(encoding="utf-8")
    assert {key: copies(source, key, alike=ALIKE / 2) for key in keys} == {key: [] for key in keys}


def test_short_equations_are_alike_by_chance_and_the_teacher_knows_them():
    assert f"at most {MAX_STUDENT_BYTES:,} bytes" in STUDENT
    short = [key for key in KEYS if not copies(source_of(key), key)]
    assert [key for key in KEYS if copies(stub_of(key), key)] == []
    assert "offsets" in short and "`, `".join(short) in " ".join(TEACHER.split())


def test_names_that_no_equation_needs_are_listed():
    source = "import os.path as p, numpy as np\nexec(open('course/key/mlp.py').read(), {'gc': p})"
    assert student.unusual(source) == ["exec", "gc", "open", "os"]
    frames = "try:\n    1 / 0\nexcept ZeroDivisionError as e:\n    e.__traceback__.tb_frame.f_back"
    assert student.unusual(frames) == ["__traceback__", "f_back", "tb_frame"]
    assert [key for key in KEYS if student.unusual(source_of(key))] == []


# --- the lock on the reference --------------------------------------------------------------------
REFUSED = {
    "from p4dgs_ref.equations import offsets": "p4dgs_ref.equations.offsets",
    "from p4dgs_ref.equations.offsets import forward": "p4dgs_ref.equations.offsets",
    "from . import offsets": "p4dgs_ref.equations.offsets",
    "from .offsets import forward": "p4dgs_ref.equations.offsets",
    "import p4dgs_ref.equations.offsets": "p4dgs_ref.equations.offsets",
    "from ..splatting.table import EQUATIONS": "p4dgs_ref.splatting.table",
    "from p4dgs_ref import model": "p4dgs_ref.model",
    "from p4dgs_ref import EQUATIONS": "p4dgs_ref.splatting.table",
    "import importlib; importlib.import_module('p4dgs_ref.oracle')": "p4dgs_ref.oracle",
    "__import__('p4dgs_ref.lab.classroom.held_back')": "p4dgs_ref.lab",
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
    assert row["says"].endswith("ValueError: accepted: []") and points(row)["forward"] == 0


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


def grade_all(folder, *names, **options):
    return classroom.grade(*(folder / n for n in names), classroom=folder / "course", **options)


@pytest.mark.slow
def test_a_class_is_graded_by_the_same_inputs_in_one_table(course, tmp_path):
    grades = grade_all(course, "anna", "ben", "carla", "dora")
    classroom.write(grades, tmp_path)
    rows = list(csv.DictReader((tmp_path / "grades.csv").read_text(encoding="utf-8").splitlines()))
    anna, ben, carla, _ = rows
    assert [row["copied"] for row in rows] == ["2", "0", "0", "0"]
    assert [row["alike"] for row in rows] == ["0", "1", "0", "1"]
    text = classroom.to_text(grades)
    assert f"    {course / 'ben'} and {course / 'dora'}: likelihood\n" in text
    assert float(anna["points"]) == float(carla["points"]) == 0 and float(carla["of"]) == 20
    assert float(ben["points"]) == grades["students"][1]["points"] > 0
    assert 6 < float(ben["likelihood"]) < 8  # the printed formula has no digits in the tails
    table = [line.split() for line in text.split("\n\n")[0].splitlines()]
    assert table[2] == [ben[name] for name in table[0] if ben[name]]
    # the points of one student alone, by the seed that was printed
    again = grade_all(course, "ben", seed=grades["seed"])
    assert again["students"] == grades["students"][1:2]
    value = json.loads((tmp_path / "grades.json").read_text(encoding="utf-8"))
    assert value == json.loads(json.dumps(grades))
    assert value["students"][1]["equations"][0]["tutorial"] == "01_offsets"
    assert (tmp_path / "grades.txt").read_text(encoding="utf-8") == text + "\n"


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
    assert run(["grade", str(room), str(room), *options], 0) == 0
    text = capsys.readouterr().out
    assert (room / "marks" / "grades.txt").read_text(encoding="utf-8") == text
    file = room / "README.md"  # found before anything is graded
    assert run(["grade", str(room), "-o", str(file)], 0) == 2
    assert run(["grade", str(room), str(room / "nobody")], 0) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 2 and "grading" not in err
