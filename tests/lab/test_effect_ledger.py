"""The ledger of effects, hidden units that are always zero, and a scene with all effects on."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.codec import quantise
from p4dgs_ref.codec.quantise import without_silent_units
from p4dgs_ref.designs import decode, encode
from p4dgs_ref.effects import MOTION
from p4dgs_ref.equations import deformation
from p4dgs_ref.lab import effect_ledger
from p4dgs_ref.lab.accuracy.harness import shortened
from p4dgs_ref.model import ANCHOR_NETWORKS
from p4dgs_ref.report.inspect import components
from p4dgs_ref.scenes import MODEL_EFFECTS, load_scene
from p4dgs_ref.training.presets import SMOKE, TINY
from p4dgs_ref.training.trainer import Trainer, assemble

EPS = np.finfo(float).eps
VIEW = ("view_color", "view_geometry")
SHORT = replace(SMOKE, stage_ends=(1, 2, 3, 5))  # every stage, in five steps


def trained(name, *forced):
    """A trainer after five steps on a scene, with some effects forced on."""
    scene = load_scene(name)
    effects = [effect for effect in MODEL_EFFECTS if effect in (*scene.effects, *forced)]
    trainer = Trainer(replace(scene, effects=tuple(effects)), SHORT)
    for _ in range(SHORT.iterations):
        trainer.step()
    return trainer


@pytest.mark.slow
def test_ledger(tmp_path):
    scene, told = load_scene("bouncing"), []
    rows = effect_ledger.ledger(scene, "smoke", share=1, progress=told.append, jobs=2)
    assert [row["effect"] for row in rows] == list(MODEL_EFFECTS)
    assert len(told) == 1 + len(MODEL_EFFECTS)
    assert json.loads(json.dumps(rows)) == rows
    for row in rows:
        listed = row["effect"] in scene.effects
        assert row["called_for"] == listed and row["ms_on"] > 0 and row["ms_off"] > 0
        assert row["work_on"] > 0 == row["work_off"]
        assert row["bytes_on"] >= 0 == row["bytes_off"]
        assert (row["bytes_on"] > 0) == (row["effect"] in (*MOTION, *VIEW))
    background = rows[MODEL_EFFECTS.index("background")]
    assert background["worth_db"] > 0.5
    assert f"{background['worth_db']:+.2f}\n" in effect_ledger.to_text(rows)
    effect_ledger.draw_ledger(tmp_path / "ledger.png", rows)
    with open(tmp_path / "ledger.csv", newline="", encoding="utf-8") as file:
        assert [row["effect"] for row in csv.DictReader(file)] == list(MODEL_EFFECTS)
    assert (tmp_path / "ledger.png").stat().st_size > 10_000


def test_work_that_effects_share_belongs_to_none_of_them():
    def work(*heads):
        shapes = [(12, 5), *((5, columns) for columns in heads)]
        weights, biases = [np.ones(s) for s in shapes], [np.ones(s[1]) for s in shapes]
        _, saved = deformation.forward(np.zeros((4, 3)), 0.5, weights, biases, 1, 1)
        return effect_ledger.multiply_adds("deformation", saved)

    assert work(3, 0, 0) == {"translation": 4 * (9 * 5 + 5 * 3)}
    assert work(3, 3, 4) == {"translation": 60, "scaling": 60, "rotation": 80}


def test_a_switched_build_differs_in_one_effect_only():
    scene = load_scene("glossy")
    for effect in MODEL_EFFECTS:
        assert set(effect_ledger.switched(scene, effect).effects) ^ set(scene.effects) == {effect}
    short = shortened(SMOKE, 0.01)
    assert short.stage_ends == (1, 2, 3, 4)


@pytest.mark.parametrize("name", ["static", "figure"])
def test_silent_units_change_no_picture(name, monkeypatch):
    """A model without the units that are always zero is the same function, and its file smaller."""
    trainer = trained(name, "occlusion")
    scene, p = trainer.scene, trainer.parameters
    for i, net in enumerate(ANCHOR_NETWORKS):
        p[f"{net}.b0"][[i, i + 1]] = -100
        p[f"{net}.b1"][i : i + 3 + i] = -100
    whole = assemble(p, trainer.design, trainer.mask, trainer.box, scene.background)
    with monkeypatch.context() as unslimmed:
        unslimmed.setattr(quantise, "without_silent_units", lambda model: model)
        data = encode(whole)
    model = decode(data)
    slim = without_silent_units(model)
    # Two and three units are zero in all networks; training may have silenced more.
    first, second = slim.design.hidden
    assert first <= SMOKE.hidden[0] - 2 and second <= SMOKE.hidden[1] - 3
    again = encode(whole)
    assert again == encode(slim) == encode(decode(again))
    assert len(again) < len(data) - 100
    assert components(again)["features"] == components(data)["features"]
    for view in scene.test[:3]:
        models = slim, model, decode(again)
        for a, b, c in zip(*(m.gaussians(view.time, view.camera) for m in models)):
            assert np.array_equal(a, c)
            assert np.abs(a - b).max() <= 64 * EPS * max(np.abs(b).max(), 1)
    seeing = decode(encode(trained(name, "view_color").model()))
    assert without_silent_units(seeing) is seeing


@pytest.mark.slow
def test_static_needs_less_than_with_everything_on():
    """Bytes, counted work and quality of `static`, a tenth of a training, over two seeds."""
    scene, preset = load_scene("static"), shortened(TINY, 0.1)
    psnr = []
    for seed in (0, 1):
        builds = {"listed": scene, "all": replace(scene, effects=MODEL_EFFECTS)}
        few, full = effect_ledger.train_all(builds, preset, seed).values()
        assert {effect for effect, work in few["work"].items() if work} == set(scene.effects)
        assert all(full["work"].values()) and len(few["data"]) <= 0.6 * len(full["data"])
        psnr.append([build["psnr_db"] for build in (few, full)])
    few, full = np.array(psnr).T
    assert np.mean(full - few) <= max(np.ptp(few), np.ptp(full), 1.0)
