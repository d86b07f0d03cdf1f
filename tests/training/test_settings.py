"""The settings of training: weight and unit of the rate, order of stages, learning rates."""

from dataclasses import replace

import pytest

from p4dgs_ref.scenes import load_scene
from p4dgs_ref.training.presets import PRESETS, SMOKE
from p4dgs_ref.training.trainer import Trainer
from p4dgs_ref.training.watch import equation_codes, watch_calls

# The field of a preset that is the learning rate of an array, or of all arrays of a network.
FIELDS = {
    "x_a": "lr_x",
    "f_a": "lr_f",
    "log_s": "lr_s",
    "log_l": "lr_l",
    "O_a": "lr_O",
    "psi_alpha": "lr_alpha",
    "psi_c": "lr_c",
    "psi_r": "lr_r",
    "psi_s": "lr_psi_s",
    "psi_d": "lr_d",
    "psi_p": "lr_p",
    "psi_q": "lr_q",
    "grid": "lr_grid",
}
# What is first computed in a stage.
FIRST = {"noise": 2, "deformation": 3, "prior": 4, "likelihood": 4}


@pytest.fixture(scope="module")
def scene():
    return load_scene("bouncing", downscale=4)


def in_stage(scene, stage, **changes):
    """A Trainer whose first iteration is in a stage."""
    ends = [0] * (stage - 1) + [9] * (5 - stage)
    return Trainer(scene, replace(SMOKE, stage_ends=tuple(ends), **changes))


def test_the_weight_of_the_rate(scene):
    """Eq. (15): L_total = L_render + lambda_rate L_rate; HAC's weight is 1e-3 (Q12)."""
    weights = {name: preset.lambda_rate for name, preset in PRESETS.items()}
    tiny = {"tiny": 5e-4, "tiny_real": 5e-4}
    expected = {"paper_synthetic": 1e-3, "paper_real": 1e-3, **tiny, "smoke": 1e-3}
    assert expected.items() <= weights.items(), "lambda_rate of a preset"
    losses, *_ = in_stage(scene, 4, lambda_rate=0.25).step()
    total = losses.L_render + 0.25 * losses.L_rate
    assert losses.L_total == pytest.approx(total), "lambda_rate is the weight of L_rate in L_total"


def test_the_unit_of_the_rate(scene):
    """An anchor has d numbers in f, 3 each in s and l, and 3 k in O."""
    trainer = in_stage(scene, 4)
    losses, *_ = trainer.step()
    coded = trainer.count * (SMOKE.d + 6 + 3 * SMOKE.k)
    assert losses.L_rate == pytest.approx(losses.bits / coded), "L_rate: bits per coded number"


@pytest.mark.parametrize("stage", [1, 2, 3, 4])
def test_the_order_of_the_stages(scene, stage):
    """Noise from stage 2 on, time from 3 on, the rate in 4."""
    last = SMOKE.stage_ends[stage - 1] - 1
    assert SMOKE.stage(last) == stage, f"the stage of iteration {last} of {SMOKE.stage_ends}"
    trainer, called = in_stage(scene, stage), set()
    with watch_calls(equation_codes(), lambda event, mark, *_: called.add(mark[0])):
        trainer.step()
    expected = {name for name, first in FIRST.items() if first <= stage}
    assert called & {*FIRST} == expected, f"equations that stage {stage} calls"


@pytest.fixture(scope="module")
def rates(scene):
    """The learning rates that Adam asks for in each stage, where every field has its own."""
    own = {field: (i / 100, i / 100) for i, field in enumerate(FIELDS.values(), 1)}
    asked = {}
    for stage in (1, 2, 3, 4):
        trainer = in_stage(scene, stage, **own)
        names = trainer.parameters.arrays

        def step(p, gradients, learning_rate, stage=stage, names=names):
            asked[stage] = {name: learning_rate(name) for name in names}

        trainer.adam.step = step
        trainer.step()
    return own, asked


@pytest.mark.parametrize(
    "stage, at_rest",
    [
        (1, {"psi_d", "psi_p", "psi_q", "grid"}),
        (2, {"psi_d", "psi_p", "psi_q", "grid"}),
        (3, {"psi_p", "psi_q", "grid"}),
        (4, {"x_a"}),
    ],
)
def test_which_arrays_rest_in_a_stage(rates, stage, at_rest):
    _, asked = rates
    found = {array.split(".")[0] for array, rate in asked[stage].items() if not rate}
    assert found == at_rest, f"arrays whose learning rate is 0 in stage {stage}"


@pytest.mark.parametrize("name, field", FIELDS.items())
def test_each_array_has_the_learning_rate_of_its_name(rates, name, field):
    own, asked = rates
    of_stage = asked[1 if name == "x_a" else 4]
    found = {rate for array, rate in of_stage.items() if array.split(".")[0] == name}
    assert found == {own[field][0]}, f"{name}: expected the learning rate {field}"
