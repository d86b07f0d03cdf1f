"""The ledger of effects, hidden units that are always zero, and a scene with all effects on."""

import json
from dataclasses import replace

import numpy as np
import pytest
from p4dgs_ref.designs import decode, encode
from p4dgs_ref.lab.tables.methods import OURS

from p4dgs_ref.codec import quantise
from p4dgs_ref.codec.quantise import without_silent_units
from p4dgs_ref.effects import MOTION
from p4dgs_ref.equations import deformation
from p4dgs_ref.lab import effect_ledger, writer
from p4dgs_ref.lab.accuracy.harness import shortened
from p4dgs_ref.lab.tables import methods
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
    tasks = effect_ledger.plan(scene, tmp_path / "files", seeds=2, preset="smoke")
    assert len(tasks) == 2 * (1 + len(MODEL_EFFECTS))
    methods.make_missing(tasks, told.append, jobs=2)
    assert len(told) == len(tasks)
    rows = effect_ledger.collect(tasks, tmp_path)
    assert [row["effect"] for row in rows] == list(MODEL_EFFECTS)
    assert json.loads(json.dumps(rows)) == rows
    for row in rows:
        listed = row["effect"] in scene.effects
        assert row["called_for"] == listed and row["ms_on"] > 0 and row["ms_off"] > 0
        assert row["work_on"] > 0 == row["work_off"]
        assert row["bytes_on"] >= 0 == row["bytes_off"]
        assert (row["bytes_on"] > 0) == (row["effect"] in (*MOTION, *VIEW))
    background = rows[MODEL_EFFECTS.index("background")]
    assert background["worth_db"] > 0.5
    assert f"{background['worth_db']:+.2f} ±" in effect_ledger.to_text(rows)
    again = effect_ledger.summaries(writer.read_csv(tmp_path / "effects.csv"))
    assert again == [
        {name: value for name, value in row.items() if not name.startswith("ms")} for row in rows
    ]
    assert (tmp_path / "effects.png").stat().st_size > 10_000


def test_a_gain_within_twice_its_standard_error_is_drawn_as_none(monkeypatch):
    """Effects that are not listed are at zero, whatever they would gain."""

    def row(label, seed, psnr_db, **columns):
        return {"label": label, "seed": seed, "psnr_db": psnr_db, **columns}

    rows = []
    for seed, noise in enumerate((-0.2, 0.1, 0.1)):
        rows.append(row("p4dgs", seed, 30, work_occlusion=4.0, bytes_view_color=256))
        for effect in MODEL_EFFECTS:
            label = f"{'with' if effect == 'rotation' else 'without'} {effect}"
            gain = {"rotation": -5, "occlusion": 4 - noise}.get(effect, noise)
            rows.append(row(label, seed, 30 - gain))
    found = {one["effect"]: one for one in effect_ledger.summaries(rows)}
    said = {effect: effect_ledger.said(one) for effect, one in found.items()}
    assert said == {
        **dict.fromkeys(MODEL_EFFECTS, "none (+0.00 ±0.20)"),
        "rotation": "+5.00 ±0.00",
        "occlusion": "+4.00 ±0.20",
    }
    assert [found["occlusion"][name] for name in ("work_on", "work_off")] == [4, 0]
    assert not found["rotation"]["called_for"] and found["view_color"]["bytes_on"] == 256
    figures = []
    monkeypatch.setattr(effect_ledger, "save_figure", lambda figure, path: figures.append(figure))
    effect_ledger.draw_ledger(None, found.values())
    widths = dict(zip(MODEL_EFFECTS, [bar.get_width() for bar in figures[0].axes[2].patches]))
    assert widths == {**dict.fromkeys(MODEL_EFFECTS, 0), "occlusion": pytest.approx(4)}


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
def test_static_needs_less_than_with_everything_on(tmp_path):
    """Bytes, counted work and quality of `static`, a tenth of a training, over two seeds."""
    scene, psnr = load_scene("static"), []
    everything = replace(scene, effects=MODEL_EFFECTS)
    listed = methods.plan({OURS: [{}]}, [OURS], [scene], tmp_path, 2, TINY.iterations // 10)
    for task in listed:
        pair = [task, task._replace(scene=everything, step="all")]
        methods.make_missing(pair)
        few, full = effect_ledger.made(pair)
        on = [{e for e in MODEL_EFFECTS if row.get(f"work_{e}")} for row in (few, full)]
        assert on == [set(scene.effects), set(MODEL_EFFECTS)]
        assert few["bytes"] <= 0.6 * full["bytes"]
        psnr.append([row["psnr_db"] for row in (few, full)])
    few, full = np.array(psnr).T
    assert np.mean(full - few) <= max(np.ptp(few), np.ptp(full), 1.0)
