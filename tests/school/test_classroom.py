"""The classroom: what students get, and the inputs that are held back from them."""

import ast
import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref import school
from p4dgs_ref.equations import EQUATIONS
from p4dgs_ref.oracle.checker import judge
from p4dgs_ref.oracle.ports import FunctionPort
from p4dgs_ref.oracle.subjects import FLOW, flatten, subjects
from p4dgs_ref.scenes.output import OutputError
from p4dgs_ref.school import held_back, lessons
from p4dgs_ref.school.removal import functions_of, unwritten, without_bodies
from p4dgs_ref.school.room import source_of
from p4dgs_ref.syllabus import tutorial_of

TUTORIALS = Path(__file__).resolve().parents[2] / "tutorials"


@pytest.fixture
def room(tmp_path):
    school.classroom(tmp_path / "room", ["offsets"])
    return tmp_path / "room"


# --- what students get --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("key", FLOW)
def test_bodies_are_gone_and_nothing_else(key, tmp_path):
    asked = [
        part
        for part in ("forward", "backward")
        if part == "forward" or EQUATIONS[key].differentiable
    ]
    school.classroom(tmp_path, [key])
    full, open_ = ((tmp_path / place / f"{key}.py").read_text() for place in ("key", "student"))
    assert full == source_of(key)
    full_tree, open_tree = ast.parse(full), ast.parse(open_)
    gone = functions_of(key, asked)
    for before, after in zip(full_tree.body, open_tree.body, strict=True):
        if isinstance(before, ast.FunctionDef) and before.name in gone:
            assert ast.get_docstring(before) == ast.get_docstring(after) and ast.dump(
                before.args
            ) == ast.dump(after.args)
            assert unwritten(open_, before.name) and not unwritten(full, before.name)
            assert f"{key}.{before.name}" in ast.unparse(after.body[-1])
        else:
            assert ast.dump(before) == ast.dump(after)
    kept = [
        line
        for line in full.splitlines()
        if line.startswith(("#", "def ", "class ", "from ", "import "))
    ]
    assert [
        line
        for line in open_.splitlines()
        if line.startswith(("#", "def ", "class ", "from ", "import "))
    ] == kept
    with pytest.raises(NotImplementedError):
        school.load(tmp_path / "student" / f"{key}.py").forward(
            **next(iter(EQUATIONS[key].cases())).inputs
        )


def test_comments_of_a_body_go_with_it():
    source = "def f(x):\n    # the answer is twice x\n    return 2 * x    # indeed\n\n\ndef g(x):\n    return x\n"
    assert (
        without_bodies(source, ["f"], str)
        == 'def f(x):\n    raise NotImplementedError("f")\n\n\ndef g(x):\n    return x\n'
    )


def test_backward_only_keeps_forwards(tmp_path):
    done = school.classroom(tmp_path, backward_only=True)
    assert "rounding" not in done["equations"] and set(done["equations"]) == {
        k for k in FLOW if EQUATIONS[k].differentiable
    }
    open_ = (tmp_path / "student" / "likelihood.py").read_text()
    assert unwritten(open_, "backward") and not unwritten(open_, "forward")
    record = json.loads((tmp_path / "classroom.json").read_text())
    record["equations"] = {key: record["equations"][key] for key in ("mlp", "offsets")}
    (tmp_path / "classroom.json").write_text(json.dumps(record))
    grades = school.grade(tmp_path, student=tmp_path / "key", seed=5).grades
    assert len(grades) == 2 and all(grade.of == grade.points == 10 for grade in grades)
    assert not any(
        part.name in ("forward", "hard cases: outputs") for grade in grades for part in grade.parts
    )


def test_readme_lists_every_equation_with_its_tutorial(tmp_path):
    school.classroom(tmp_path)
    text = (tmp_path / "README.md").read_text()
    for key in FLOW:
        assert re.search(
            rf"\| `student/{key}.py` \| `tutorials/{tutorial_of(key).name}.py` \| `forward`", text
        )
    assert "10 points an equation: 4 for the forward" in text and "{" not in text


def test_students_work_survives_a_second_classroom(room):
    mine = "def forward(x_a, O_a, l_a):\n    return 'mine'\n"
    (room / "student" / "offsets.py").write_text(mine)
    school.classroom(room, ["offsets"], seed=9)
    done = school.classroom(room, ["view"])
    assert json.loads((room / "classroom.json").read_text())["seed"] == 9
    assert done["kept"] == ["offsets"] and done["equations"] == ["view"]
    assert (room / "student" / "offsets.py").read_text() == mine
    assert [g.key for g in school.grade(room).grades] == ["view", "offsets"]


def test_refusals_leave_nothing_behind(tmp_path):
    (tmp_path / "taxes.txt").write_text("mine")
    with pytest.raises(school.ClassroomError, match="expected an empty folder"):
        school.classroom(tmp_path)
    with pytest.raises(school.ClassroomError, match="'opacities': expected one of mlp, view"):
        school.classroom(tmp_path / "new", ["opacities"])
    with pytest.raises(school.ClassroomError, match="classroom.json"):
        school.grade(tmp_path)
    with pytest.raises(OutputError):
        school.classroom(tmp_path / "taxes.txt" / "below")
    assert [file.name for file in tmp_path.iterdir()] == ["taxes.txt"]


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"p4dgs_classroom": 1, "seed": "0", "equations": {}}',
        '{"p4dgs_classroom": 1, "seed": 0, "equations": {"offset": ["forward"]}}',
        '{"p4dgs_classroom": 1, "seed": 0, "equations": {"offsets": []}}',
    ],
)
def test_damaged_record_is_refused(room, text):
    (room / "classroom.json").write_text(text)
    with pytest.raises(school.ClassroomError, match="expected a classroom"):
        school.grade(room)


def test_loading_leaves_the_table_alone(room):
    before = list(EQUATIONS.items())
    path = room / "student" / "offsets.py"
    path.write_text(
        path.read_text().replace(
            'raise NotImplementedError("offsets.forward', "return 'mine', 0  # (\"", 1
        )
    )
    assert school.load(path).forward(1, 2, 3)[0] == "mine"
    path.write_text("1 / 0")
    with pytest.raises(ZeroDivisionError):
        school.load(path)
    assert list(EQUATIONS.items()) == before and not list((room / "student").glob("__pycache__"))


# --- held-back inputs ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("key", FLOW)
def test_inputs_are_new_reproducible_and_of_the_same_shapes(key):
    subject = subjects()[key]
    one, again, other = (held_back.cases(subject, seed) for seed in (1, 1, 2))
    old = {case.name: flatten(case.inputs, "in.") for case in subject.cases()}
    changed = 0
    for a, b, c in zip(one, again, other, strict=True):
        assert a.id == b.id and all(
            np.array_equal(a.tensors[n], b.tensors[n], equal_nan=True) for n in a.tensors
        )
        mine = {n: t for n, t in a.tensors.items() if n.startswith("in.")}
        assert {n: t.shape for n, t in mine.items()} == {n: t.shape for n, t in old[a.name].items()}
        changed += any(
            not np.array_equal(t, old[a.name][n], equal_nan=True) for n, t in mine.items()
        )
        bars = [
            n
            for n, t in a.tensors.items()
            if n.startswith("out_bar.") and t.size and t.shape == c.tensors.get(n, t).shape
        ]
        assert all(not np.array_equal(a.tensors[n], c.tensors[n]) for n in bars if n in c.tensors)
        if a.record["flags"] == ["ordinary"]:
            numbers = [
                n for n, t in mine.items() if t.dtype.kind == "f" and t.any() and n != "in.W"
            ]
            assert all(
                not np.array_equal(np.sort(mine[n], axis=None), np.sort(old[a.name][n], axis=None))
                for n in numbers
            )
        for n, t in mine.items():
            if t.dtype.kind == "f":  # a sign or a zero that changes would be another case
                assert np.count_nonzero(t == 0) == np.count_nonzero(old[a.name][n] == 0)
                assert np.count_nonzero(t < 0) == np.count_nonzero(old[a.name][n] < 0)
    assert changed >= min(len(one) / 2, 4)
    assert sum(held_back.is_ordinary(case) for case in subject.cases()) * held_back.DRAWS == sum(
        case.record["flags"] == ["ordinary"] for case in one
    )


def test_rotations_directions_and_covariances_stay_what_they_are():
    for case in held_back.cases(subjects()["covariance"], 3):
        assert (
            np.allclose(np.linalg.norm(case.tensors["in.r"], axis=-1), 1, atol=1e-9)
            or "normalise" in case.record["flags"]
        )
    for case in held_back.cases(subjects()["projection"], 3):
        W, Sigma = case.tensors["in.W"], case.tensors["in.Sigma"]
        assert np.allclose(W @ W.T, np.eye(3), atol=1e-9)
        if case.name == "ordinary":
            assert np.allclose(Sigma, Sigma.swapaxes(1, 2)) and np.linalg.eigvalsh(Sigma).min() > 0
    a, b, c = held_back.cases(subjects()["compositing"], 3)[0].tensors["in.conic"].T
    assert (a * c > b * b).all()


def verdicts(key, forward, backward):
    """On held-back inputs: of a forward's outputs, or of a backward's gradients."""
    port = FunctionPort(forward or EQUATIONS[key], backward)
    roles = ("in_bar.",) if backward else ("out.",)
    for case in held_back.cases(subjects()[key], seed=11):
        kept = {
            name: a
            for name, a in case.tensors.items()
            if not name.startswith(("out.", "in_bar.")) or name.startswith(roles)
        }
        with np.errstate(all="ignore"):
            got = {name: a for name, a in port.run(case).items() if name.startswith(roles)}
        yield judge(
            case._replace(tensors=kept), SimpleNamespace(run=lambda _, got=got: got), roles
        )[0]


def test_solutions_of_the_tutorials_pass_the_held_back_inputs(monkeypatch):
    """Right answers that are written otherwise than the reference's are right for the grader too."""
    found = []
    monkeypatch.setattr(
        lessons, "forward", lambda exercise, mine, key: found.append((key, mine, None))
    )
    monkeypatch.setattr(
        lessons,
        "backward",
        lambda exercise, mine, key, *wanted: wanted or found.append((key, None, mine)),
    )
    for path in sorted((TUTORIALS / "solutions").glob("*.py")):
        if path.stem[:2] <= "15":
            runpy.run_path(str(path))
    judged, wrong = set(), []
    for key, forward, backward in found:
        if key in EQUATIONS:
            judged.add(key)
            wrong += [result.id for result in verdicts(key, forward, backward) if result.wrong]
    assert wrong == []
    assert len(judged) >= 12
