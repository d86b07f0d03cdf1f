"""The paper in ten pictures: each has its section, and can be drawn again."""

import re

import imageio.v3 as iio
import pytest

from p4dgs_ref.report import figures
from tests.sampling import few
from tutorials.tools import tour
from tutorials.tools.figures import STYLE
from tutorials.tools.shared import FOLDER

_, *SECTIONS = (FOLDER / "tour.md").read_text(encoding="utf-8").split("\n## ")


def test_every_picture_has_its_section():
    for number, (title, section) in enumerate(zip(tour.PICTURES, SECTIONS), 1):
        heading, image, _ = section.split("\n\n", 2)
        assert heading == title.replace("  ", ". ") and f"](tour/{number:02d}.png)" in image


@pytest.mark.parametrize("title", few(tour.PICTURES, 1, 3))
def test_a_picture_can_be_drawn(title):
    """`python -m tutorials.tools.syllabus tour` draws all of them again."""
    with figures.figure_style(STYLE):
        tour.page(title).draw_without_rendering()


def test_every_picture_has_a_question_before_its_text_and_its_answer_is_hidden():
    for section in SECTIONS[:10]:
        question = section.split("\n\n")[2]
        assert question.startswith("**Question.**") and question.endswith("?"), section[:20]
        assert section.count("<details><summary>Answer</summary>\n\n") == 1, section[:20]


@pytest.mark.parametrize("name", ["bin", "noise"])
def test_moving_pictures_are_small(name):
    data = (tour.PLACE / f"{name}.gif").read_bytes()
    assert len(data) <= 300_000 and len(iio.imread(data, extension=".gif")) > 20


def test_slides_have_ten_pages():
    assert len(re.findall(rb"/Type /Page\b", (FOLDER / "tour.pdf").read_bytes())) == 10
