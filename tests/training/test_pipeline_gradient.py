"""The gradient of the whole pipeline, from the loss to every array of parameters.

It is compared with finite differences in stages 1 to 4 of training.
"""

import numpy as np
import pytest

from p4dgs_ref.training import objective
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


@pytest.mark.usefixtures("right_reference")
def test_gradient_checker_sees_a_lost_factor(monkeypatch):
    """The check rejects a gradient that forgets the logarithm of l, a fault of real codes."""
    p, *others = setting(stage=2)

    def forgetful(*inputs):
        losses, rendered, back = objective.loss(*inputs)
        gradients, mean2d = back()
        gradients["log_l"][...] /= np.exp(p["log_l"])
        return losses, rendered, lambda: (gradients, mean2d)

    with pytest.raises(AssertionError, match="log_l"):
        check(p, *others, monkeypatch=monkeypatch, loss=forgetful)
