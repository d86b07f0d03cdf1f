"""The weight of what moves (B3), and the warning that names it."""

from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref.beyond import body
from p4dgs_ref.designs import PRESETS, fit, trainer_of, what_is_lost
from p4dgs_ref.training.fit import RunError
from tests.training.bars import Share, moving, scene

TINY_CODED = PRESETS["tiny_coded"]


@pytest.mark.parametrize(
    "preset, remedy", [("tiny", "try `--set body=true`"), ("tiny_coded", "try another seed")]
)
def test_the_remedy_is_ours_where_it_is_not_on(preset, remedy):
    model = Share(moving(), 0)
    model.preset = PRESETS[preset]
    assert remedy in what_is_lost(model)


def test_the_body_is_what_is_unlike_the_median_colour():
    truth = np.zeros((10, 10, 3))
    truth[:, :3] = (0, 0.2, 0)
    truth[0, 9] = (0.05, 0.05, 0.05)
    pixels = body.body(truth)
    assert pixels[:, :3].all() and pixels.sum() == 30


def test_the_body_counts_as_often_as_all_pixels_until_it_moves():
    """Two of sixteen columns count 8 times, in a quarter of stage 3 the root of it, then once."""
    trainer, found = trainer_of(scene(3), TINY_CODED), []
    trainer.model = lambda: SimpleNamespace(render=lambda *where: np.ones((12, 16, 3)))
    view, (_, rested, moved, end) = trainer.scene.train[0], TINY_CODED.stage_ends
    until = (rested + moved) // 2
    for trainer.iteration in (0, rested - 1, rested, (rested + until) // 2, until, moved, end):
        found.append(np.max(trainer.weight_of(view)))
    assert found == pytest.approx([8, 8, 8, np.sqrt(8), 1, 1, 1])
    assert trainer.factors == [8, 8]
    trainer.iteration = 0
    is_more = trainer.weight_of(view)[:, :, 0] > 1
    assert is_more[:, 7:9].all() and is_more.sum() == 24


def test_stage_3_keeps_what_the_model_at_rest_draws_wrong():
    """Of two columns the model draws one: the other one counts 16 times."""
    trainer = trainer_of(scene(3), TINY_CODED)
    view, rested = trainer.scene.train[0], TINY_CODED.stage_ends[1]
    drawn = np.ones((12, 16, 3))
    drawn[:, 7] = view.image[:, 7]
    trainer.model = lambda: SimpleNamespace(render=lambda *where: drawn)
    trainer.weight_of(view)
    trainer.iteration = rested
    assert np.array_equal(np.flatnonzero(trainer.weight_of(view)[0, :, 0] > 1), [8])
    assert trainer.factors == [8, 16]
    drawn[...] = view.image
    assert (trainer.weight_of(view) == 1).all() and trainer.factors == [8, 1]


@pytest.mark.parametrize("first", [{}, {"body": True}])
def test_a_training_does_not_go_on_with_or_without_the_weight(tmp_path, first):
    second = {} if first else {"body": True}
    ends = {"stage_ends": (1, 2, 3, 4)}
    fit(moving(), "smoke", 0, folder=tmp_path, **ends, **first)
    with pytest.raises(
        RunError, match=r"field 'preset\.body': the checkpoint was made with another"
    ):
        fit(moving(), "smoke", 0, folder=tmp_path, resume=True, **ends, **second)
    fit(moving(), "smoke", 0, folder=tmp_path, resume=True, **ends, **first)
