"""The drawing of the architecture: complete, legible, and the same for every run."""

import numpy as np
import pytest
from matplotlib.patches import FancyBboxPatch

from p4dgs_ref.lessons import TUTORIALS
from p4dgs_ref.table import EQUATIONS
from tests.tutorials.drawn import overlaps
from tutorials.tools import architecture

BOXES = [box for frame in architecture.FRAMES for box in frame.boxes]
BEYOND_THE_TABLE = {"entropy_coder", "file"}


@pytest.fixture(scope="module")
def drawn():
    """The drawing, all its texts with their extents, and the extents of its boxes."""
    figure = architecture.draw()
    figure.canvas.draw()
    (axes,) = figure.axes
    texts = {text: extents(text) for text in axes.texts if text.get_text()}
    boxes = [extents(patch) for patch in axes.findobj(FancyBboxPatch)]
    return figure, texts, boxes


def extents(artist):
    """Left, bottom, right, top in pixels."""
    return artist.get_window_extent().extents


def apart(a, b, gap=0.0):
    """Whether two rectangles have at least `gap` pixels between them."""
    return bool(max(np.max(a[:2] - b[2:]), np.max(b[:2] - a[2:])) >= gap)


def inside(a, b):
    """Whether rectangle a lies within rectangle b."""
    return bool(np.all(a[:2] >= b[:2]) and np.all(a[2:] <= b[2:]))


def test_every_equation_has_one_box_with_its_number():
    keys = [box.key for box in BOXES]
    assert len(keys) == len(set(keys))
    assert set(keys) == {*EQUATIONS, *BEYOND_THE_TABLE}
    for box in BOXES:
        number = EQUATIONS[box.key].number if box.key in EQUATIONS else ""
        assert box.number == (f"({number.rstrip(chr(39))})" if number else ""), box.key


def test_texts_stay_within_the_drawing_and_do_not_overlap(drawn):
    figure, texts, _ = drawn
    for text, place in texts.items():
        assert inside(place, figure.bbox.extents), text.get_text()
    assert overlaps(figure) == []


def test_texts_lie_within_one_box_or_outside_all(drawn):
    _, texts, boxes = drawn
    for text, place in texts.items():
        for box in boxes:
            assert inside(place, box) or apart(place, box), text.get_text()


def test_arrows_begin_and_end_at_boxes_icons_or_their_names(drawn):
    figure, texts, boxes = drawn
    transform = figure.axes[0].transData.transform
    icons = []
    for icon in architecture.ICONS:
        corners = [[icon.x - 4.2, icon.y - 4.2], [icon.x + 4.2, icon.y + 4.2]]
        icons.append(np.concatenate(transform(corners)))
        icons += [place for text, place in texts.items() if text.get_text() == icon.text]
    for arrow in architecture.ARROWS:
        for point in transform([arrow.points[0], arrow.points[-1]]):
            spot = np.concatenate([point, point])
            assert not all(apart(spot, place, 8.0) for place in (*boxes, *icons)), (arrow, point)


def test_arrows_run_between_the_boxes_and_beside_the_texts(drawn):
    figure, texts, boxes = drawn
    transform = figure.axes[0].transData.transform
    for arrow in architecture.ARROWS:
        corners = transform(arrow.points)
        for a, b in zip(corners, corners[1:]):
            stretch = np.concatenate([np.minimum(a, b), np.maximum(a, b)])
            for text, place in texts.items():
                # a pixel of tolerance: versions of matplotlib measure letters differently
                assert apart(stretch, place, -1.0), (arrow, text.get_text())
            for box in boxes:
                assert apart(stretch, box, -2.0), arrow


def test_lit_boxes_stand_out_and_the_others_are_grey():
    figure = architecture.draw(("step", "file"))
    dark = {
        text.get_text() for text in figure.axes[0].texts if text.get_color() == architecture.INK
    }
    frames = {text for text in dark if text in {frame.title for frame in architecture.FRAMES}}
    assert {"step $q$", "10110…"} <= dark
    assert {box.text for box in BOXES} & dark == {"step $q$", "10110…"}
    assert frames == {"context", "file"}
    thick = [p for p in figure.axes[0].findobj(FancyBboxPatch) if p.get_linewidth() > 1]
    assert len(thick) == 2


def test_each_tutorial_lights_known_boxes():
    keys = {box.key for box in BOXES}
    without_keys = {tutorial.name for tutorial in TUTORIALS if not tutorial.keys}
    for name, lit in architecture.LIT.items():
        assert set(lit) <= keys, name
    whole = {"16_pipeline_by_hand", "26_video_codec_analogy"}
    assert without_keys == {*architecture.LIT, *whole}
