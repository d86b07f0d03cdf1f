"""The gradient of the whole pipeline, from the loss to every array of parameters.

It is compared with finite differences in stages 1 to 4 of training.
"""

import pytest

from tests.training.whole_gradient import check, setting

STAGES_1_AND_2 = {"psi_d", "psi_p", "psi_q", "grid"}
RESTS, MOVES = ("occlusion", "background"), ("translation", "view_color", "background")
TURNS = ("rotation", "scaling", "occlusion", "view_geometry")
# name: (arguments of `setting`, the arrays without a gradient)
SETTINGS = {
    "stage 4": ({}, set()),
    "nothing moves": (dict(effects=RESTS, seed=1), set()),
    "stage 1": (dict(stage=1), STAGES_1_AND_2),
    "stage 3": (dict(stage=3), {"psi_p", "psi_q", "grid"}),
    "few effects": (dict(effects=MOVES, seed=1), set()),
    "turning": (dict(effects=TURNS, seed=1), set()),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_every_array_has_its_gradient(name, monkeypatch):
    arguments, without_gradient = SETTINGS[name]
    p, *others = setting(**arguments)
    names = check(p, *others, monkeypatch=monkeypatch)
    stems, with_gradient = ({name.split(".")[0] for name in some} for some in (p.arrays, names))
    assert stems - with_gradient == without_gradient
    assert ("psi_d" in stems) == (name != "nothing moves")
