"""The ledger of effects: counted work and bytes, gains, and hidden units that are always zero."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.cli import lab as commands
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.codec import quantise
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.quantise import without_silent_units
from p4dgs_ref.effects import MOTION
from p4dgs_ref.lab import effect_ledger
from p4dgs_ref.lab.accuracy import trainings
from p4dgs_ref.lab.writer import read_csv
from p4dgs_ref.model import ANCHOR_NETWORKS
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


# --- gains ---------------------------------------------------------------------------------------
def test_trainings_differ_in_one_effect_only():
    scene = load_scene("glossy")
    for effect in MODEL_EFFECTS:
        assert set(effect_ledger.toggle_effect(scene, effect).effects) ^ set(scene.effects) == {
            effect
        }
    labels = [label for label, *_ in effect_ledger.tasks_of(scene, seeds=2)]
    assert len(labels) == 2 * (1 + len(MODEL_EFFECTS)) and labels[0] == "as listed"


def test_a_gain_within_twice_its_standard_error_is_drawn_as_none(monkeypatch):
    """Effects that are not listed are at zero, whatever they would gain."""
    rows = []
    for seed, noise in enumerate((-0.2, 0.1, 0.1)):
        rows.append({"label": "as listed", "seed": seed, "psnr_db": 30})
        for effect in MODEL_EFFECTS:
            label = f"{'with' if effect == 'rotation' else 'without'} {effect}"
            gain = {"rotation": -5, "occlusion": 4 - noise}.get(effect, noise)
            rows.append({"label": label, "seed": seed, "psnr_db": 30 - gain})
    ledger = {
        "effects": [
            {"effect": effect, "listed": effect != "rotation", "work": 4, "bytes": 2}
            for effect in MODEL_EFFECTS
        ],
        "never_called": [],
    }
    effect_ledger.add_gains(ledger, rows)
    said = {row["effect"]: effect_ledger.gain_text(row) for row in ledger["effects"]}
    assert said == {
        **dict.fromkeys(MODEL_EFFECTS, "none (+0.00 ±0.20)"),
        "rotation": "+5.00 ±0.00",
        "occlusion": "+4.00 ±0.20",
    }
    assert "+4.00 ±0.20" in effect_ledger.to_text(ledger)
    figures = []
    monkeypatch.setattr(effect_ledger, "save_figure", lambda figure, path: figures.append(figure))
    effect_ledger.draw_ledger(None, ledger["effects"])
    widths = dict(zip(MODEL_EFFECTS, [bar.get_width() for bar in figures[0].axes[2].patches]))
    assert widths == {**dict.fromkeys(MODEL_EFFECTS, 0), "occlusion": pytest.approx(4)}


@pytest.mark.slow
def test_gains_are_trained_for_only_where_they_are_asked_for(tmp_path, monkeypatch, capsys):
    plan = effect_ledger.tasks_of
    monkeypatch.setattr(effect_ledger, "tasks_of", lambda scene: plan(scene, 2, SHORT))
    monkeypatch.setattr(commands, "JOBS", 1)
    arguments = ["effects", "static", "--gain", "-o", str(tmp_path)]
    assert cli.run(arguments, 0) == 2
    assert "--yes: expected for 16 trainings" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert cli.run([*arguments, "--yes"], 0) == 0
    rows = read_csv(tmp_path / "effects.csv")
    assert len(rows) == 16 and len({row["sha256"] for row in rows}) == 16
    gain = effect_ledger.gains(rows)["background"]
    assert f"{gain['gain']:+.2f} ±{gain['within']:.2f}" in capsys.readouterr().out


@pytest.mark.slow
def test_in_two_processes_trainings_are_the_same():
    scene = load_scene("static", downscale=4)
    tasks, told = effect_ledger.tasks_of(scene, 1, SHORT)[:3], []
    one, two = (trainings.make(tasks, jobs, told.append) for jobs in (1, 2))
    assert [row["sha256"] for row in one] == [row["sha256"] for row in two]
    assert told == [f"{i} of 3 trainings" for i in (1, 2, 3)] * 2


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
    scene, preset = load_scene("static"), trainings.reduced(TINY.iterations // 10)
    builds = scene, replace(scene, effects=MODEL_EFFECTS)
    psnr = []
    for seed in (0, 1):
        few, full = (trainings.train(("", build, preset, seed)) for build in builds)
        assert few["bytes"] <= 0.6 * full["bytes"]
        psnr.append([few["psnr_db"], full["psnr_db"]])
    few, full = np.array(psnr).T
    assert np.mean(full - few) <= max(np.ptp(few), np.ptp(full), 1.0)
