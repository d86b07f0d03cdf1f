"""The pages about the tutorials: made from what the code says today, and their links lead on."""

import re

import pytest

from p4dgs_ref import EQUATIONS
from p4dgs_ref.lessons import TUTORIALS
from tests.tutorials import drawn
from tutorials.tools import architecture, glossary, handout, syllabus
from tutorials.tools.shared import FOLDER

PAGES = [*FOLDER.glob("*.md"), *FOLDER.glob("*.py"), *FOLDER.glob("notebooks/*.ipynb")]
BOXES = {box.key for frame in architecture.FRAMES for box in frame.boxes}


def text_of(name):
    return (FOLDER / name).read_text(encoding="utf-8")


def test_index_and_glossary_are_those_that_the_command_writes():
    """Where it fails, `python -m tutorials.tools.syllabus index` writes them."""
    assert syllabus.index() == text_of("README.md")
    assert glossary.glossary() == text_of("glossary.md")


def test_links_lead_somewhere():
    for page in PAGES:
        for link in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists() or "\\" in link, f"{page.name}: {link}"


def test_links_into_the_viewer_name_a_step_of_its_guided_way():
    page = text_of("viewer/demo.html")
    linked = {
        step
        for file in PAGES
        for step in re.findall(r"demo\.html#([\w=]+)", file.read_text("utf-8"))
    }
    steps = re.findall(r'<article data-steps="(\w+)"', page)
    assert linked <= {f"step={step}" for step in steps} and len(linked) > 4


def test_every_symbol_has_a_meaning_and_every_axis_a_letter():
    rows = [line.split(" | ") for line in text_of("glossary.md").splitlines() if " | `" in line]
    assert {row[1].strip("`") for row in rows} == set(glossary.mentions())
    assert {symbol.name for symbol in glossary.SYMBOLS} <= set(glossary.mentions())
    for row in rows:
        assert len(row[2].strip()) > 2 and "](../p4dgs_ref/" in row[-1], row
    letters = set(re.findall(r"[A-Za-z_]\w*", " ".join(row[3] for row in rows)))
    assert letters - {"list", "of", *glossary.AXES} <= set(glossary.mentions())


def test_all_equations_of_the_paper_are_drawn_and_on_the_handout():
    printed = {architecture.number_of(key) for key in EQUATIONS} - {""}
    assert printed == {"(3')", *(f"({i})" for i in range(1, 18))}
    for keys in (BOXES, {row.key for row in handout.ROWS}):
        assert printed == {architecture.number_of(key) for key in keys} - {""}


def test_tutorials_light_boxes_of_the_drawing():
    for tutorial in TUTORIALS:
        (call,) = re.findall(
            r"^architecture\.show\((.*?)\)$", text_of(f"{tutorial.name}.py"), re.M | re.S
        )
        name, *keys = re.findall(r'"(\w+)"', call)
        assert name == tutorial.name and not (keys and tutorial.keys) and set(keys) <= BOXES


@pytest.mark.slow
@pytest.mark.parametrize("save", [architecture.save, handout.save])
def test_drawings_are_the_same_in_every_program(save, tmp_path):
    ending = "png" if save is architecture.save else "pdf"
    save(tmp_path / f"a.{ending}")
    with drawn.with_other_settings():
        save(tmp_path / f"b.{ending}")
    assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()
