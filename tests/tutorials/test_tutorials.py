"""The tutorials and their solutions run, and every exercise is asked, hinted at and solved."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref import EQUATIONS, lessons
from p4dgs_ref.lessons import TUTORIALS
from tests.sampling import few
from tests.workshop import answers as solved
from tutorials.tools import notebooks, shared, syllabus
from tutorials.tools.shared import FOLDER

RUN = """
import json, runpy, sys
from p4dgs_ref import lessons
runpy.run_path(sys.argv[1], run_name="__main__")
json.dump(lessons.RESULTS, open("results.json", "w"))
"""
EACH = pytest.mark.parametrize("tutorial", TUTORIALS, ids=[t.name for t in TUTORIALS])
SOME = pytest.mark.parametrize("tutorial", few(TUTORIALS, 0, 7), ids=lambda t: t.name)


def source(tutorial, folder=FOLDER):
    return (folder / f"{tutorial.name}.py").read_text(encoding="utf-8")


def run(path, out):
    """Run a file without a display in one process; return lessons.RESULTS."""
    shared.run(path.name, ["-W", "error::RuntimeWarning", "-c", RUN, path], out)
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


@SOME
def test_tutorial_runs_with_figures_and_its_exercises_unsolved(tutorial, tmp_path):
    results = run(FOLDER / f"{tutorial.name}.py", tmp_path)
    assert not any(results.values())
    assert sorted(results) == syllabus.facts(tutorial).exercises
    figures = sorted(tmp_path.glob(f"{tutorial.name[:2]}_*.png"))
    assert len(figures) >= 2  # the drawing of the architecture and the tutorial's own
    for file in figures:
        image = iio.imread(file)
        assert image.shape[1] >= 600 and image[..., :3].std() > 5, file.name


@SOME
def test_solution_passes(tutorial, tmp_path):
    results = run(FOLDER / "solutions" / f"{tutorial.name}.py", tmp_path)
    assert results == dict.fromkeys(syllabus.facts(tutorial).exercises, True)


@pytest.mark.slow
def test_stored_answers_are_those_of_the_solutions():
    """Where it fails, `python -m tests.workshop.answers` makes them anew."""
    made, stored = solved.answers(), lessons.read_stored("answers")
    assert set(made) == set(stored)
    for exercise, answer in made.items():
        assert np.allclose(answer, stored[exercise], rtol=1e-9, atol=0), exercise


@EACH
def test_exercises_are_numbered_asked_and_solved(tutorial):
    asked = syllabus.facts(tutorial).exercises
    assert asked == [f"{tutorial.name[:2]}.{i + 1}" for i in range(len(asked))]
    assert all(f"# **{exercise}** ●" in source(tutorial) for exercise in asked)
    assert syllabus.exercises(source(tutorial, FOLDER / "solutions")) == asked


def test_every_exercise_has_two_hints():
    hints = lessons.read_stored("hints")
    assert sorted(hints) == [e for t in TUTORIALS for e in syllabus.facts(t).exercises]
    assert {len(both) for both in hints.values()} == {2}


def test_files_and_table_agree_and_every_equation_has_a_tutorial():
    names = [t.name for t in TUTORIALS]
    files = {file.stem for file in FOLDER.glob("[0-9]*.py")} - {"00_whole_paper"}
    assert names == sorted(files)
    assert names == sorted(file.stem for file in (FOLDER / "solutions").glob("*.py"))
    assert sorted(key for t in TUTORIALS for key in t.keys) == sorted(EQUATIONS)


@EACH
def test_package_is_imported_where_it_is_needed_and_figures_have_cells_of_their_own(tutorial):
    before_first = source(tutorial).split("\n# ## ")[0].splitlines()
    imported = [line for line in before_first if line.startswith(("from p4dgs", "import p4dgs"))]
    assert imported == ["from p4dgs_ref import lessons"]
    drawing = [
        cell.text for cell in notebooks.cells(source(tutorial)) if "figures.show(" in cell.text
    ]
    assert drawing and all(map(notebooks.ONLY_DRAWS.match, drawing))  # notebooks collapse them


@pytest.mark.parametrize("path", syllabus.PATHS.values())
def test_paths_need_no_tutorial_outside_them(path):
    after = {tutorial.name[:2]: syllabus.facts(tutorial).after for tutorial in TUTORIALS}
    assert [n for n in path if not set(after[n]) <= set(path[: path.index(n)])] == []
