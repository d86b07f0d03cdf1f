"""The ledger of effects, units that nothing wakes, and a still scene with and without all effects."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.codec import quantise
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.inspect import components
from p4dgs_ref.effects import MOTION
from p4dgs_ref.model import ANCHOR_NETWORKS, without_silent_units
from p4dgs_ref.scenes import MODEL_EFFECTS, load_scene
from p4dgs_ref.studies import effect_ledger, effect_pair
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import assemble
from tests.core.test_effects import EPS, SEEN_BY, trained


def test_ledger(tmp_path):
    scene, told = load_scene("bouncing"), []
    rows = effect_ledger.ledger(scene, "smoke", share=1, progress=told.append)
    assert [row["effect"] for row in rows] == list(MODEL_EFFECTS) and len(told) > 10
    assert json.loads(json.dumps(rows)) == rows
    for row in rows:
        called = row["effect"] in scene.effects
        assert row["called_for"] == called and row["ms_on"] > 0 and row["ms_off"] > 0
        assert row["work_on"] > 0 == row["work_off"] and row["bytes_on"] >= 0 == row["bytes_off"]
        assert (row["bytes_on"] > 0) == (row["effect"] in (*MOTION, *SEEN_BY))
        assert (row["psnr_lost_when_off"] is None) != called and (
            row["psnr_gained_when_forced"] is None
        ) == called
    assert rows[MODEL_EFFECTS.index("background")]["psnr_lost_when_off"] > 0.5
    text = effect_ledger.describe(rows)
    assert all(row["evidence"] in text for row in rows)
    effect_ledger.draw_ledger(tmp_path / "ledger.png", rows)
    with open(tmp_path / "ledger.csv", newline="") as file:
        assert [row["effect"] for row in csv.DictReader(file)] == list(MODEL_EFFECTS)
    assert (tmp_path / "ledger.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match="'test'"):
        effect_ledger.ledger(replace(scene, test=()), "smoke")


def test_a_switched_build_differs_in_one_effect_only():
    scene = load_scene("glossy")
    for effect in MODEL_EFFECTS:
        assert set(effect_ledger.switched(scene, effect).effects) ^ set(scene.effects) == {effect}
    short = effect_ledger.shortened(SMOKE, 0.01)
    assert short.stage_ends == (1, 2, 3, 4)


@pytest.mark.parametrize("name", ["static", "figure"])
def test_silent_units_change_no_picture(name, monkeypatch):
    """Units that no feature wakes: the slim model is the same function on this file's anchors, and its file is smaller."""
    scene = load_scene(name)
    trainer = trained(name, "occlusion", True)[0]
    p = trainer.parameters
    for i, net in enumerate(ANCHOR_NETWORKS):
        p[f"{net}.b0"][[i, i + 1]], p[f"{net}.b1"][i : i + 3 + i] = -100, -100
    trained_model = assemble(p, trainer.design, trainer.mask, trainer.box, scene.background)
    with monkeypatch.context() as fat:
        fat.setattr(quantise, "without_silent_units", lambda model: model)
        data = encode(trained_model)
    model = decode(data)
    slim = without_silent_units(model)
    # at least two and three are silent everywhere; training may have put more to sleep
    assert (
        slim.design.hidden[0] <= SMOKE.hidden[0] - 2
        and slim.design.hidden[1] <= SMOKE.hidden[1] - 3
    )
    again = encode(trained_model)
    assert again == encode(slim) == encode(decode(again))
    assert (
        len(again) < len(data) - 100
        and components(again)["features"] == components(data)["features"]
    )
    for view in scene.test[:3]:
        ours, theirs = (
            slim.gaussians(view.time, view.camera),
            model.gaussians(view.time, view.camera),
        )
        back = decode(again).gaussians(view.time, view.camera)
        for a, b, c in zip(ours, theirs, back):
            assert np.array_equal(a, c) and np.abs(a - b).max() <= 64 * EPS * max(
                np.abs(b).max(), 1
            )
    seeing = decode(trained(name, "view_color", True)[2])
    assert without_silent_units(seeing) is seeing


def test_silent_units_keep_one_where_all_sleep():
    trainer = trained("static", "occlusion", True)[0]
    model = trainer.model()
    for net in ANCHOR_NETWORKS:
        for b in model.networks[net][1][:-1]:
            b[:] = -100
    slim = without_silent_units(model)
    assert slim.design.hidden == (1, 1)
    view = trainer.scene.test[0]
    assert np.array_equal(slim.render(view.camera, 0), model.render(view.camera, 0))


def test_pair():
    """Two seeds of each build, the comparison from its rows alone, and rows that JSON takes."""
    rows = effect_pair.static_pair(seeds=(0, 3), preset="smoke")
    builds = (effect_pair.LISTED, effect_pair.ALL)
    assert [(row["seed"], row["build"]) for row in rows] == [
        (seed, build) for seed in (0, 3) for build in builds
    ]
    assert json.loads(json.dumps(rows)) == rows
    for less, more in zip(rows[::2], rows[1::2]):
        assert less["bytes"] < more["bytes"]
        assert 0 < less["work"] < more["work"]
    made = [
        {**row, "ms_per_step": ms, "bytes": size, "psnr_db": psnr}
        for row, ms, size, psnr in zip(
            rows, (2, 5, 4, 10), (60, 105, 55, 105), (30.0, 31.0, 32.0, 31.5)
        )
    ]
    result = effect_pair.compare_pair(made)
    assert result["speedup"] == 2.5 and result["psnr_lost"] == 0.25 and result["seed_spread"] == 2
    assert result["bytes_saved"] == pytest.approx(1 - 55 / 105 / 2 - 60 / 105 / 2)
    assert "2.50 times" in effect_pair.describe_pair(made)


@pytest.mark.slow
def test_static_needs_less_than_with_everything_on():
    """Bytes and counted work of `static`, half a training; seconds are the machine's: printed, not asserted."""
    rows = effect_pair.static_pair(seeds=(0, 1), share=0.5)
    print("\n" + effect_pair.describe_pair(rows))
    result = effect_pair.compare_pair(rows)
    assert result["bytes_saved"] >= 0.4
    assert result["psnr_lost"] <= max(result["seed_spread"], 1.0)
    listed_rows, all_rows = (rows[i::2] for i in (0, 1))
    for less, more in zip(listed_rows, all_rows):
        assert less["build"] == effect_pair.LISTED and more["build"] == effect_pair.ALL
        assert more["work"] > 3 * less["work"] and more["bytes"] > 1.5 * less["bytes"]
