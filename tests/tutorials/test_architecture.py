"""The drawing of the architecture: complete, legible, and the same for every run."""

from matplotlib.patches import FancyBboxPatch

from p4dgs_ref.lessons import TUTORIALS
from p4dgs_ref.splatting.table import EQUATIONS
from tests.tutorials import drawn
from tutorials.tools import architecture

BOXES = [box for frame in architecture.FRAMES for box in frame.boxes]
BEYOND_THE_TABLE = {"entropy_coder", "file"}


def test_every_equation_has_one_box_with_its_number():
    keys = [box.key for box in BOXES]
    assert len(keys) == len(set(keys))
    assert set(keys) == {*EQUATIONS, *BEYOND_THE_TABLE}
    for box in BOXES:
        number = EQUATIONS[box.key].number if box.key in EQUATIONS else ""
        assert box.number == (f"({number.rstrip(chr(39))})" if number else ""), box.key


def test_lit_boxes_stand_out_and_the_others_are_grey():
    figure = architecture.draw_method(("step", "file"))
    dark = {
        text.get_text() for text in figure.axes[0].texts if text.get_color() == architecture.INK
    }
    frames = {text for text in dark if text in {frame.title for frame in architecture.FRAMES}}
    assert {"step $q$", "10110…"} <= dark
    assert {box.text for box in BOXES} & dark == {"step $q$", "10110…"}
    assert frames == {"context", "file"}
    boxes = figure.axes[0].findobj(FancyBboxPatch)
    assert sum(box.get_linewidth() > 1 for box in boxes) == 2


def test_the_file_is_the_same_whatever_was_drawn_before(tmp_path):
    architecture.save(tmp_path / "a.png")
    with drawn.with_other_settings():
        architecture.save(tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_each_tutorial_lights_known_boxes():
    keys = {box.key for box in BOXES}
    without_keys = {tutorial.name for tutorial in TUTORIALS if not tutorial.keys}
    for name, lit in architecture.LIT.items():
        assert set(lit) <= keys, name
    whole = {"16_pipeline_by_hand", "26_video_codec_analogy"}
    assert without_keys == {*architecture.LIT, *whole}
