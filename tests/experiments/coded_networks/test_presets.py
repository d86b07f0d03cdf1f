"""The presets that are ours, how they become the paper's, and the page of version 2."""

from dataclasses import fields

import pytest

from p4dgs_ref import designs
from p4dgs_ref.beyond import presets
from p4dgs_ref.beyond.__main__ import page
from p4dgs_ref.designs import PRESETS, beyond, choose, is_ours, paper_preset
from p4dgs_ref.training.presets import TINY, Preset

OFF = {"is_coded": False, "position_bits": 16, "body": False}


def test_a_preset_is_ours_where_something_of_it_is():
    assert {name for name, preset in PRESETS.items() if is_ours(preset)} == {*presets.PRESETS}
    assert type(choose("tiny", {"body": "true"})) is presets.Preset
    assert type(choose("tiny", {"body": "false"})) is type(choose("tiny_coded", OFF)) is Preset
    assert [what[-4:] for what in beyond(PRESETS["tiny_coded"])] == ["(B1)", "(B2)", "(B3)"]
    assert beyond(TINY) == [] and paper_preset(TINY) is TINY
    names = [designs.paper_name(preset) for preset in (*PRESETS.values(), choose("tiny", {"k": 1}))]
    assert dict(zip([*PRESETS, "single"], names)) == {
        **dict.fromkeys(PRESETS, "the paper's design"),
        **dict.fromkeys(("small_coded", "single"), "the paper's design with k = 1"),
    }


def test_positions_of_few_bits_need_coded_networks():
    with pytest.raises(ValueError, match="field 'position_bits': expected 16"):
        choose("tiny", {"position_bits": 10})


def test_the_design_is_the_paper_s_where_nothing_is_coded():
    only_body = choose("smoke", {"body": True})
    design = designs.trainer_class(only_body).design_of(only_body, ("occlusion",))
    assert "position_bits" not in {field.name for field in fields(design)}
    assert designs.trainer_class(TINY) is not designs.trainer_class(only_body)


def test_the_page_has_what_differs_alone():
    for text in ("0E 09 9B F7", "04 BA 05", "60 10 50 11", '"tiny": {"background"'):
        assert text in page()
    assert "Elias" not in page().replace("gamma code of `streams.py`", "")
