"""The tutorials run, say what is so, and ask what can be solved; every equation has one."""

import ast
import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref import gallery, syllabus
from p4dgs_ref.oracle.vectors import read_manifest
from p4dgs_ref.syllabus import TUTORIALS, tutorial_of
from p4dgs_ref.table import rows
from tests.school import tutorial_form as form

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"
INDEX = (FOLDER / "README.md").read_text(encoding="utf-8")
SHORT_SECONDS, ALL_SHORT_SECONDS = 2, 20
RUN = """
import json, runpy, sys
from p4dgs_ref.school import lessons
for path in sys.argv[2:]:
    runpy.run_path(path, run_name="__main__")
json.dump(lessons.RESULTS, open(sys.argv[1], "w"))
"""


def short():
    """Tutorials that ran in under 4 s when the index was made, the shortest first, as many as 40 s hold."""
    seconds, chosen, total = syllabus.measured_before(), [], 0.0
    for tutorial in sorted(TUTORIALS, key=lambda t: seconds.get(t.number, 1e9)):
        total += seconds.get(tutorial.number, 1e9)
        if seconds.get(tutorial.number, 1e9) < SHORT_SECONDS and total < ALL_SHORT_SECONDS:
            chosen.append(tutorial)
    return chosen


EACH = pytest.mark.parametrize("tutorial", TUTORIALS, ids=[t.name for t in TUTORIALS])
SHORT = {tutorial.name for tutorial in short()}
EACH_RUN = pytest.mark.parametrize(
    "tutorial",
    [
        pytest.param(t, marks=() if t.name in SHORT else pytest.mark.slow, id=t.name)
        for t in TUTORIALS
    ],
)


def source(tutorial, solution=False):
    return (FOLDER / ("solutions" if solution else "") / f"{tutorial.name}.py").read_text(
        encoding="utf-8"
    )


def run(paths, out):
    """Run files headless in one process: what they print, and RESULTS."""
    environment = {
        **os.environ,
        "MPLBACKEND": "Agg",
        "P4DGS_TUTORIALS_OUT": str(out),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
        "PYTHONIOENCODING": "utf-8",
    }
    done = subprocess.run(
        [
            sys.executable,
            "-W",
            "error::RuntimeWarning",
            "-c",
            RUN,
            str(out / "results.json"),
            *map(str, paths),
        ],
        env=environment,
        cwd=out,
        capture_output=True,
        text=True,
        encoding="utf-8",
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout, json.loads((out / "results.json").read_text())


# --- running ------------------------------------------------------------------------------------------------------
@EACH_RUN
def test_tutorial_runs_headless_with_figures_and_its_exercises_unsolved(tutorial, tmp_path):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _, results = run([FOLDER / f"{tutorial.name}.py"], tmp_path)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 20
    assert results and not any(results.values())
    assert set(results) == set(syllabus.facts(tutorial).exercises)
    figures = sorted(tmp_path.glob("*.png"))
    assert figures and all(
        file.name.startswith(tutorial.number + "_")
        for file in tmp_path.iterdir()
        if file.suffix != ".json"
    )
    for file in figures:
        image = iio.imread(file)
        assert image.shape[1] >= 600 and image[..., :3].std() > 5, file.name


def test_all_solutions_pass(tmp_path):
    out, results = run(
        [FOLDER / "solutions" / f"{tutorial.name}.py" for tutorial in TUTORIALS], tmp_path
    )
    asked = [exercise for tutorial in TUTORIALS for exercise in syllabus.facts(tutorial).exercises]
    assert [exercise for exercise in asked if results.get(exercise) is not True] == [], out
    assert sorted(results) == sorted(asked)


@pytest.mark.slow
@EACH
def test_solution_runs_alone(tutorial, tmp_path):
    _, results = run([FOLDER / "solutions" / f"{tutorial.name}.py"], tmp_path)
    assert results and all(results.values())


# --- form ---------------------------------------------------------------------------------------------------------
@EACH
def test_headings_and_first_cell(tutorial):
    text = source(tutorial)
    assert form.headings(text) == form.HEADINGS
    assert re.match(r"# %% \[markdown\]\n# # \S.*\n#\n# \*\*Promise\.\*\* ", text)
    assert (
        "**Before it:**" in text.split("\n# %%", 1)[0] and "**Takes**" in text.split("\n# %%", 1)[0]
    )
    assert len(text.splitlines()) <= 300


@EACH
@pytest.mark.parametrize("solution", [False, True], ids=["tutorial", "solution"])
def test_prose_is_short(tutorial, solution):
    assert form.long_cells(source(tutorial, solution)) == []


@EACH
def test_every_number_in_prose_is_asserted_by_the_cell_under_it(tutorial):
    assert form.unasserted(source(tutorial)) == []


@EACH
def test_imports_paths_and_functions(tutorial):
    for text in (source(tutorial), source(tutorial, solution=True)):
        tree = ast.parse(text)
        imported = {
            (node.module or "") if isinstance(node, ast.ImportFrom) else alias.name
            for node in ast.walk(tree)
            if isinstance(node, (ast.Import, ast.ImportFrom))
            for alias in node.names
        }
        allowed = {"numpy", "scipy", "matplotlib", "imageio", "p4dgs_ref", *sys.stdlib_module_names}
        assert {name.split(".")[0] for name in imported} <= allowed
        assert not re.search(
            r"""["'(\s](/(tmp|home|work|usr|root|Users|opt|mnt)\b|[A-Z]:\\)""", text
        )
        assert all(
            node.end_lineno - node.lineno < 60
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
        )


@EACH
def test_exercises_are_two_or_three_and_have_solutions(tutorial):
    asked = list(syllabus.facts(tutorial).exercises)
    most = (
        4 if len(tutorial.keys) > 2 else 3
    )  # three equations in one tutorial: one exercise each and a number
    assert (
        asked == [f"{tutorial.number}.{i + 1}" for i in range(len(asked))]
        and 2 <= len(asked) <= most
    )
    assert list(syllabus.exercises(source(tutorial, solution=True), tutorial.keys)) == asked
    section = source(tutorial).split("# ## Exercises\n", 1)[1].split("# ## Check your port", 1)[0]
    assert re.findall(r"\*\*(\d\d\.\d)\*\*", section) == asked


@EACH
def test_figures_are_shown_under_the_tutorials_number(tutorial):
    shown = re.findall(r'lessons\.show\(\w+, f?"([^"]+)"\)', source(tutorial))
    assert (
        shown
        and len(set(shown)) == len(shown)
        and all(name.startswith(tutorial.number + "_") for name in shown)
    )


@EACH
def test_tutorials_named_before_it_come_before_it(tutorial):
    head = source(tutorial).split("\n# %%", 1)[0].split("**Before it:**", 1)[1]
    named = re.findall(r"`(\d\d_\w+)", head)
    assert set(named) <= {t.name for t in TUTORIALS if t.number < tutorial.number}


@EACH
def test_port_is_checked_against_the_equations_of_the_tutorial(tutorial):
    section = source(tutorial).split("# ## Check your port\n", 1)[1]
    assert "oracle" in section
    assert [key for key in tutorial.keys if not re.search(rf"\b{key}\b", section)] == []


def test_files_and_table_agree():
    assert [t.name for t in TUTORIALS] == sorted(file.stem for file in FOLDER.glob("*.py"))
    assert [t.name for t in TUTORIALS] == sorted(
        file.stem for file in (FOLDER / "solutions").glob("*.py")
    )


# --- the checker of the form must fail where the form is broken ---------------------------------------------------
SAMPLE = """# %% [markdown]
# # Eq. (1): a sample of 3DGS
#
# Two numbers, 2.5 and 1,024, of Eqs. (3) and (4), for $x = 7$ and `y = 8`, in float32; exercise **01.2**; section 3.2.

# %%
assert 2.5 * 2 == 5 and 1_024 == 2**10

# %% [markdown]
# ## Claim
# It is 0.63 at t = 12.
# $$9 + 9 \\\\tag{5}$$

# %% [markdown]
# 1. Kerbl et al. 2023 say 77.

# %%
x = 12
assert f"{0.631:.2f}" == "0.63"
"""


def test_checker_finds_numbers_that_nothing_asserts():
    assert form.unasserted(SAMPLE) == ["line 9: 12", "line 14: 77"]
    assert form.unasserted(SAMPLE.replace("x = 12\n", "assert 12 < 77\n")) == []
    assert form.unasserted(SAMPLE.replace("2.5 * 2", "2.4 * 2")) == [
        "line 1: 2.5",
        "line 9: 12",
        "line 14: 77",
    ]
    assert form.unasserted(SAMPLE.replace("1_024", "1_025")) == [
        "line 1: 1,024",
        "line 9: 12",
        "line 14: 77",
    ]
    assert form.unasserted(SAMPLE.replace('"0.63"', '"0.64"')) == [
        "line 9: 0.63",
        "line 9: 12",
        "line 14: 77",
    ]


@pytest.mark.parametrize(
    "text, found",
    [
        ("from 3 to 4.5e-3, 10 % and -7", ["3", "4.5e-3", "10", "7"]),
        ("P-4DGS, 3DGS, L1, Q24, int64, 2D, H-R4", []),
        ("Eq. (11), Eqs. (3), (4) and (5), (3')", []),
        ("tutorial 13, tutorials 02 and 03, `13_covariance`", []),
        ("**01.2** Do. Exercise 01.3 too, with 1.3", ["1.3"]),
        ("the (4, 3) array", ["4", "3"]),
        ("2. item", []),
        ("Fig. 2", []),
        ("Stages 1 to 3; stage 4 is 7", ["7"]),
        ("**4: a needle.** of 3", ["3"]),
        ("step 4", ["4"]),
        ("16x16, 16 x 16", ["16", "16"]),
    ],
)
def test_checker_tells_numbers_from_names(text, found):
    assert form.numbers(text) == found


def test_checker_finds_headings_length_and_width():
    assert form.headings(SAMPLE) == ["Claim"] != form.HEADINGS
    assert form.long_cells(SAMPLE) == []
    longer = SAMPLE.replace("# It is 0.63", "# a\n# b\n# c\n#\n# It is 0.63")
    assert form.long_cells(longer) == ["line 9: 5 lines of prose, at most 4"]
    assert form.long_cells(SAMPLE.replace("# It is", "# It is " + "very " * 25)) == [
        "line 11: 149 characters, at most 130"
    ]
    assert form.long_cells(SAMPLE.replace("# It is", "It is")) == [
        "line 11: code in a cell of prose"
    ]


# --- index and coverage -------------------------------------------------------------------------------------------
def test_index_is_the_generated_one():
    assert syllabus.index(syllabus.measured_before()) == INDEX


def test_index_has_measured_times_within_the_limit():
    seconds = syllabus.measured_before()
    assert set(seconds) == {t.number for t in TUTORIALS} and max(seconds.values()) < 20


def test_index_gives_every_equation_in_the_order_of_the_table():
    table = syllabus.equations_table().splitlines()[2:]
    for line, row in zip(table, rows(), strict=True):
        number, key, file, vector, tutorial, exercises = (
            cell.strip() for cell in line.strip("|").split("|")
        )
        assert (number, key) == (row["number"], f"`{row['key']}`") and row["file"] in file
        for link in re.findall(r"\]\(([^)]+)\)", line):
            assert (FOLDER / link).resolve().is_file(), link
    assert syllabus.equations_table() in INDEX


@pytest.mark.parametrize("key", [row["key"] for row in rows()])
def test_every_equation_has_tutorial_vector_and_exercise(key):
    number, tutorial = next(row["number"] for row in rows() if row["key"] == key), tutorial_of(key)
    assert any(s["key"] == key and s["cases"] for s in read_manifest()["subjects"])
    assert sum(key in t.keys for t in TUTORIALS) == 1
    assert [
        exercise for exercise, about in syllabus.facts(tutorial).exercises.items() if key in about
    ]
    if number:
        digits = number.rstrip("'")
        assert f"({digits})" in syllabus.facts(tutorial).title
        assert number != digits or rf"\tag{{{number}" in source(
            tutorial
        )  # those by analogy are not printed


def test_links_of_the_index_lead_somewhere():
    for link in re.findall(r"\]\(([^)#]+)\)", INDEX):
        assert link.startswith("https://") or (FOLDER / link).exists(), link


def test_gallery_is_complete_small_and_moves():
    files = {file.name: file.stat().st_size for file in (FOLDER / "pictures").iterdir()}
    assert (
        set(files) == set(gallery.PICTURES) and sum(files.values()) < gallery.LARGEST == 1_500_000
    )
    moving = [name for name in files if name.endswith(".gif")]
    assert len(moving) >= 2 and all(
        len(iio.imread(FOLDER / "pictures" / name)) > 10 for name in moving
    )
    assert all(f"pictures/{name}" in INDEX for name in files)


def test_pictures_are_made_small_and_keep_what_they_show(tmp_path):
    rng = np.random.default_rng(1)
    image = np.repeat(np.repeat(rng.integers(0, 256, (9, 16, 3), dtype=np.uint8), 100, 0), 100, 1)
    iio.imwrite(tmp_path / "large.png", image)
    gallery.picture(tmp_path / "large.png", tmp_path / "small.png")
    small = iio.imread(tmp_path / "small.png")
    assert small.shape == (360, gallery.WIDTH, 3)
    assert np.array_equal(small[20::40, 20::40], image[50::100, 50::100])  # centres of the patches
    assert np.allclose(gallery.shares(7, 3).sum(axis=1), 1) and np.allclose(
        gallery.shares(7, 3).sum(axis=0), 3 / 7
    )


def test_animations_with_repeated_pixels_are_halved(tmp_path):
    frames = np.zeros((11, 8, 12, 3), np.uint8)
    frames[np.arange(11), :, np.arange(11)] = 255
    for name, given, shape in (
        ("fine", frames, (8, 12)),
        ("coarse", frames.repeat(2, 1).repeat(2, 2), (8, 12)),
    ):
        iio.imwrite(tmp_path / f"{name}.gif", given, extension=".gif", duration=70, loop=0)
        gallery.animation(tmp_path / f"{name}.gif", tmp_path / f"{name}_small.gif")
        made = iio.imread(tmp_path / f"{name}_small.gif")
        assert made.shape[:3] == (11, *shape) and np.array_equal(made > 127, frames > 127)


def test_gallery_that_grows_too_large_is_refused(tmp_path, monkeypatch):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "old.png").write_bytes(b"x" * 900)
    (tmp_path / "comparison.png").write_bytes(b"x" * 200)
    monkeypatch.setattr(gallery, "LARGEST", 1000)
    with pytest.raises(ValueError, match="at most 1,000 bytes of pictures, got 1,100"):
        gallery.take(tmp_path, tmp_path / "pictures")
    assert [file.name for file in (tmp_path / "pictures").iterdir()] == ["old.png"]


def test_unknown_tutorial_is_refused():
    with pytest.raises(SystemExit, match="expected numbers of tutorials"):
        syllabus.main(["28"])
