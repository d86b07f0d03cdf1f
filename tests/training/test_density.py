"""Growing, re-seeding, pruning and masking of anchors, by hand and in training."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref import model
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.training import density
from p4dgs_ref.training.presets import PAPER_SYNTHETIC, TINY
from p4dgs_ref.training.trainer import Trainer

SCAFFOLD = replace(PAPER_SYNTHETIC, k=4, d=3, extent=0.5, grid_3d=(4,), grid_2d=(4,))


class Always:  # the random share keeps every candidate
    random = staticmethod(np.ones)


@pytest.fixture(scope="module")
def scene():
    return load_scene("bouncing", downscale=4)


def prepared(scene, preset, A=12):
    trainer = Trainer(scene, replace(preset, anchors=A))
    statistics = trainer.statistics
    statistics.visits[:] = 100
    statistics.opacity[:] = 50
    statistics.seen[:] = 100
    return trainer, statistics


def test_scaffold_growing_by_hand(scene):
    """A child with a gradient above the first threshold only gets an anchor in its coarse voxel."""
    trainer, statistics = prepared(scene, SCAFFOLD)
    p = trainer.parameters
    p["f_a"][...] = np.arange(36).reshape(12, 3)
    p["O_a"][5, 2] = 0.4
    statistics.gradient[5, 2] = 100 * 3e-4  # mean 3e-4: above 2e-4, below 4e-4

    rows = density.grow(p, statistics, SCAFFOLD, Always)
    centre = p["x_a"][5] + p["O_a"][5, 2] * np.exp(p["log_l"][5])
    size = 16 * SCAFFOLD.voxel
    assert np.allclose(rows["x_a"], [np.round(centre / size) * size], atol=1e-6)
    assert rows["f_a"].tolist() == [[15, 16, 17]] and not rows["O_a"].any()
    assert np.allclose(np.exp(rows["log_s"]), size) and np.allclose(np.exp(rows["log_l"]), size)
    statistics.gradient[5, 2] = 100 * 9e-4  # above all three thresholds: 16, 4 and 1 epsilon
    assert np.allclose(
        np.exp(density.grow(p, statistics, SCAFFOLD, Always)["log_s"][:, 0]) / SCAFFOLD.voxel,
        [16, 4, 1],
    )
    statistics.seen[5, 2] = 40  # seen too rarely: 0.5 * 0.8 * 100 at most
    assert len(density.grow(p, statistics, SCAFFOLD, Always)["x_a"]) == 0


def test_growing_stops_at_what_a_file_may_hold(scene, monkeypatch):
    """In one line; dead anchors still go, which makes room."""
    trainer, statistics = prepared(scene, SCAFFOLD)
    trainer.parameters["O_a"][5, 2] = 0.4
    statistics.gradient[5, 2] = 100.0
    trainer.iteration, trainer.rng = 1600, Always
    most = sum(model.declared_numbers(trainer.design, 12).values())
    monkeypatch.setattr(model, "MAX_NUMBERS", most)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        trainer.adjust()
    texts = [str(warning.message) for warning in told]
    assert texts == ["no more anchors grow: a file could not hold them"], "warning of growing"
    assert trainer.count == 12
    statistics.opacity[:3], statistics.visits[:], statistics.seen[:] = 0, 100, 100
    statistics.opacity[3:], statistics.gradient[5, 2] = 50, 100.0
    trainer.adjust()
    assert 9 < trainer.count <= 12


def test_growing_does_not_double_an_occupied_voxel(scene):
    preset = replace(SCAFFOLD, grow_depth=1)
    trainer, statistics = prepared(scene, preset)
    statistics.gradient[3] = 100.0  # all four children sit on their anchor: O_a = 0
    rng = np.random.default_rng(0)
    assert len(density.grow(trainer.parameters, statistics, preset, rng)["x_a"]) == 0
    # Four children in one free voxel: it gets one anchor.
    trainer.parameters["O_a"][3] = 2.0
    assert len(density.grow(trainer.parameters, statistics, preset, rng)["x_a"]) == 1


def test_pruning_and_masking_by_opacity(scene):
    trainer, statistics = prepared(scene, TINY)
    statistics.opacity[4] = 100 * 0.001  # four children at 0.001: 0.004 together
    statistics.opacity[6, 1] = 100 * 0.004
    trainer.mask[8] = False  # what is masked for good no longer counts
    assert np.flatnonzero(density.dead_anchors(statistics, trainer.mask, TINY)).tolist() == [4, 8]
    faint = density.faint_children(statistics, TINY)
    assert faint[4].all() and faint[6].tolist() == [False, True, False, False] and faint.sum() == 5
    statistics.visits[:] = 80  # not more than 0.8 of the window: no decision
    assert (
        not density.dead_anchors(statistics, trainer.mask, TINY).any()
        and not density.faint_children(statistics, TINY).any()
    )
    statistics.seen[0, :2] = 400, 401  # more than half of 0.8 of the window
    wide = replace(TINY, grow_every=1000)
    assert density.judged_children(statistics, wide)[0, :2].tolist() == [False, True]


def test_scaffold_clears_only_what_it_has_judged(scene):
    """Children seen more than 40 times and anchors visited more than 80 times start anew."""
    trainer, statistics = prepared(scene, SCAFFOLD)
    statistics.gradient[:] = 1e-9
    statistics.seen[2, 1], statistics.visits[3] = 40, 80
    trainer.parameters["log_s"][7] = [-3, 0.04, 2]
    trainer.iteration = 1500  # growing begins after this iteration
    trainer.adjust()
    assert trainer.parameters["log_s"][7].tolist() == np.float32([-3, 0.04, 2]).tolist()
    assert statistics.seen.sum() == 47 * 100 + 40 and statistics.visits.sum() == 11 * 100 + 80
    trainer.iteration = 1600
    trainer.adjust()  # clamps the scales, too
    assert trainer.parameters["log_s"][7].tolist() == np.float32([-3, 0.04, 0.05]).tolist()
    after = trainer.statistics
    assert after.seen[2, 1] == 40 and after.gradient[2, 1] == 1e-9 and after.seen.sum() == 40
    assert after.visits[3] == 80 and after.opacity[3].tolist() == [50] * 4
    assert after.visits.sum() == 80 and after.opacity.sum() == 200


def test_rows_stay_together_when_anchors_come_and_go(scene):
    trainer, _ = prepared(scene, TINY)
    for _ in range(3):
        trainer.step()
    trainer.mask[2, 1] = False
    old = {name: trainer.parameters[name].copy() for name in density.ROWS}
    first, W = trainer.adam.first["f_a"].copy(), trainer.parameters["psi_c.W0"].copy()
    added = {name: rows[:2] + 1 for name, rows in old.items()}
    trainer.keep_rows(np.arange(12) != 0, added)
    for name in density.ROWS:
        assert np.array_equal(
            trainer.parameters[name], np.concatenate([old[name][1:], added[name]])
        )
    assert np.array_equal(
        trainer.adam.first["f_a"], np.concatenate([first[1:], np.zeros((2, TINY.d))])
    )
    assert (
        np.array_equal(trainer.parameters["psi_c.W0"], W)
        and not trainer.mask[1, 1]
        and trainer.mask.shape == (13, 4)
    )
    trainer.step()
    trainer.keep_rows(np.zeros(13, bool))
    assert len(trainer.mask) == 1  # the last anchor is never dropped
    trainer.step()


def test_reseeding_copies_where_the_image_pulls(scene):
    trainer, statistics = prepared(scene, TINY)
    p, dead = trainer.parameters, np.arange(12) < 2
    for _ in range(2):
        trainer.step()
    statistics.gradient[:] = 0
    statistics.gradient[7, 3] = 1.0
    expected = p["x_a"][7] + p["O_a"][7, 3] * np.exp(p["log_l"][7])
    density.reseed(
        p, trainer.adam.first, trainer.adam.second, dead, statistics, np.random.default_rng(0)
    )
    assert np.array_equal(p["x_a"][:2], [expected, expected]) and np.array_equal(
        p["f_a"][:2], p["f_a"][[7, 7]]
    )
    assert not p["O_a"][:2].any()
    for moments in (trainer.adam.first, trainer.adam.second):
        for name in density.ROWS:
            assert not moments[name][:2].any() and moments[name][2:].any(), name
    statistics.gradient[:], before = 0, p.vector.copy()
    density.reseed(
        p, trainer.adam.first, trainer.adam.second, dead, statistics, np.random.default_rng(0)
    )
    assert np.array_equal(p.vector, before)  # without gradients nothing moves
