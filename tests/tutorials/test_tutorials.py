"""The tutorials run, have the form that they share, and explain every equation."""

import json
import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref import lessons
from p4dgs_ref.lab import effect_ledger, stability
from p4dgs_ref.lab.accuracy import answers, verdicts
from p4dgs_ref.lessons import TUTORIALS, tutorial_of
from p4dgs_ref.oracle.published import subjects
from p4dgs_ref.splatting.table import EQUATIONS
from tests.golden import answers as solved
from tests.tutorials import drawn
from tests.tutorials import tutorial_form as form
from tutorials.tools import gallery, notebooks, records, shared, syllabus

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"
INDEX = (FOLDER / "README.md").read_text(encoding="utf-8")
RUN = """
import json, runpy, sys
from p4dgs_ref import lessons
for path in sys.argv[1:]:
    runpy.run_path(path, run_name="__main__")
json.dump(lessons.RESULTS, open("results.json", "w"))
"""


EACH = pytest.mark.parametrize("tutorial", TUTORIALS, ids=[t.name for t in TUTORIALS])
SECONDS = syllabus.measured_before()


def source(tutorial, solution=False):
    folder = FOLDER / "solutions" if solution else FOLDER
    return (folder / f"{tutorial.name}.py").read_text(encoding="utf-8")


def run(paths, out):
    """Run files without a display in one process; return lessons.RESULTS."""
    shared.run("tutorials", ["-W", "error::RuntimeWarning", "-c", RUN, *paths], out)
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


# --- running --------------------------------------------------------------------------------------
@pytest.mark.slow
@EACH
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


@pytest.mark.slow
@EACH
def test_solution_passes(tutorial, tmp_path):
    results = run([FOLDER / "solutions" / f"{tutorial.name}.py"], tmp_path)
    assert results == dict.fromkeys(syllabus.facts(tutorial).exercises, True)


@pytest.mark.slow
def test_stored_answers_are_those_of_the_solutions():
    """Where it fails, `python -m tests.golden.answers` makes them anew."""
    made, stored = solved.answers(), lessons.stored("answers")
    assert set(made) == set(stored)
    for exercise, answer in made.items():
        assert np.allclose(answer, stored[exercise], rtol=1e-9, atol=0), exercise


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
def test_prose_is_in_comments(tutorial, solution):
    assert form.flaws(source(tutorial, solution)) == []


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
        assert exercise in lessons.stored("answers") or exercise in solved.FROM_DATA
        assert not right.removeprefix(", digits=15") or exercise in solved.FROM_DATA


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
        assert linked[ROOT / f"{equation.module.__name__.replace('.', '/')}.py"] == equation.number.rstrip(
            "'"
        )


def test_files_and_table_agree():
    names = [t.name for t in TUTORIALS]
    numbered = FOLDER.glob("[0-9]*.py")  # the others record decisions beyond the paper
    files = {file.stem for file in numbered} - {"00_whole_paper"}  # has its own form
    assert names == sorted(files)
    assert names == sorted(file.stem for file in (FOLDER / "solutions").glob("*.py"))


# --- index and coverage ---------------------------------------------------------------------------
def test_index_is_the_generated_one_with_times_within_the_limit():
    assert syllabus.index(SECONDS) == INDEX
    assert max(SECONDS.values()) < 20


@pytest.mark.parametrize("key", list(EQUATIONS))
def test_every_equation_has_tutorial_vector_and_exercise(key):
    tutorial = tutorial_of(key)
    facts = syllabus.facts(tutorial)
    assert subjects()[key]["cases"]
    assert sum(key in t.keys for t in TUTORIALS) == 1
    assert any(key in about for about in facts.exercises.values())
    number = EQUATIONS[key].number
    if number:
        assert f"({number.rstrip(chr(39))})" in facts.title
    if number and not number.endswith("'"):  # the paper does not print those by analogy
        assert rf"\tag{{{number}" in source(tutorial)


def test_links_of_the_index_lead_somewhere():
    for link in set(re.findall(r"\]\(([^)#]+)\)", INDEX)):
        assert link.startswith("https://") or (FOLDER / link).exists(), link
    for heading in re.findall(r"\]\(#([^)]+)\)", INDEX):
        assert f"\n## {heading.replace('-', ' ').capitalize()}\n" in INDEX, heading


def test_links_into_the_viewer_name_a_step_of_its_guided_way():
    linked = re.findall(r"viewer/demo\.html#([^)]*)", "".join(map(source, TUTORIALS)))
    assert len(linked) >= 8
    assert set(linked) <= {f"step={n}" for n in range(1, 9)}


@EACH
def test_first_cell_states_the_measured_minutes(tutorial):
    facts = syllabus.facts(tutorial)
    assert (facts.reading, facts.doing) == syllabus.minutes(tutorial.name)


def test_all_hours_are_those_of_the_headers():
    facts = [syllabus.facts(tutorial) for tutorial in TUTORIALS]
    reading, doing = (round(sum(f[i] for f in facts) / 60) for i in (2, 3))
    for file in (ROOT / "README.md", FOLDER / "README.md"):
        text = " ".join(file.read_text(encoding="utf-8").split())
        assert f"about {reading} hours of reading and {doing} of exercises" in text
    every = (ROOT / "README.md", FOLDER / "README.md", FOLDER / "reference.md")
    counts = {
        re.search(r"(\d+)\]?\s+\[?tutorials", f.read_text(encoding="utf-8"))[1] for f in every
    }
    assert counts == {str(len(TUTORIALS))}


@pytest.mark.parametrize("path", syllabus.PATHS.values())
def test_paths_are_complete_and_the_front_page_has_their_minutes(path):
    of = {tutorial.name[:2]: syllabus.facts(tutorial) for tutorial in TUTORIALS}
    assert [n for n in path if not set(of[n].after) <= set(path[: path.index(n)])] == []
    said = f"{', '.join(path)} ({sum(of[n].reading for n in path)} minutes)"
    assert said in " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())


@EACH
def test_exercises_end_with_a_question_that_the_solutions_answer(tutorial):
    asked = source(tutorial).split("# ## Exercises\n", 1)[1].split("# ## Check your port", 1)[0]
    assert asked.count("**Predict, then run.** ") == 1
    answered, tested = form.cells(source(tutorial, solution=True))[-2:]
    assert answered.text.strip().startswith("**Predict, then run.** ")
    assert not tested.prose and "assert " in "\n".join(tested.lines)


def test_gallery_is_complete_small_and_moves():
    files = {file.name: file.stat().st_size for file in (FOLDER / "pictures").iterdir()}
    assert set(files) == {*gallery.PICTURES, gallery.DRAWING}
    assert sum(files.values()) < 2_700_000
    frames = [len(iio.imread(file)) for file in (FOLDER / "pictures").glob("*.gif")]
    assert len(frames) >= 2 and min(frames) > 10


FRONT = {
    answers: lambda path: answers.draw_front(path, verdicts.read(gallery.ACCURACY)),
    stability: stability.draw_front,
    effect_ledger: lambda path: effect_ledger.draw_ledger(
        path, effect_ledger.summaries(records.rows("effects"))
    ),
}


@pytest.mark.parametrize("drawing", FRONT)
def test_pictures_beside_each_other_can_be_read_at_a_third_of_their_width(drawing, monkeypatch):
    figures = []
    monkeypatch.setattr(drawing, "save_figure", lambda figure, path: figures.append(figure))
    FRONT[drawing](None)
    (figure,) = figures
    assert drawn.overlaps(figure) == []
    assert figure.get_size_inches()[0] * figure.dpi == 3 * 280 and drawn.smallest(figure) > 3 * 8


def test_pictures_in_few_colours_keep_white_and_what_is_rare(tmp_path):
    file, pixels = tmp_path / "all.png", np.full((96, 64, 3), 255, np.uint8)
    colors = np.random.default_rng(0).integers(0, 200, (64, 1, 3))
    pixels[:64] = np.rint(255 - (255 - colors) * np.linspace(0, 1, 64)[:, None])
    pixels[0, 0] = 255, 0, 0
    iio.imwrite(file, pixels)
    shown = iio.imread(gallery.in_few_bytes(file)).astype(int)
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) <= 256
    assert np.abs(shown - pixels).max() < 30 and (shown[64:] == 255).all()


def test_pictures_are_those_of_the_tutorials_as_they_are():
    """Where it fails, `python -m tutorials.tools.syllabus NUMBER` draws a tutorial's pictures."""
    assert not gallery.stale()


def test_picture_of_changed_code_is_stale(monkeypatch):
    source = (FOLDER / "15_compositing.py").read_text(encoding="utf-8")
    with_scale = source.replace("# ## Exercises", "scale = 5\n# ## Exercises")
    before = gallery.code_hash("compositing.png")
    changed = {}
    for text in (source + "\nanswer_4 = ...\n", "# a comment\n" + source, with_scale):
        monkeypatch.setattr(Path, "read_text", lambda path, text=text, **_: text)
        changed[text] = gallery.code_hash("compositing.png") != before
    assert list(changed.values()) == [False, False, True]
