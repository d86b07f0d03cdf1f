"""The tutorials and their solutions run, and every exercise is asked, hinted at and solved."""

import json
import re

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref import EQUATIONS, lessons
from p4dgs_ref.lessons import TUTORIALS
from tests.sampling import few
from tests.workshop import answers as solved
from tutorials.tools import glossary, notebooks, shared, syllabus
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


# --- letters ----------------------------------------------------------------------------------
MATH = re.compile(r"\$\$(.+?)\$\$|\$([^$]+)\$", re.S)
NOT_LETTERS = re.compile(
    r"\\(?:tag|mathrm)\{[^}]*\}|\\(?:bar|dot|tilde|hat|overline|mathbf|rm)\b"
    r"|(?<![A-Za-z\\])d(?=[A-Za-z\\])"  # differentials
)
LETTER = re.compile(r"(\\mathcal\{\w\}|\\[A-Za-z]+|[A-Za-z])(?:_(\{[^}]*\}|\\[a-z]+|\w))?")
# What stands before a letter where it is only used: "the same $q$".
USED = set("a an the this that same its of to in from with for and or by on at as than is".split())


def letters(text):
    """The letters of a formula with their subscripts; bars, hats and running indices left out."""
    found = LETTER.findall(NOT_LETTERS.sub(" ", text))
    below = (re.sub(r"[{}\s]", "", name) for _, name in found)
    names = (re.sub(r"(?<=a)[ij]$|^[\dijnk,+-]*$", "", name) for name in below)
    return [f"{letter}_{name}".rstrip("_") for (letter, _), name in zip(found, names)]


def is_introduced(letter, prose):
    """Whether a cell says what a letter is: in words beside it, or on the left of an equation."""
    for formula in MATH.finditer(prose):
        lefts = re.findall(r"(?:[$,;]|quad)([^$,;=]*)=", formula[0])
        if any(letter in letters(left) for left in lefts):
            return True
        names = letters(formula[0])
        if letter in names and len(names) == formula[0].count(",") + 1:  # alone, or in a list
            before = re.findall(r"([A-Za-z]+)\**,?\s$", prose[: formula.start()])
            after = prose[formula.end() :].lstrip()
            counted = letter in glossary.AXES and re.match(r"\w+(s|ren)\b", after)
            if counted or re.match(r"(is|are|for|has|stands|may)\b|, the", after):
                return True
            if before and before[0].lower() not in USED:
                return True
    return False


@pytest.mark.parametrize("path", syllabus.PATHS.values(), ids=syllabus.PATHS)
def test_paths_introduce_each_letter_of_the_glossary_where_they_first_use_it(path):
    rows = (glossary.row(*item)[0] for item in glossary.mentions().items())
    known = {name for row in rows if "log" not in row for name in letters(row)} | {*glossary.AXES}
    met = set()
    for tutorial in TUTORIALS:
        cells = notebooks.cells(source(tutorial)) if tutorial.name[:2] in path else ()
        for cell in (cell for cell in cells if cell.prose):
            used = {name for math in MATH.finditer(cell.text) for name in letters(math[0])}
            assert "u" not in used or "07" in tutorial.name, tutorial  # the noise alone
            assert "L" not in used or "05" in tutorial.name, tutorial  # frequencies alone
            for name in sorted((used & known) - met):
                assert is_introduced(name, cell.text), f"{tutorial.name}, line {cell.line}: {name}"
            met |= used
