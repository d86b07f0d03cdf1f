"""The paper in ten pictures: each has its section, and can be drawn again."""

import re

import pytest

from p4dgs_ref.report import figures, view
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


def test_slides_have_ten_pages():
    assert len(re.findall(rb"/Type /Page\b", (FOLDER / "tour.pdf").read_bytes())) == 10


def test_parts_of_a_file_have_the_same_colours_in_the_viewer():
    page = (view.VIEWER / "page.html").read_text(encoding="utf-8")
    in_viewer = re.findall(r'\[data-part="(\w+)"\] \{ background-color: (#\w{6});', page)
    in_tour = {name: color.lower() for name, (_, color) in tour.SECTIONS.items()}
    assert dict(in_viewer) == in_tour, "picture 9 of the tour and the strip of step 8 differ"
