"""The classroom: the files that students get, and the inputs that are held back from them."""

import ast
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref import EQUATIONS, lessons
from p4dgs_ref.lab import StudyError, classroom
from p4dgs_ref.lab.classroom import grading
from p4dgs_ref.lab.classroom.room import functions_of, keys_of, source_of
from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.checker import judge
from p4dgs_ref.oracle.ports import FunctionPort
from p4dgs_ref.output import OutputError
from tests.sampling import few

SOLUTIONS = Path(__file__).resolve().parents[3] / "tutorials" / "solutions"
KEYS = list(EQUATIONS)


@pytest.fixture
def room(tmp_path):
    classroom.hand_out(tmp_path / "room", ["offsets"])
    return tmp_path / "room"


# --- what students get ----------------------------------------------------------------------------
@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A classroom of all equations."""
    folder = tmp_path_factory.mktemp("whole")
    classroom.hand_out(folder)
    return folder


@pytest.mark.parametrize("key", KEYS)
def test_bodies_are_removed_and_nothing_else(key, whole):
    complete, handed_out = (
        (whole / folder / f"{key}.py").read_text(encoding="utf-8") for folder in ("key", "student")
    )
    assert complete == source_of(key)
    for before, after in zip(ast.parse(complete).body, ast.parse(handed_out).body, strict=True):
        if isinstance(before, ast.FunctionDef) and before.name in functions_of(key):
            assert ast.get_docstring(before) == ast.get_docstring(after) is not None
            assert ast.dump(before.args) == ast.dump(after.args)
            (stub,) = after.body[1:]
            assert f"{key}.{before.name} has to be written" in ast.unparse(stub)
        else:
            assert ast.dump(before) == ast.dump(after)
    assert ("backward" in functions_of(key)) == bool(EQUATIONS[key].gradients)
    with pytest.raises(NotImplementedError, match=f"{key}.forward has to be written"):
        inputs = published.cases(key)[0].inputs()
        classroom.load(whole / "student" / f"{key}.py").forward(**inputs)


def test_shape_comments_stay(room):
    text = (room / "student" / "offsets.py").read_text(encoding="utf-8")
    assert "    O_a,  # [A, k, 3]  learned offsets (multiples of l_a)\n" in text
    assert "x_a[:, None, :]" not in text


def test_readme_lists_every_file_with_its_tutorial(whole):
    text = (whole / "student" / "README.md").read_text(encoding="utf-8")
    for key in KEYS:
        tutorial = f"tutorials/{lessons.tutorial_of(key).name}.py"
        assert f"| `{key}.py` | `{tutorial}` | `{next(iter(functions_of(key)))}`" in text
    assert "{" not in text


def test_students_work_survives_a_second_classroom(room):
    mine = "def forward(x_a, O_a, l_a):\n    return 'mine'\n"
    (room / "student" / "offsets.py").write_text(mine, encoding="utf-8")
    done = classroom.hand_out(room, ["offsets", "view"])
    assert done["kept"] == ["offsets"] and done["equations"] == ["view"]
    assert (room / "student" / "offsets.py").read_text(encoding="utf-8") == mine
    assert keys_of(room) == keys_of(room / "key") == ["offsets", "view"]


def test_refusals_leave_nothing_behind(tmp_path):
    (tmp_path / "taxes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(StudyError, match="expected a classroom"):
        classroom.hand_out(tmp_path)
    with pytest.raises(StudyError, match="equation 'opacities': expected one of offsets"):
        classroom.hand_out(tmp_path / "new", ["opacities"])
    with pytest.raises(StudyError, match="files such as student/offsets.py"):
        classroom.grade(tmp_path)
    with pytest.raises(OutputError):
        classroom.hand_out(tmp_path / "taxes.txt" / "below")
    assert [file.name for file in tmp_path.iterdir()] == ["taxes.txt"]


def test_loading_leaves_the_table_alone(room):
    before, modules = list(EQUATIONS.items()), set(sys.modules)
    path = room / "student" / "offsets.py"
    path.write_text("def forward(x_a, O_a, l_a):\n    return 'mine', 0\n", encoding="utf-8")
    assert classroom.load(path)(x_a=1, O_a=2, l_a=3) == {"x": "mine"}
    path.write_text("1 / 0", encoding="utf-8")
    with pytest.raises(ZeroDivisionError):
        classroom.load(path)
    assert list(EQUATIONS.items()) == before
    assert all(name.endswith("_of_a_student") for name in set(sys.modules) - modules)
    assert not list((room / "student").glob("__pycache__"))


# --- held-back inputs -----------------------------------------------------------------------------
@pytest.mark.parametrize("key", few(KEYS, 3, 8))
def test_inputs_are_new_reproducible_and_of_the_same_kind(key):
    one, again, other = (grading.cases(key, seed) for seed in (1, 1, 2))
    published_inputs = {case.name: case.tensors for case in published.cases(key)}
    for a, b, c in zip(one, again, other, strict=True):
        assert a.id == b.id
        for name, array in a.tensors.items():
            assert np.array_equal(array, b.tensors[name], equal_nan=True)
            is_drawn = name.startswith("out_bar.") and array.size
            if is_drawn and array.shape == np.shape(c.tensors.get(name)):
                assert not np.array_equal(array, c.tensors[name])
            if not name.startswith("in.") or array.dtype.kind != "f":
                continue
            before = published_inputs[a.name][name]
            # Other signs or zeros would make it another case.
            assert np.array_equal(np.sign(array), np.sign(before), equal_nan=True)
            is_new = not np.array_equal(array, before, equal_nan=True)
            if grading.is_ordinary(a):
                is_unit = array.ndim and np.allclose(np.linalg.norm(array, axis=-1), 1)
                assert is_new == bool(array.any() and not is_unit), name
            elif grading.FLAGS_OF_KEPT_INPUTS & {a.name, *a.record["flags"]}:
                assert not is_new
    drawn, ordinary = (sum(map(grading.is_ordinary, c)) for c in (one, published.cases(key)))
    assert drawn == 3 * ordinary > 0


def verdicts(key, forward, backward):
    """Judge the outputs of a forward, or the gradients of a backward, on held-back inputs."""
    port = FunctionPort(forward or EQUATIONS[key], backward)
    role = "in_bar." if backward else "out."
    for case in grading.cases(key, seed=11):
        with np.errstate(all="ignore"):
            got = {name: a for name, a in port.run(case).items() if name.startswith(role)}
        answers = SimpleNamespace(run=lambda _, got=got: got, asked=(role,))
        yield judge(case, answers)[0]


@pytest.mark.slow
def test_solutions_of_the_tutorials_pass_the_held_back_inputs(monkeypatch):
    """Right answers that are computed in another way than the reference's are right as well."""
    answers = []
    monkeypatch.setattr(
        lessons, "check_forward", lambda _, mine, key: answers.append((key, mine, None))
    )
    monkeypatch.setattr(
        lessons,
        "check_backward",
        lambda _, mine, key, *wanted: wanted or answers.append((key, None, mine)),
    )
    for path in sorted(SOLUTIONS.glob("*.py")):
        if path.stem[:2] <= "15":
            runpy.run_path(str(path))
    judged, wrong = set(), []
    for key, forward, backward in answers:
        if key in EQUATIONS:
            judged.add(key)
            wrong += [result.id for result in verdicts(key, forward, backward) if result.wrong]
    assert wrong == []
    assert len(judged) >= 12
