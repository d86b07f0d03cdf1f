"""Warnings about trainings that cannot learn or did not, and the weight of what moves (B3)."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.cli import text
from p4dgs_ref.training import body, fit
from p4dgs_ref.training.presets import TINY, TINY_CODED
from p4dgs_ref.training.trainer import Trainer


def scene(count, thick=2, color=(0.2, 0.3, 0.4)):
    """Views of a vertical bar of some pixels on white."""
    image = np.ones((12, 16, 3))
    image[:, 7 : 7 + thick] = color
    angles = np.linspace(0, 3, count)
    cameras = [
        p4.look_at((3 * np.cos(a), 3 * np.sin(a), 1), (0, 0, 0), 20, 20, 16, 12) for a in angles
    ]
    return p4.Scene.from_arrays([image] * count, cameras, list(np.linspace(0, 1, count)))


def messages(function, *args, **kwargs):
    """The texts of the warnings that a call gives."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        function(*args, **kwargs)
    return [str(warning.message) for warning in seen]


def test_few_views_are_told_of_in_one_line():
    told = fit.few_views(scene(fit.FEW_VIEWS - 1))
    assert f"{fit.FEW_VIEWS - 1} training views" in told and "\n" not in told
    assert not fit.few_views(scene(fit.FEW_VIEWS))


class Share:
    """A trained model that draws the mean of the training pictures, and a share of what is missing.

    At the times between the views it draws an empty picture, so the bar is what moves.
    """

    def __init__(self, scene, share, preset=TINY):
        self.scene, self.share, self.settings, self.preset = scene, share, None, preset
        self.mean = np.mean([view.image for view in scene.train], axis=0)

    def model(self):
        return self

    def render(self, camera, t, settings):
        seen = [v for v in (*self.scene.train, *self.scene.test) if v.camera is camera]
        if t != seen[0].time:
            return np.ones_like(self.mean)
        return self.mean + self.share * (seen[0].image - self.mean)


def moving():
    """A bar that moves: four training views, and one that is kept back."""
    bars = [
        replace(view, image=np.roll(view.image, 2 * i, 1)) for i, view in enumerate(scene(5).train)
    ]
    return replace(scene(5), train=bars[:4], test=bars[4:])


@pytest.mark.parametrize("preset, remedy", [(TINY, "--set body=true"), (TINY_CODED, "seed")])
@pytest.mark.parametrize("share, is_told", [(0, True), (0.28, True), (0.3, False), (1, False)])
def test_what_moves_is_lost_within_3_db_of_the_mean_picture(share, is_told, preset, remedy):
    """With this share of the truth, the error shrinks by the factor (1 - share)**2."""
    told = fit.lost(Share(moving(), share, preset))
    assert bool(told) == is_told and "\n" not in told
    if is_told:
        mean, seen = Share(moving(), 0).mean, moving().test[0].image
        bar = seen[:, :, 0] < 1  # 2 of 16 columns
        flat = -10 * np.log10(np.mean((seen - mean)[bar] ** 2))
        assert f"training pictures {flat:.2f} dB" in told and "what moves is lost" in told
        assert "test views" in told and "12.5% of the pixels" in told and remedy in told
    without = replace(moving(), test=[])
    assert bool(fit.lost(Share(without, share, preset))) == is_told


def test_a_mover_over_something_static_is_lost_though_the_picture_is_good():
    """A wall fills half of the picture: the whole picture has 14 dB more than its moving part."""
    wall = moving()
    for view in (*wall.train, *wall.test):
        view.image[:, :4] = 0.5
    seen = Share(wall, 0)
    assert "what moves is lost" in fit.lost(seen)


def test_a_scene_without_motion_is_told_that_it_is_useless():
    still = replace(moving(), effects=("occlusion",))
    told = fit.lost(Share(still, 0))
    assert "useless" in told and "moves" not in told and "body" not in told


def test_a_scene_in_which_nothing_is_wrong_is_not_told_of():
    still = Share(scene(3), 1)
    still.render = lambda camera, t, settings: scene(3).train[0].image
    assert not fit.lost(still)


def test_training_warns_before_and_after():
    told = messages(p4.train, moving(), "smoke", stage_ends=(1, 2, 3, 4))
    assert len(told) == 2 and "training views" in told[0] and "is lost" in told[1]


@pytest.mark.filterwarnings("always:views")
def test_the_command_line_prints_a_warning_as_one_line(capsys, monkeypatch):
    monkeypatch.setattr(text, "presets", lambda *args: warnings.warn("views:\x1b\nfew"))
    assert cli.run(["presets"], 0.0) == 0
    assert capsys.readouterr().err == "p4dgs-ref: warning: views:\\x1b\\nfew\n"


# --- the weight of what moves (B3) ---
def test_the_body_is_what_is_unlike_the_median_colour():
    truth = np.zeros((10, 10, 3))
    truth[:, :3] = (0, 0.2, 0)
    truth[0, 9] = (0.05, 0.05, 0.05)
    pixels = body.body(truth)
    assert pixels[:, :3].all() and pixels.sum() == 30


def test_the_body_counts_as_often_as_all_pixels_until_it_moves():
    """Two of sixteen columns count 8 times, in a quarter of stage 3 the root of it, then once."""
    trainer, found = Trainer(scene(3), TINY_CODED), []
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
    trainer = Trainer(scene(3), TINY_CODED)
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


def test_the_paper_counts_all_pixels_alike():
    trainer = Trainer(scene(3), TINY)
    assert trainer.weight_of(trainer.scene.train[0]) == 1 and not trainer.factors
