"""The tutorials run, have the form that they share, and explain every equation."""

import ast
import json
import re
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref import lessons
from p4dgs_ref.lessons import TUTORIALS, tutorial_of
from p4dgs_ref.oracle.published import subjects
from p4dgs_ref.table import EQUATIONS
from tests.golden import answers
from tests.sampling import few
from tests.tutorials import tutorial_form as form
from tutorials.tools import gallery, notebooks, shared, syllabus

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"
NAMES = {tutorial.name for tutorial in TUTORIALS}
INDEX = (FOLDER / "README.md").read_text(encoding="utf-8")
WIDTH, LEGIBLE = 640, 8  # pixels: of a page, and of the smallest text of a picture on it
RUN = """
import json, runpy, sys
from p4dgs_ref import lessons
from tests.tutorials import drawn
show, texts = lessons.show, {}
def watched(figure, name, **how):
    show(figure, name, **how)
    texts[name + ".png"] = drawn.smallest(figure)
lessons.show = watched
for path in sys.argv[1:]:
    runpy.run_path(path, run_name="__main__")
json.dump(lessons.RESULTS, open("results.json", "w"))
json.dump(texts, open("texts.json", "w"))
"""


EACH = pytest.mark.parametrize("tutorial", TUTORIALS, ids=[t.name for t in TUTORIALS])
SECONDS = syllabus.measured_before()
CHEAP = [(t,) for t in TUTORIALS if SECONDS[t.name[:2]] < 2]
DEAR = [pytest.param(t, marks=pytest.mark.slow) for t in TUTORIALS if (t,) not in CHEAP]
A_FEW = pytest.mark.parametrize("tutorial", [*few(CHEAP, 1), *DEAR], ids=lambda t: t.name)


def source(tutorial, solution=False):
    folder = FOLDER / "solutions" if solution else FOLDER
    return (folder / f"{tutorial.name}.py").read_text(encoding="utf-8")


def run(paths, out):
    """Run files without a display in one process; return lessons.RESULTS."""
    shared.run("tutorials", ["-W", "error::RuntimeWarning", "-c", RUN, *paths], out)
    return json.loads((out / "results.json").read_text())


# --- running --------------------------------------------------------------------------------------
@A_FEW
def test_tutorial_runs_with_figures_and_its_exercises_unsolved(tutorial, tmp_path):
    results = run([FOLDER / f"{tutorial.name}.py"], tmp_path)
    assert results and not any(results.values())
    assert set(results) == set(syllabus.facts(tutorial).exercises)
    written = [file for file in tmp_path.iterdir() if file.suffix != ".json"]
    assert all(file.name.startswith(tutorial.name[:2] + "_") for file in written)
    figures = sorted(tmp_path.glob("*.png"))
    assert f"{tutorial.name[:2]}_map.png" in {file.name for file in figures}
    assert len(figures) >= 2  # the drawing of the architecture and the tutorial's own
    for file in figures:
        image = iio.imread(file)
        assert image.shape[1] >= 600 and image[..., :3].std() > 5, file.name
    texts = json.loads((tmp_path / "texts.json").read_text())
    shown = {picture.figure for picture in gallery.PICTURES.values()} & texts.keys()
    for name in (*shown, f"{tutorial.name[:2]}_map.png"):
        width = iio.improps(tmp_path / name).shape[1]
        assert texts[name] * WIDTH / width >= LEGIBLE, name


@A_FEW
def test_solution_passes(tutorial, tmp_path):
    results = run([FOLDER / "solutions" / f"{tutorial.name}.py"], tmp_path)
    assert results == dict.fromkeys(syllabus.facts(tutorial).exercises, True)


@pytest.mark.slow
def test_stored_answers_are_those_of_the_solutions():
    """Where it fails, `python -m tests.golden.answers` makes them anew."""
    made, stored = answers.answers(), lessons.stored("answers")
    assert set(made) == set(stored)
    for exercise, answer in made.items():
        assert np.allclose(answer, stored[exercise], rtol=1e-9, atol=0), exercise


@pytest.mark.parametrize("nodes", few([10, 13, 16, 20, 24, 32, 40], 1))
def test_23_3_is_solved_as_its_text_says(nodes, monkeypatch):
    """Eight pieces with 10 to 40 nodes each pass all golden bins."""
    monkeypatch.setattr(lessons, "RESULTS", {})
    (text,) = (source(t, solution=True) for t in TUTORIALS if t.name.startswith("23"))
    assert text.count("roots_legendre(10)") == 1
    exec(text.replace("roots_legendre(10)", f"roots_legendre({nodes})"), {})
    assert lessons.RESULTS["23.3"]


# --- form -----------------------------------------------------------------------------------------
@EACH
def test_headings_and_title(tutorial):
    text = source(tutorial)
    assert form.headings(text) == form.HEADINGS + ["An open project"] * (
        tutorial.name[:2] in ("10", "19", "28")  # the last of each third of the course
    )
    assert re.match(r"# %% \[markdown\]\n# # \S.*\n#\n# \*\*Promise\.\*\* ", text)


@EACH
def test_package_is_imported_where_it_is_needed_and_figures_have_cells_of_their_own(tutorial):
    text = source(tutorial)
    assert re.findall(r"^(?:from|import) p4dgs_ref.*", text.split("# ## Claim")[0], re.M) == [
        "from p4dgs_ref import lessons"
    ]
    drawing = [cell.text for cell in form.cells(text) if "lessons.show(" in cell.text]
    assert drawing and all(map(notebooks.ONLY_DRAWS.match, drawing))  # notebooks collapse them


@EACH
@pytest.mark.parametrize("solution", [False, True], ids=["tutorial", "solution"])
def test_prose_imports_and_functions(tutorial, solution):
    text = source(tutorial, solution)
    assert form.flaws(text) == []
    imported = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module or "")
        elif isinstance(node, ast.FunctionDef):
            assert node.end_lineno - node.lineno < 60
    allowed = {"numpy", "scipy", "matplotlib", "imageio", "p4dgs_ref", "tutorials"}
    assert {name.split(".")[0] for name in imported} <= allowed | sys.stdlib_module_names


@EACH
def test_exercises_are_two_or_three_and_have_solutions(tutorial):
    asked = list(syllabus.facts(tutorial).exercises)
    # A tutorial of three equations has an exercise for each of them and a number.
    most = 4 if len(tutorial.keys) > 2 else 3
    assert asked == [f"{tutorial.name[:2]}.{i + 1}" for i in range(len(asked))]
    assert 2 <= len(asked) <= most
    solved = syllabus.exercises(source(tutorial, solution=True), tutorial.keys)
    assert list(solved) == asked
    section = source(tutorial).split("# ## Exercises\n", 1)[1].split("# ## Check your port", 1)[0]
    assert re.findall(r"^# \*\*(\d\d\.\d)\*\* ●{1,3} \S", section, re.M) == asked


@EACH
def test_answers_do_not_stand_below_their_blanks(tutorial):
    asked = source(tutorial).split("# ## Exercises\n", 1)[1].split("# ## Check your port", 1)[0]
    for exercise, right in re.findall(r'lessons\.check_number\(\s*"([^"]+)", \w+(.*)\)', asked):
        assert exercise in lessons.stored("answers") or exercise in answers.FROM_DATA
        assert not right.removeprefix(", digits=15") or exercise in answers.FROM_DATA


@EACH
def test_checks_of_ports_call_the_package(tutorial):
    """So they print no formula that an exercise asks for."""
    port = ast.parse(source(tutorial).split("# ## Check your port", 1)[1])
    called = {"forward", "backward", "vjp", "rate", "decoded", "render", "loss"}
    checks = ("oracle.check", "lessons.passes", "lessons.caught")
    checked = set()
    for node in ast.walk(port):
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(checks):
            given = [*node.args, *(keyword.value for keyword in node.keywords)]
            checked |= {argument.id for argument in given if isinstance(argument, ast.Name)}
    for function in port.body:
        if isinstance(function, ast.FunctionDef) and function.name in checked:
            calls = {n.attr for n in ast.walk(function) if isinstance(n, ast.Attribute)}
            assert calls & called, function.name


def test_every_exercise_has_two_hints():
    assert set(lessons.stored("hints")) == {
        e for t in TUTORIALS for e in syllabus.facts(t).exercises
    }
    for exercise, hints in lessons.stored("hints").items():
        assert len(hints) == 2
        assert all(hint.endswith((".", "?")) and 20 < len(hint) < 250 for hint in hints), exercise


@EACH
def test_first_cell_links_the_files_of_its_equations(tutorial):
    head = form.cells(source(tutorial))[0].text.strip().replace("\n", " ")
    line = re.search(r"\*\*Files?:\*\* (.*)\.$", head)[1]
    linked = {}
    for number, name, path in re.findall(r"(?:Eq\. \((\d+)\) )?\[([^]]+)\]\(([^)]+)\)", line):
        file = (FOLDER / path).resolve()
        assert file.is_file() and file.name == name, path
        linked[file] = number
    for key in tutorial.keys:
        equation = EQUATIONS[key]
        assert linked[ROOT / f"{equation.module.replace('.', '/')}.py"] == equation.number.rstrip(
            "'"
        )


@EACH
def test_tutorials_named_before_it_come_before_it(tutorial):
    head = source(tutorial).split("\n# %%", 1)[0].split("**Before it:**", 1)[1]
    named = re.findall(r"`(\d\d_\w+)", head)
    assert set(named) <= {t.name for t in TUTORIALS if t.name[:2] < tutorial.name[:2]}


@EACH
def test_port_is_checked_against_the_equations_of_the_tutorial(tutorial):
    section = source(tutorial).split("# ## Check your port\n", 1)[1]
    assert "oracle" in section
    assert [key for key in tutorial.keys if not re.search(rf"\b{key}\b", section)] == []


def test_files_and_table_agree():
    names = [t.name for t in TUTORIALS]
    numbered = FOLDER.glob("[0-9]*.py")  # the others record decisions beyond the paper
    files = {file.stem for file in numbered} - {"00_whole_paper"}  # has its own form
    assert names == sorted(files)
    assert names == sorted(file.stem for file in (FOLDER / "solutions").glob("*.py"))


# --- index and coverage ---------------------------------------------------------------------------
def test_index_is_the_generated_one():
    assert syllabus.index(SECONDS) == INDEX


def test_index_has_measured_times_within_the_limit():
    assert max(SECONDS.values()) < 20


@pytest.mark.parametrize("key", list(EQUATIONS))
def test_every_equation_has_tutorial_vector_and_exercise(key):
    tutorial = tutorial_of(key)
    own = syllabus.facts(tutorial)
    assert subjects()[key]["cases"]
    assert sum(key in t.keys for t in TUTORIALS) == 1
    assert any(key in about for about in own.exercises.values())
    number = EQUATIONS[key].number
    if number:
        assert f"({number.rstrip(chr(39))})" in own.title
    if number and not number.endswith("'"):  # the paper does not print those by analogy
        assert rf"\tag{{{number}" in source(tutorial)


def test_links_of_the_index_lead_somewhere():
    for link in set(re.findall(r"\]\(([^)#]+)\)", INDEX)):
        assert link.startswith("https://") or (FOLDER / link).exists(), link
    for heading in re.findall(r"\]\(#([^)]+)\)", INDEX):
        assert f"\n## {heading.replace('-', ' ').capitalize()}\n" in INDEX, heading


@EACH
def test_first_cell_states_the_measured_minutes(tutorial):
    own = syllabus.facts(tutorial)
    assert (own.reading, own.doing) == syllabus.minutes(tutorial.name)


def test_path_of_four_hours_and_all_hours_are_those_of_the_headers():
    path = [syllabus.facts(t) for t in TUTORIALS if t.name[:2] in syllabus.PATH]
    assert 225 <= sum(own.reading for own in path) <= 265
    assert all(set(own.after) <= set(syllabus.PATH) for own in path)
    own = [syllabus.facts(tutorial) for tutorial in TUTORIALS]
    reading, doing = (
        round(sum(minutes) / 60) for minutes in zip(*((o.reading, o.doing) for o in own))
    )
    for file in (ROOT / "README.md", FOLDER / "README.md"):
        said = " ".join(file.read_text(encoding="utf-8").split())
        assert f"about {reading} hours of reading and {doing} of exercises" in said


@EACH
def test_exercises_end_with_a_question_that_the_solutions_answer(tutorial):
    asked = source(tutorial).split("# ## Exercises\n", 1)[1].split("# ## Check your port", 1)[0]
    prose = form.cells("# %% [markdown]\n" + asked)[0].text
    question = re.split(r"\n\n(?=\*\*)", prose.strip())[-1]
    assert asked.count("**Predict, then run.** ") == 1
    assert question.startswith("**Predict, then run.** ") and "?" in question
    answered, tested = form.cells(source(tutorial, solution=True))[-2:]
    assert answered.text.strip().startswith("**Predict, then run.** ")
    assert not tested.prose and "assert " in "\n".join(tested.lines)


def test_gallery_is_complete_small_and_moves():
    files = {file.name: file.stat().st_size for file in (FOLDER / "pictures").iterdir()}
    assert set(files) == {*gallery.PICTURES, gallery.DRAWING}
    assert sum(files.values()) < 3_000_000
    frames = [len(iio.imread(file)) for file in (FOLDER / "pictures").glob("*.gif")]
    assert len(frames) >= 2 and min(frames) > 10


def test_pictures_are_those_of_the_tutorials_as_they_are():
    """Where it fails, `python -m tutorials.tools.syllabus NUMBER` draws a tutorial's pictures."""
    assert not gallery.stale()


def test_picture_of_changed_code_is_stale(tmp_path, monkeypatch):
    for file in [file for file in FOLDER.glob("*.py") if file.name[0] in "012b"]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.setattr(gallery, "FOLDER", tmp_path)
    monkeypatch.setattr(gallery, "DRAWN", tmp_path / "gallery.json")
    gallery.DRAWN.write_text("{}")
    gallery.record({**gallery.PICTURES, **gallery.DRAW})
    changed = tmp_path / "15_compositing.py"
    text = changed.read_text(encoding="utf-8")
    with_scale = text.replace("# ## Exercises", "scale = 5\n# ## Exercises")
    for other in (text + "\n# another comment\n", text + "\nanswer_4 = ...\n", with_scale):
        assert not gallery.stale()
        changed.write_text(other, encoding="utf-8")
    monkeypatch.setitem(gallery.DRAW, "demo.png", (test_picture_of_changed_code_is_stale,))
    assert gallery.stale() == ["demo.png", "compositing.png"]
