"""Warnings about trainings that cannot learn or did not, and how sparse scenes are trained."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.cli import text
from p4dgs_ref.training import fit, objective
from p4dgs_ref.training.presets import PAPER_SYNTHETIC, TINY
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


def test_few_views_are_warned_of_in_one_line():
    few, enough = scene(fit.FEW_VIEWS - 1), scene(fit.FEW_VIEWS)
    told = messages(fit.warn_of_few_views, few)
    assert len(told) == 1 and f"{fit.FEW_VIEWS - 1} training views" in told[0]
    assert "\n" not in told[0] and not messages(fit.warn_of_few_views, enough)


class Share:
    """A model that draws the mean of the training pictures, and a share of what is missing."""

    def __init__(self, scene, share):
        self.scene, self.share, self.settings = scene, share, None
        self.mean = np.mean([view.image for view in scene.train], axis=0)

    def model(self):
        return self

    def render(self, camera, t, settings):
        views = [*self.scene.train, *self.scene.test]
        truth = next(view.image for view in views if view.camera is camera)
        return self.mean + self.share * (truth - self.mean)


def moving():
    """A bar that moves: four training views, and one that is kept back."""
    bars = [
        replace(view, image=np.roll(view.image, 2 * i, 1)) for i, view in enumerate(scene(5).train)
    ]
    return replace(scene(5), train=bars[:4], test=bars[4:])


@pytest.mark.parametrize("share, is_warned", [(0, True), (0.1, True), (0.12, False), (1, False)])
def test_a_result_within_1_db_of_the_mean_picture_is_useless(share, is_warned):
    """With this share of the truth, the error shrinks by the factor (1 - share)**2."""
    told = messages(fit.warn_of_failure, Share(moving(), share))
    assert len(told) == is_warned and not any("\n" in line for line in told)
    if is_warned:
        mean, seen = Share(moving(), 0).mean, moving().test[0].image
        flat = -10 * np.log10(np.mean((seen - mean) ** 2))
        assert f"training pictures {flat:.2f} dB" in told[0] and "useless" in told[0]
        assert "test views" in told[0]
    without = replace(moving(), test=[])
    assert len(messages(fit.warn_of_failure, Share(without, share))) == is_warned


def test_a_scene_of_one_picture_is_not_warned_of():
    assert not messages(fit.warn_of_failure, Share(scene(3), 0))


def test_training_warns_before_and_after():
    told = messages(p4.train, moving(), "smoke", stage_ends=(1, 2, 3, 4))
    assert len(told) == 2 and "training views" in told[0] and "useless" in told[1]


def test_the_command_line_prints_a_warning_as_one_line(capsys, monkeypatch):
    monkeypatch.setattr(text, "presets", lambda *args: warnings.warn("views:\x1b\nfew"))
    assert cli.run(["presets"], 0.0) == 0
    assert capsys.readouterr().err == "p4dgs-ref: warning: views:\\x1b\\nfew\n"


# --- sparse scenes ---
def test_the_body_is_what_is_unlike_the_median_colour():
    """A pixel of the body counts by the weight, another one not at all, at equal errors."""
    truth = np.zeros((10, 10, 3))
    truth[:, :3] = (0, 0.2, 0)
    truth[0, 9] = (0.05, 0.05, 0.05)
    body = objective.body(truth)
    assert body[:, :3].all() and body.sum() == 30
    fixed = Trainer(scene(3), TINY).fixed()
    (plain, back), (more, back_more) = (
        objective.picture_loss(truth - 0.5, truth, fixed._replace(lambda_body=weight))
        for weight in (0.0, 4.0)
    )
    assert more[0] - plain[0] == pytest.approx(4 * 0.3 * 0.5)
    of_body = 300 * (back_more(3.0) - back(3.0))
    assert np.allclose(of_body, -12 * body[:, :, None], atol=1e-12)


def test_a_sparse_scene_counts_its_body_as_often_as_all_pixels():
    """One of sixteen columns is less than a tenth, two are more; from stage 4 on all are equal."""
    expected = [0.8 * 15, 0.8 * 15, 0.8 * 3, 0, 0]  # half-way through stage 3, 4 times for 16
    for thick, preset in ((1, TINY), (2, TINY), (1, PAPER_SYNTHETIC._replace(anchors=50))):
        trainer, weights = Trainer(scene(3, thick), preset), []
        _, rested, moved, end = preset.stage_ends
        for trainer.iteration in (0, rested, (rested + moved) // 2, moved, end):
            weights.append(trainer.fixed().lambda_body)
        assert weights == pytest.approx(expected if preset == TINY and thick == 1 else [0] * 5)
