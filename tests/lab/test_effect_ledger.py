"""The ledger of effects: counted work and bytes, and hidden units that are always zero."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.codec import quantise
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.quantise import without_silent_units
from p4dgs_ref.effects import MOTION
from p4dgs_ref.lab import effect_ledger
from p4dgs_ref.model import ANCHOR_NETWORKS
from p4dgs_ref.report.evaluate import evaluate
from p4dgs_ref.report.inspect import components
from p4dgs_ref.scenes import MODEL_EFFECTS, load_scene
from p4dgs_ref.training.presets import SMOKE, TINY
from p4dgs_ref.training.trainer import Trainer, assemble
from tests.sampling import few, turn

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


# --- work and bytes ------------------------------------------------------------------------------
@pytest.mark.parametrize("name", few(["static", "bouncing"], 1))
def test_only_listed_effects_take_work_and_bytes(name):
    scene = load_scene(name, downscale=4)
    result = effect_ledger.of_scene(scene)
    for row in result["effects"]:
        assert row["listed"] == (row["effect"] in scene.effects)
        on, sizes = row, row["bytes"]
        if not row["listed"]:
            assert row["work"] == row["bytes"] == 0
            on, sizes = {"work": row["if_work"]}, row["if_bytes"]
        assert on["work"] > 0 and (sizes > 0) == (row["effect"] in (*MOTION, *VIEW))
    moving = ["view", "positional_encoding", "deformation", "deformed"]
    assert result["never_called"] == (moving if name == "static" else [])


def test_work_that_effects_share_belongs_to_none_of_them():
    design = replace(
        trained("static").design, d=6, k=2, hidden=(7,), deformation=(5,), L_x=1, L_t=1
    )

    def work(*effects):
        return effect_ledger.network_work(replace(design, effects=effects), A=3, N=4)

    assert +work("translation") == {"translation": 4 * (9 * 5 + 5 * 3)}
    assert +work(*MOTION) == {"translation": 60, "scaling": 60, "rotation": 80}
    assert +work("view_color") == {"view_color": 3 * 4 * 7}
    assert +work("view_geometry") == {"view_geometry": 3 * (3 * 4 * 7)}  # of three networks


# --- what is always zero -------------------------------------------------------------------------
@pytest.mark.parametrize("name", few(["static", "figure"], 1))
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
@turn("a static scene")
def test_static_needs_less_than_with_everything_on():
    """Bytes and quality of `static`, a tenth of a training, over two seeds."""
    scene, preset = load_scene("static"), replace(TINY, stage_ends=(20, 30, 180, 380))
    psnr = []
    for seed in (0, 1):
        few, full = (
            encode(Trainer(build, preset, seed).run())
            for build in (scene, replace(scene, effects=MODEL_EFFECTS))
        )
        assert len(few) <= 0.6 * len(full)
        psnr.append([evaluate(decode(data), scene)[0]["psnr_db"] for data in (few, full)])
    few, full = np.array(psnr).T
    assert np.mean(full - few) <= max(np.ptp(few), np.ptp(full), 1.0)
