"""Training: presets, Adam, learning rates, stages, positions, and where a NaN came from."""

import io
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref import model
from p4dgs_ref.equations import scale
from p4dgs_ref.model import LATTICE, snap
from p4dgs_ref.scenes import SceneError, load_scene
from p4dgs_ref.splatting import tiles
from p4dgs_ref.training import advice, objective, progress
from p4dgs_ref.training.initial import design_of, initial_parameters, neighbour_distance
from p4dgs_ref.training.parameters import Parameters, learning_rate_at
from p4dgs_ref.training.presets import (
    MAX_VALUE,
    MAX_WIDTH,
    PAPER_REAL,
    PAPER_SYNTHETIC,
    REQUIREMENTS,
    SMOKE,
    choose,
)
from p4dgs_ref.training.trainer import Trainer
from p4dgs_ref.training.watch import NotFinite, equation_codes, watch_calls

SHORT = replace(SMOKE, stage_ends=(1, 2, 3, 5))  # every stage, in five steps


@pytest.fixture(scope="module")
def scene():
    return load_scene("bouncing", downscale=4)


# --- presets ---
def test_paper_presets_hold_the_numbers_that_the_paper_prints():
    """Appendix, 'Hyperparameters', and section 4.1; the frequencies of time are those of D3DGS."""
    for preset, voxel, d, L_t, ends in (
        (PAPER_SYNTHETIC, 0.001, 16, 6, (3000, 5000, 10_000, 40_000)),
        (PAPER_REAL, 0.01, 32, 10, (3000, 4000, 10_000, 20_000)),
    ):
        assert (preset.L_x, preset.L_t, preset.mask_from) == (10, L_t, ends[1])
        assert (preset.voxel, preset.d, preset.k, preset.stage_ends) == (voxel, d, 10, ends)
        assert preset.hidden == preset.context == (2 * d, 2 * d) and preset.deformation == (
            192,
            192,
        )
        assert (preset.Q_f, preset.Q_s, preset.Q_l, preset.Q_O) == (1, 0.001, 0.001, 0.2)
        assert preset.grow_init == 16
        first = {name: getattr(preset, name)[0] for name in vars(preset) if name.startswith("lr_")}
        assert first == dict(
            lr_x=0,
            lr_f=0.0075,
            lr_s=0.007,
            lr_l=0.007,
            lr_O=0.01,
            lr_alpha=0.002,
            lr_c=0.008,
            lr_r=0.004,
            lr_psi_s=0.004,
            lr_d=1.6e-4,
            lr_grid=0.0016,
            lr_p=0.005,
            lr_q=0.005,
        )


def test_deformation_network_sizes_of_choice_q1(scene):
    """Without the time net of D3DGS the input is 63 + 13 wide."""
    layers = design_of(PAPER_SYNTHETIC, scene.effects + ("rotation", "scaling")).layers()["psi_d"]
    assert layers == [(76, 192), (192, 192), (192, 3), (192, 3), (192, 4)]
    assert sum((rows + 1) * columns for rows, columns in layers) == 53_770


@pytest.mark.parametrize(
    "changes, word",
    [
        ({"nonsense": "1"}, "nonsense"),
        ({"stage_ends": "4,3,2,1"}, "stage_ends"),
        ({"lr_d": "0.1"}, "lr_d"),
        ({"grow": "wild"}, "grow"),
        ({"voxel": "nan"}, "voxel"),
        ({"upright": "maybe"}, "upright"),
        ({"name": "x"}, "name"),
        ({"k": 2.5}, "'k'"),
        ({"grid_3d": "", "grid_2d": ""}, "grid_3d"),
        ({"d": "1_0"}, "'d': expected a value like 16, got '1_0'"),
        ({"d": "\N{ARABIC-INDIC DIGIT FOUR}"}, "'d'"),
        ({"grow_from": "10", "grow_until": "5"}, "'grow_until': expected at least grow_from, 10"),
        ({"lr_c": "2,1"}, "'lr_c': expected .* up to 1 or 0,0"),
        (
            {"table_3d": 2**24, "grid_3d": (170, 170), "F": 2},
            "at most 16777216 entries of the grid, got",
        ),
        ({"anchors": 10**6}, "'anchors', .* at most 33554432 numbers, got"),
    ],
)
def test_bad_changes_name_the_field(changes, word):
    with pytest.raises(ValueError, match=word) as refused:
        choose("tiny", changes)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match="huge"):
        choose("huge")


@pytest.mark.parametrize(
    "names, least, most",
    [
        ("anchors grow_every grow_init grow_hierarchy", 1, MAX_VALUE),
        ("extent voxel", 1e-9, 1e4),
        ("feature_std opacity_bias deformation_gain", 0, 1e3),
        ("table_3d table_2d", 1, 2**24),
        ("tau_alpha lambda_ssim", 0, 1),
        ("Q_f Q_s Q_l Q_O", 1e-5, 1e5),
        ("grow_depth", 0, 16),
    ],
)
def test_a_field_takes_both_ends_and_nothing_beyond(names, least, most):
    for name in names.split():
        _, is_met = REQUIREMENTS[name]
        assert [*map(is_met, (least - 1e-12, least, most, 1.005 * most))] == [0, 1, 1, 0], name


def test_layers_have_both_ends_of_their_widths_and_nothing_beyond():
    _, is_met = REQUIREMENTS["hidden"]
    assert [is_met((2, n)) for n in (0, 1, MAX_WIDTH, MAX_WIDTH + 1)] == [0, 1, 1, 0]


def test_changes_as_text_and_as_values_agree():
    text = choose(
        "smoke",
        {"k": "3", "lr_d": "0.1,0.01", "upright": "false", "voxel": "0.01", "grid_3d": "4,6"},
    )
    assert text == choose(
        "smoke", {"k": 3, "lr_d": (0.1, 0.01), "upright": False, "voxel": 0.01, "grid_3d": (4, 6)}
    )


# --- progress ---
def test_a_line_and_a_row_have_the_numbers_of_the_step(monkeypatch):
    stream, (image, truth) = io.StringIO(), np.ones((2, 1, 2, 3)) * [[[[1.5]]], [[[0.9]]]]
    preset = SimpleNamespace(iterations=24, stage=lambda step: step + 1)
    trainer = SimpleNamespace(iteration=1, preset=preset, count=2, history=[])
    shown = progress.Progress(stream)
    monkeypatch.setattr(progress.time, "monotonic", lambda: shown.shown + 2)
    shown.steps = 3  # since the last line
    losses = SimpleNamespace(L_total=0.5, L_rate=3.25)
    view = SimpleNamespace(image=truth, camera=SimpleNamespace(width=2, height=1))
    shown(trainer, losses, SimpleNamespace(image=image, index=[7]), view)
    rest = "loss 0.5000  PSNR 20.00 dB at 2x1  3.25 bits/parameter  2 anchors  1 Gaussian  "
    # The first step says nothing of the time that the others take.
    assert stream.getvalue() == f" 1/24  stage 1  {rest}500.0 ms/step\n"
    later = SimpleNamespace(**{**vars(trainer), "iteration": 2, "history": []})
    shown(later, losses, SimpleNamespace(image=image, index=[7]), view)
    line = stream.getvalue().splitlines()[1]
    assert line == f" 2/24  44 s left  stage 2  {rest}2000.0 ms/step"
    numbers = dict(iteration=1, stage=1, loss=0.5, psnr_db=pytest.approx(20), anchors=2)
    (row,) = trainer.history
    assert dict(zip(progress.COLUMNS, row)) == numbers | {
        "bits_per_parameter": 3.25,
        "gaussians": 1,
    }
    preset.iterations, shown.stream = 2000, None
    for trainer.iteration in range(2, 50):
        shown(trainer, losses, SimpleNamespace(image=image, index=[7]), view)
    assert [row[0] for row in trainer.history] == [1, 20, 40]  # at least one in twenty steps


# --- optimiser ---
def test_learning_rate_is_geometric():
    def rate(step):
        return learning_rate_at(step, 0.01, 1e-4, 1000)

    def late(step):
        return learning_rate_at(step, 1.0, 0.1, 500, start=300)

    assert rate(0) == pytest.approx(0.01) and rate(500) == pytest.approx(1e-3)
    assert rate(1000) == rate(9999) == pytest.approx(1e-4)
    assert learning_rate_at(7, 0.0, 0.0, 1000) == 0 and learning_rate_at(7, 0.3, 0.3, 1000) == 0.3
    assert late(100) == late(300) == 1 and late(400) == pytest.approx(0.1**0.5)


def test_parameters_are_views_of_one_vector():
    p = Parameters({"x": np.ones((2, 3)), "psi.W0": np.zeros((3, 4)), "psi.b0": np.zeros(4)})
    p["x"][1, 2] = 7
    assert p.vector[5] == 7 and p.network("psi")[0][0] is p["psi.W0"]
    grown = p.with_rows(("x",), np.array([False, True]), {"x": np.full((2, 3), 5.0)})
    assert (
        np.array_equal(grown["x"], [[1, 1, 7], [5, 5, 5], [5, 5, 5]])
        and p.vector.size + 3 == grown.vector.size
    )


# --- start and stages ---
def test_anchors_start_on_the_lattice_with_their_neighbours_distance(scene):
    trainer = Trainer(scene, SMOKE)
    p = initial_parameters(SMOKE, trainer.design, np.random.default_rng(0))
    steps = p["x_a"].astype(float) / SMOKE.voxel
    assert np.abs(steps - np.rint(steps)).max() < 1e-3 and len(np.unique(p["x_a"], axis=0)) == len(
        p["x_a"]
    )
    x = p["x_a"].astype(float)
    squared = np.sort(((x[:, None] - x) ** 2).sum(axis=2), axis=1)[:, 1:4].mean(axis=1)
    assert np.allclose(np.exp(p["log_s"]), np.sqrt(squared)[:, None], rtol=1e-4)
    assert not p["O_a"].any() and neighbour_distance(np.zeros((1, 3))) == [0.1]
    np.testing.assert_allclose(neighbour_distance(np.zeros((4, 3))), 1e-7**0.5)  # as in 3DGS
    assert neighbour_distance([[0, 0, 0], [0, 3, 4]]).tolist() == [5, 5]


def test_networks_start_upright_and_hardly_move(scene):
    """Compared with a start from the same random numbers without the preset's changes."""
    changes = dict(upright=True, deformation_gain=0.01, opacity_bias=0.5)
    plainly = dict(upright=False, deformation_gain=1.0, opacity_bias=0.0)
    effects = (*scene.effects, "rotation", "scaling")
    p, plain = (
        initial_parameters(preset, design_of(preset, effects), np.random.default_rng(0))
        for preset in (replace(SMOKE, **change) for change in (changes, plainly))
    )
    layer, trunk = len(SMOKE.hidden), len(SMOKE.deformation)
    turned = (p[f"psi_r.b{layer}"] - plain[f"psi_r.b{layer}"]).reshape(-1, 4)
    assert np.allclose(turned, [1, 0, 0, 0], atol=1e-6)
    assert np.allclose(p[f"psi_alpha.b{layer}"] - plain[f"psi_alpha.b{layer}"], 0.5, atol=1e-6)
    for name in (f"psi_d.{kind}{trunk + head}" for kind in "Wb" for head in range(3)):
        assert np.allclose(p[name], 0.01 * plain[name], rtol=1e-5), name
    assert np.array_equal(p["psi_d.W0"], plain["psi_d.W0"])
    for weights in (plain["psi_d.b0"], p["grid.0"]):
        assert weights.min() < 0 < weights.max() and abs(weights.mean()) < 0.5 * weights.max()


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), [], np.zeros((4, 2)), np.zeros(3), np.full((2, 3), np.nan)]
)
def test_bad_points_are_refused_in_one_line(scene, points):
    with pytest.raises(ValueError, match=r"^points: expected .* shape \[A, 3\].*") as refused:
        Trainer(scene, SMOKE, points=points)
    assert "\n" not in str(refused.value)


def test_points_beyond_what_a_file_holds_are_refused_in_one_line(scene, monkeypatch):
    points = np.eye(3)
    trainer = Trainer(scene, SMOKE, points=points)
    most = sum(model.declared_numbers(trainer.design, 3).values())
    monkeypatch.setattr(model, "MAX_NUMBERS", most)
    assert Trainer(scene, SMOKE, points=points).count == 3
    with pytest.raises(SceneError, match=f"points: expected at most {most} numbers") as refused:
        Trainer(scene, SMOKE, points=[*points, [0, 0, 0]])
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("t", [np.nan, np.inf])
def test_a_time_that_is_not_finite_is_refused(scene, t):
    with pytest.raises(ValueError, match=r"^t: expected a number, got (nan|inf)$"):
        Trainer(scene, SMOKE).model().render(scene.train[0].camera, t)


def test_a_picture_of_too_many_pairs_is_trained_and_judged_in_halves(scene, monkeypatch):
    """A finished training is never refused for the size of its pictures."""
    trainer, gradients = Trainer(scene, SMOKE), []
    for most in (tiles.MAX_PAIRS, 0):
        monkeypatch.setattr(tiles, "MAX_PAIRS", most)
        trainer.rng = np.random.default_rng(0)
        gradients.append(trainer.gradients_of(scene.train[0])[2].vector)
    np.testing.assert_allclose(*gradients, rtol=1e-3, atol=1e-6 * np.abs(gradients[0]).max())
    trainer.step()
    assert "is drawn" in advice.warning_after(trainer)


def test_positions_stand_on_the_16_bit_lattice_from_stage_4_on(scene):
    trainer = Trainer(scene, SMOKE)
    while trainer.iteration < SMOKE.stage_ends[2] + 1:
        trainer.step()
    frozen = trainer.parameters["x_a"].copy()
    symbols, positions = snap(frozen, *trainer.box)
    assert (
        np.abs(frozen - positions).max() < 1e-6 and symbols.min() == 0 and symbols.max() == LATTICE
    )
    while trainer.iteration < SMOKE.iterations:
        trainer.step()
    assert np.array_equal(trainer.parameters["x_a"], frozen)
    assert np.array_equal(snap(trainer.model().anchors.x_a, *trainer.box)[0], symbols)


def test_snap_rounds_to_nearest_and_survives_flat_boxes():
    lo, hi = np.float32([-1, 2, 5]), np.float32([3, 2, 6])
    x = np.array([[-1, 2, 5], [3, 2, 6], [0.1234, 2, 5.5], [9, 9, -9.0]])
    symbols, positions = snap(x, lo, hi)
    assert symbols.tolist()[0] == [0, 0, 0] and symbols.tolist()[1] == [65535, 0, 65535]
    assert np.abs(positions[:3] - x[:3]).max() <= 4 / 65535 / 2 + 1e-12
    assert symbols.tolist()[3] == [65535, 0, 0]
    assert np.array_equal(snap(positions, lo, hi)[0], symbols)


@pytest.mark.filterwarnings("ignore:scene bouncing")  # a training of few steps
def test_the_seed_decides_the_file(scene):
    short = dict(preset="smoke", stage_ends=SHORT.stage_ends)
    files = [hash(p4.encode(p4.train(scene, seed=seed, **short))) for seed in (0, 0, 1)]
    assert files[0] == files[1], "one seed gave two files"
    assert files[0] != files[2], "two seeds gave one file"


def test_every_view_comes_once_before_any_comes_twice(scene):
    trainer = Trainer(scene, SMOKE)
    names = [trainer.next_view().name for _ in range(2 * len(scene.train))]
    half = len(scene.train)
    assert len(set(names[:half])) == half == len(set(names[half:])) and names[:half] != names[half:]


# --- where did the NaN come from ---
@pytest.mark.parametrize(
    "stage, changes, said",
    [
        (1, {"f_a": ((3, 1), np.nan)}, "iteration 0: parameter: f_a[3, 1] is nan"),
        (1, {"psi_c.W0": ((3, 1), np.inf)}, "parameter: psi_c.W0[3, 1] is inf"),
        # log_l = 100 is finite, its exponential in float32 is not; Eq. (1) is the first to use it.
        (
            1,
            {"log_l": ((2, 0), 100), "O_a": (2, 1)},
            "equation 'offsets', forward: x[2, 0, 0] is inf",
        ),
        # The network of Eq. (5) overflows, and the message says whose network it is.
        (3, {"psi_d.W0": (..., 3e38)}, "equation 'deformation', its 'mlp', forward: y"),
    ],
)
def test_the_first_bad_number_is_named(scene, stage, changes, said):
    trainer = Trainer(scene, SMOKE)
    while trainer.stage < stage:
        trainer.step()
    for array, (place, value) in changes.items():
        trainer.parameters[array][place] = value
    with np.errstate(all="ignore"), pytest.raises(NotFinite, match=re.escape(said)):
        trainer.step()


def test_a_step_of_adam_that_is_not_finite_is_named(scene):
    """A moment so large beside a small gradient comes from no training that was not edited."""
    trainer = Trainer(scene, SMOKE)
    trainer.step()
    trainer.adam.first["f_a"][3, 1] = 3e38
    with pytest.raises(NotFinite, match=r"^iteration 1: after Adam's step, parameter f_a\[3, 1\]"):
        trainer.step()


def test_a_bad_backward_is_traced(scene, monkeypatch):
    real = scale.backward

    def wrong(saved, s_bar):
        gradients = real(saved, s_bar)
        return {**gradients, "s_a": gradients["s_a"] * np.nan}

    monkeypatch.setattr(scale, "backward", wrong)
    with pytest.raises(NotFinite, match="equation 'scale', backward, gradient of: s_a"):
        Trainer(scene, SMOKE).step()


@pytest.mark.parametrize(
    "L_total, said", [(1.0, r"gradient of: f_a\[3, 1\] is nan"), (np.inf, "objective: L_total is")]
)
def test_what_no_equation_spoiled_is_named(scene, monkeypatch, L_total, said):
    """First the losses, then the gradients, which mostly follow from them."""
    real = objective.loss

    def wrong(*inputs):
        losses, rendered, back = real(*inputs)
        gradients, mean2d_bar = back()
        gradients["f_a"][3, 1] = np.nan
        return losses._replace(L_total=L_total), rendered, lambda: (gradients, mean2d_bar)

    monkeypatch.setattr(objective, "loss", wrong)
    with pytest.raises(NotFinite, match=f"iteration 0: {said}"):
        Trainer(scene, SMOKE).step()


def test_calls_are_watched_from_outside(scene):
    """In the order of the paper's figures; afterwards the profile function is the one before."""
    trainer, seen, before = Trainer(scene, SMOKE), [], sys.getprofile()
    with watch_calls(equation_codes(), lambda event, mark, *_: seen.append((event, *mark))):
        trainer.step()
    trainer.step()
    assert sys.getprofile() is before
    forwards = [key for event, key, name in seen if (event, name) == ("call", "forward")]
    assert forwards[:3] == ["view", "offsets", "scale"] and forwards[-1] == "total_loss"
    assert seen[-1] == ("return", "view", "backward")
    assert seen.count(("call", "scale", "backward")) == 1
    assert seen.count(("return", "compositing, fast", "forward")) == 1
    assert sum(event == "call" for event, *_ in seen) == len(seen) / 2
