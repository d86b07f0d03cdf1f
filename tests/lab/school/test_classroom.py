"""The classroom: the files that students get, and the inputs that are held back from them."""

import ast
import re
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref import EQUATIONS
from p4dgs_ref.lab import school
from p4dgs_ref.lab.school import grading, held_back, lessons
from p4dgs_ref.lab.school.room import (
    equations,
    functions_in,
    functions_of,
    kept,
    keys_of,
    source_of,
)
from p4dgs_ref.lab.school.syllabus import tutorial_of
from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.checker import judge
from p4dgs_ref.oracle.ports import FunctionPort
from p4dgs_ref.oracle.report import name_of
from p4dgs_ref.output import OutputError
from tests.sampling import few

TUTORIALS = Path(__file__).resolve().parents[3] / "tutorials"
KEYS = equations()


@pytest.fixture
def room(tmp_path):
    school.classroom(tmp_path / "room", ["offsets"])
    return tmp_path / "room"


# --- what students get ----------------------------------------------------------------------------
@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A classroom of all equations."""
    folder = tmp_path_factory.mktemp("whole")
    school.classroom(folder)
    return folder


@pytest.mark.parametrize("key", KEYS)
def test_bodies_are_removed_and_nothing_else(key, whole):
    full = (whole / "key" / f"{key}.py").read_text()
    open_ = (whole / "student" / f"{key}.py").read_text()
    assert full == source_of(key)
    gone = functions_of(key)
    assert set(gone) <= set(functions_in(full))
    for before, after in zip(ast.parse(full).body, ast.parse(open_).body, strict=True):
        if isinstance(before, ast.FunctionDef) and before.name in gone:
            assert ast.get_docstring(before) == ast.get_docstring(after) is not None
            assert ast.dump(before.args) == ast.dump(after.args)
            assert [ast.dump(s) for s in kept(before)] == [ast.dump(s) for s in kept(after)]
            said = f"{name_of(key)}.{before.name} has to be written"
            (stub,) = after.body[len(kept(after)) :]
            assert ast.unparse(stub) == f"raise NotImplementedError({said!r})"
        else:
            assert ast.dump(before) == ast.dump(after)
    outside = ("#", "def ", "class ", "from ", "import ")
    one, other = (
        [line for line in text.splitlines() if line.startswith(outside)] for text in (full, open_)
    )
    assert one == other
    with pytest.raises(NotImplementedError):
        inputs = published.cases(key)[0].inputs()
        school.load(whole / "student" / f"{key}.py").forward(**inputs)


def test_shape_comments_and_the_unpacking_of_saved_stay(room):
    text = (room / "student" / "offsets.py").read_text()
    assert "    O_a,  # [A, k, 3]  learned offsets (multiples of l_a)\n" in text
    assert "    O_a, l_a = saved\n    raise NotImplementedError(" in text
    assert "x_a[:, None, :]" not in text


@pytest.mark.parametrize(
    "key, heart",
    [
        (
            "hash_grid",
            ("prod(axis=2)", "bitwise_xor", "floor", "csr_matrix((", "grid_nodes import"),
        ),
        ("likelihood", ("erfcx(", "expm1", "log1p", "ndtr(", "322560", "per_unit")),
    ],
)
def test_the_heart_of_eqs_9_and_11_is_to_be_written(key, heart, whole):
    full, open_ = (
        "\n".join(
            ast.unparse(node)
            for node in ast.parse((whole / folder / f"{key}.py").read_text()).body
            if not isinstance(node, ast.Expr)
        )
        for folder in ("key", "student")
    )
    code = re.sub(r'""".*?"""', "", open_, flags=re.DOTALL)
    for words in heart:
        assert words not in code
        assert words in full or words == "grid_nodes import"


def test_readme_lists_every_equation_with_its_tutorial(whole):
    text = (whole / "student" / "README.md").read_text()
    for key in KEYS:
        tutorial = f"tutorials/{tutorial_of(key).name}.py"
        assert re.search(rf"\| `{key}.py` \| `{tutorial}` \| `forward`", text)
    assert "10 points an equation: 3 for the forward" in text and "{" not in text
    assert all(f"`{key}`" in text for key in grading.SAVES_SLOPES)


def test_students_work_survives_a_second_classroom(room):
    mine = "def forward(x_a, O_a, l_a):\n    return 'mine'\n"
    (room / "student" / "offsets.py").write_text(mine)
    done = school.classroom(room, ["offsets", "view"])
    assert done["kept"] == ["offsets"] and done["equations"] == ["view"]
    assert (room / "student" / "offsets.py").read_text() == mine
    assert keys_of(room) == keys_of(room / "key") == ["view", "offsets"]


def test_refusals_leave_nothing_behind(tmp_path):
    (tmp_path / "taxes.txt").write_text("mine")
    with pytest.raises(school.ClassroomError, match="expected a classroom"):
        school.classroom(tmp_path)
    with pytest.raises(school.ClassroomError, match="'opacities': expected one of mlp, view"):
        school.classroom(tmp_path / "new", ["opacities"])
    with pytest.raises(school.ClassroomError, match="files such as student/offsets.py"):
        school.grade(tmp_path)
    with pytest.raises(OutputError):
        school.classroom(tmp_path / "taxes.txt" / "below")
    assert [file.name for file in tmp_path.iterdir()] == ["taxes.txt"]


def test_loading_leaves_the_table_alone(room):
    before = list(EQUATIONS.items())
    modules = set(sys.modules)
    path = room / "student" / "offsets.py"
    stub = 'raise NotImplementedError("Eq. (1) offsets.forward'
    path.write_text(path.read_text().replace(stub, "return 'mine', 0  # (\"", 1))
    eq = school.load(path)
    assert eq.forward(1, 2, 3)[0] == "mine"
    assert eq(x_a=1, O_a=2, l_a=3) == {"x": "mine"}
    path.write_text("1 / 0")
    with pytest.raises(ZeroDivisionError):
        school.load(path)
    assert list(EQUATIONS.items()) == before
    assert all(name.endswith("_of_a_student") for name in set(sys.modules) - modules)
    assert not list((room / "student").glob("__pycache__"))


# --- held-back inputs -----------------------------------------------------------------------------
def inputs_of(case):
    return {name: a for name, a in case.tensors.items() if name.startswith("in.")}


@pytest.mark.parametrize("key", few(KEYS, 4))
def test_inputs_are_new_reproducible_and_of_the_same_shapes(key):
    one, again, other = (held_back.cases(key, seed) for seed in (1, 1, 2))
    old = {case.name: inputs_of(case) for case in published.cases(key)}
    for a, b, c in zip(one, again, other, strict=True):
        assert a.id == b.id
        assert all(np.array_equal(a.tensors[n], b.tensors[n], equal_nan=True) for n in a.tensors)
        mine, before = inputs_of(a), old[a.name]
        assert {n: t.shape for n, t in mine.items()} == {n: t.shape for n, t in before.items()}
        for name, bar in a.tensors.items():
            if name.startswith("out_bar.") and bar.size and name in c.tensors:
                if bar.shape == c.tensors[name].shape:
                    assert not np.array_equal(bar, c.tensors[name])
        for name, t in mine.items():
            if t.dtype.kind != "f":
                continue
            # other signs or zeros would make it another case
            assert np.array_equal(np.sign(t), np.sign(before[name]), equal_nan=True)
            is_new = not np.array_equal(t, before[name], equal_nan=True)
            if held_back.is_ordinary(a):
                is_unit = t.ndim and np.allclose(np.linalg.norm(t, axis=-1), 1)
                assert is_new == bool(t.any() and not is_unit), name
            elif held_back.KEPT & {a.name, *a.record["flags"]}:
                assert not is_new
    ordinary = [case for case in published.cases(key) if held_back.is_ordinary(case)]
    drawn = [case for case in one if held_back.is_ordinary(case)]
    assert len(drawn) == held_back.DRAWS * len(ordinary) > 0


def test_rotations_directions_and_covariances_stay_what_they_are():
    for case in held_back.cases("covariance", 3):
        lengths = np.linalg.norm(case.tensors["in.r"], axis=-1)
        assert np.allclose(lengths, 1, atol=1e-9) or "normalise" in case.record["flags"]
    for case in held_back.cases("projection", 3):
        W, Sigma = case.tensors["in.W"], case.tensors["in.Sigma"]
        assert np.allclose(W @ W.T, np.eye(3), atol=1e-9)
        if case.name == "ordinary":
            assert np.allclose(Sigma, Sigma.swapaxes(1, 2))
            assert np.linalg.eigvalsh(Sigma).min() > 0
    a, b, c = held_back.cases("compositing", 3)[0].tensors["in.conic"].T
    assert (a * c > b * b).all()


def verdicts(key, forward, backward):
    """Judge the outputs of a forward, or the gradients of a backward, on held-back inputs."""
    port = FunctionPort(forward or EQUATIONS[key], backward)
    role = "in_bar." if backward else "out."
    for case in held_back.cases(key, seed=11):
        with np.errstate(all="ignore"):
            got = {name: a for name, a in port.run(case).items() if name.startswith(role)}
        answers = SimpleNamespace(run=lambda _, got=got: got, asked=(role,))
        yield judge(case, answers)[0]


@pytest.mark.slow
def test_solutions_of_the_tutorials_pass_the_held_back_inputs(monkeypatch):
    """Right answers that are computed in another way than the reference's are right as well."""
    found = []
    monkeypatch.setattr(lessons, "forward", lambda _, mine, key: found.append((key, mine, None)))
    monkeypatch.setattr(
        lessons,
        "backward",
        lambda _, mine, key, *wanted: wanted or found.append((key, None, mine)),
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
