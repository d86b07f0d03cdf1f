"""Density control of the baselines: what is cloned, split, pruned and reset."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref.lab.baselines import d3dgs, explicit
from p4dgs_ref.splatting.covariance import forward as covariance
from p4dgs_ref.training.parameters import Parameters

PRESET = replace(d3dgs.TINY_SMALL, gaussians=60, gradient_threshold=0.5, percent_dense=0.1)
EXTENT = 3.0
ROWS = ["x", "sh_dc", "sh_rest", "logit_alpha", "log_s", "raw_r"]


def random_gaussians(N=60, seed=0):
    rng = np.random.default_rng(seed)
    p = Parameters(explicit.start(replace(PRESET, gaussians=N), rng), np.float64)
    p["log_s"][...] = np.log(0.3) + 0.7 * rng.normal(size=(N, 3))
    p["logit_alpha"][...] = 4 * rng.normal(size=N) - 3
    p["sh_rest"][...] = rng.normal(size=p["sh_rest"].shape)
    return p, rng.random(N)


def shift(children):
    """A scatter that can be followed: children go one unit up and are halved."""
    children["x"] += 1
    children["log_s"] -= np.log(2)


@pytest.mark.parametrize("prune_large", [False, True])
def test_densify_against_a_loop(prune_large):
    p, gradient = random_gaussians()
    keep, added = explicit.densify(p, ROWS, gradient, EXTENT, PRESET, shift, prune_large)
    kept, clones, children = [], [], []
    for n in range(60):
        row = {name: p[name][n] for name in ROWS}
        largest = np.exp(row["log_s"]).max()
        faint = 1 / (1 + np.exp(-row["logit_alpha"])) < 0.005
        wanted, large = gradient[n] >= 0.5, largest > 0.3
        half = {**row, "x": row["x"] + 1, "log_s": row["log_s"] - np.log(2)}
        kept.append(not (wanted and large) and not faint and not (prune_large and largest > 0.3))
        if wanted and not large and not faint:
            clones.append(row)
        if wanted and large and not faint and not (prune_large and largest / 2 > 0.3):
            children += [half, half]
    assert keep.tolist() == kept and clones and children and any(kept)
    for name in ROWS:
        assert np.array_equal(added[name], [row[name] for row in clones + children]), name


def test_no_more_than_most():
    """The largest gradients come first; a clone and a split both add one."""
    p, gradient = random_gaussians()
    p["logit_alpha"][...] = 0
    for most, count in ((60, 0), (61, 1), (64, 4), (10, 0)):
        preset = replace(PRESET, most=most)
        keep, added = explicit.densify(p, ROWS, gradient, EXTENT, preset, shift, False)
        assert keep.sum() + len(added["x"]) == 60 + count
    preset = replace(PRESET, most=61, percent_dense=10.0)
    _, added = explicit.densify(p, ROWS, gradient, EXTENT, preset, shift, False)
    assert np.array_equal(added["x"], p["x"][[gradient.argmax()]])


def test_children_are_drawn_from_their_parent():
    """Mean and covariance of many children are those of the Gaussian; they are smaller by 1.6."""
    rng, N = np.random.default_rng(1), 200_000
    s, raw_r = np.array([[0.5, 0.2, 1.1]]), np.array([[0.7, -0.4, 1.3, 0.2]])
    children = {
        "x": np.tile([[1.0, 2, 3]], (N, 1)),
        "log_s": np.log(np.tile(s, (N, 1))),
        "raw_r": np.tile(raw_r, (N, 1)),
    }
    explicit.Trainer.scatter(SimpleNamespace(rng=rng), children)
    Sigma, _ = covariance(s, raw_r / np.linalg.norm(raw_r))
    assert children["x"].mean(axis=0) == pytest.approx([1, 2, 3], abs=0.01)
    assert np.cov(children["x"].T) == pytest.approx(Sigma[0], abs=0.01)
    np.testing.assert_allclose(np.exp(children["log_s"]), np.tile(s / 1.6, (N, 1)))


def test_reset_of_the_opacities():
    p, _ = random_gaussians()
    first, second, before = p.zeros(), p.zeros(), p["logit_alpha"].copy()
    first.vector[:] = second.vector[:] = 1
    explicit.reset_opacity(p, first, second)
    alpha = 1 / (1 + np.exp(-p["logit_alpha"]))
    assert alpha == pytest.approx(np.minimum(1 / (1 + np.exp(-before)), 0.01))
    assert (before > alpha.max()).any()
    for moments in (first, second):
        assert not moments["logit_alpha"].any() and moments["x"].all()


def test_a_window_of_training(scene, monkeypatch):
    """New Gaussians have zero moments, statistics start anew, and the window has its limits."""
    preset = replace(PRESET, grow_from=5, grow_every=10, grow_until=35, reset_every=20)
    preset = replace(preset, gradient_threshold=1e-4, min_opacity=0.0)
    trainer, counts, resets = d3dgs.Trainer(scene, preset), [], []
    reset = explicit.reset_opacity
    monkeypatch.setattr(
        explicit, "reset_opacity", lambda *a: resets.append(trainer.iteration) or reset(*a)
    )
    for _ in range(50):
        before = trainer.primitives
        trainer.step()
        counts.append(trainer.primitives - before)
        if counts[-1]:
            for moments in (trainer.adam.first, trainer.adam.second):
                assert moments["x"].any() and not moments["x"][-1].any()
            assert not trainer.statistics.seen.any()
            assert len(trainer.statistics.seen) == len(trainer.parameters["log_s"])
    grown = [i + 1 for i, count in enumerate(counts) if count]
    assert grown and set(grown) <= {10, 20, 30} and resets == [20]


def test_the_last_gaussian_stays(scene):
    preset = replace(PRESET, gaussians=3, min_opacity=0.9, grow_from=0, grow_every=2)
    trainer = d3dgs.Trainer(scene, preset)
    for _ in range(4):
        trainer.step()
    assert trainer.primitives == 3
