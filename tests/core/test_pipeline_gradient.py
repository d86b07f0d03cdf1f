"""The whole pipeline's gradient, loss to every parameter array, against finite differences, in stages 1 to 4."""

import numpy as np
import pytest

from p4dgs_ref.equations import hash_grid
from p4dgs_ref.model import bounding_box, snap
from p4dgs_ref.scenes.scene import MODEL_EFFECTS, View
from p4dgs_ref.splatting import tiles
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT, FAST
from p4dgs_ref.training import objective
from p4dgs_ref.training.initial import design_of, initial_parameters
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import SMOKE

WIDTH, HEIGHT = 16, 12


def setting(effects=MODEL_EFFECTS, stage=4, seed=0, **fixed):
    """A small model in float64 with every network awake, one view of it, and noise."""
    rng = np.random.default_rng(seed)
    preset = SMOKE._replace(anchors=9, deformation_gain=1.0, feature_std=0.7, extent=0.6)
    design = design_of(preset, effects)
    p = Parameters(initial_parameters(preset, design, rng).arrays, np.float64)
    for name in p.arrays:
        if name.startswith("grid"):
            p[name][...] = rng.uniform(-0.9, 0.9, p[name].shape)
        elif name.startswith("psi_d"):
            p[name][...] *= 0.3
    p["O_a"][...] = rng.normal(size=p["O_a"].shape) * 0.5
    located = None
    if stage == 4:
        box = bounding_box(p["x_a"])
        p["x_a"][...] = snap(p["x_a"], *box)[1]
        located = hash_grid.locate(
            p["x_a"], *(c.astype(float) for c in box), design.grid, [T for T, _ in design.levels()]
        )
    camera = look_at((1.0, -2.2, 1.1), (0, 0, 0), 17.0, 15.0, WIDTH, HEIGHT, c_x=7.1, c_y=6.2)
    view = View("v", rng.random((HEIGHT, WIDTH, 3)), None, camera, 0.37)
    u = rng.random((len(p["x_a"]), sum(design.widths))) - 0.5
    mask = rng.random((len(p["x_a"]), design.k)) < 0.85
    values = dict(
        mask=mask,
        located=located,
        background=np.array([0.9, 0.8, 0.3]),
        noisy=stage >= 2,
        moving=stage >= 3,
        lambda_rate=0.02,
        lambda_ssim=0.2,
        lambda_volume=0.01,
        settings=FAST._replace(dtype="float64", cut=1e-14, stop=0.0),
    )
    return p, design, objective.Fixed(**{**values, **fixed}), view, u


def networks_and_grids(p, design):
    return {name: p.network(name) for name in design.layers()}, p.listed("grid")


def evaluate(p, design, fixed, view, u):
    losses, seen, res = objective.forward(p, design, *networks_and_grids(p, design), fixed, view, u)
    return losses, seen, res


def loss_at(p, design, fixed, view, u, held, monkeypatch):
    """L_total with what carries no gradient held at the base point: masks, E(x), signs of the grids, tile lists."""
    with monkeypatch.context() as patch:
        patch.setattr("p4dgs_ref.model.masking.forward", held["gather"])
        patch.setattr("p4dgs_ref.equations.deformation.positional_encoding.forward", held["encode"])
        patch.setattr("p4dgs_ref.splatting.fast.bin_splats", lambda *args: held["lists"])
        patch.setattr("p4dgs_ref.training.objective.hash_rate.forward", held["hash_rate"])
        patch.setattr("p4dgs_ref.model.hash_grid.query", held["query"])
        return evaluate(p, design, fixed, view, u)[0].L_total


def hold(p, design, fixed, view, u, monkeypatch):
    """Record what is held: one pass at the base point with recording stand-ins."""
    from p4dgs_ref.equations import hash_rate, positional_encoding

    held, encoded = {}, []
    forward, bins = positional_encoding.forward, tiles.bin_splats

    def record(x, L):
        encoded.append(forward(x, L))
        return encoded[-1]

    def record_lists(*args):
        held["lists"] = bins(*args)
        return held["lists"]

    with monkeypatch.context() as patch:
        patch.setattr("p4dgs_ref.equations.deformation.positional_encoding.forward", record)
        patch.setattr("p4dgs_ref.splatting.fast.bin_splats", record_lists)
        _, seen, _ = evaluate(p, design, fixed, view, u)

    def gather(alpha, mask, tau_alpha, *attributes):
        kept = [a.reshape(-1, a.shape[2])[seen.index] for a in attributes]
        return (alpha.reshape(-1)[seen.index], *kept, seen.index), (seen.index, alpha.shape)

    held["gather"] = gather
    # x and t are told apart by their number of columns; both are the values of the base point
    held["encode"] = lambda x, L: encoded[0] if x.shape[1] == 3 else encoded[1]
    base = [
        np.where(g >= 0, 1.0, -1.0) - g for g in p.listed("grid")
    ]  # all |parameter| < 1: sign -> identity
    smooth = hash_rate.surrogate(p.listed("grid"))
    real_rate = hash_rate.forward(p.listed("grid"))[1]
    held["hash_rate"] = lambda grids: (smooth(grids), real_rate)

    real_query = hash_grid.query

    def query(located, grids):
        h = (located @ np.concatenate([g + b for g, b in zip(grids, base)])).reshape(
            -1, len(grids) * grids[0].shape[1]
        )
        return hash_grid.Out(h), real_query(located, p.listed("grid"))[1]

    held["query"] = query
    return held


def check(p, design, fixed, view, u, monkeypatch, limit=1e-5):
    held = hold(p, design, fixed, view, u, monkeypatch)
    losses, seen, res = evaluate(p, design, fixed, view, u)
    assert len(seen.index) > 3 and np.ptp(seen.image) > 0.1  # something is seen
    gradients, _ = objective.backward(res)
    rng = np.random.default_rng(5)
    names = [n for n in p.arrays if gradients[n].any()]
    for name in names:
        direction = rng.normal(size=p[name].shape) * np.maximum(np.abs(p[name]), 0.05)

        def at(h):
            moved = Parameters(p.arrays, np.float64)
            moved[name][...] += h * direction
            return loss_at(moved, design, fixed, view, u, held, monkeypatch)

        ours, errors = np.vdot(gradients[name], direction), []
        for h in (1e-3, 1e-4, 1e-5):
            numeric = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
            errors.append(abs(numeric - ours) / np.abs(gradients[name] * direction).sum())
        assert min(errors) <= limit, (name, errors)
    return names


@pytest.mark.parametrize("stage", [1, 2, 3, 4])
def test_every_array_of_every_stage(stage, monkeypatch):
    p, design, fixed, view, u = setting(stage=stage)
    names = check(p, design, fixed, view, u, monkeypatch)
    silent = {n.split(".")[0] for n in p.arrays} - {n.split(".")[0] for n in names}
    assert (
        silent
        == {
            1: {"psi_d", "psi_p", "psi_q", "grid"},
            2: {"psi_d", "psi_p", "psi_q", "grid"},
            3: {"psi_p", "psi_q", "grid"},
            4: set(),
        }[stage]
    )


@pytest.mark.parametrize(
    "effects",
    [
        ("occlusion", "background"),
        ("translation", "view_color", "background"),
        ("rotation", "scaling", "occlusion", "view_geometry"),
    ],
)
def test_every_array_with_effects_off(effects, monkeypatch):
    p, design, fixed, view, u = setting(effects, seed=1)
    names = check(p, design, fixed, view, u, monkeypatch)
    assert any(n.startswith("psi_d") for n in names) == any(
        e in effects for e in ("translation", "rotation", "scaling")
    )


def test_exact_settings_give_the_same_gradient():
    p, design, fixed, view, u = setting()
    fast = objective.backward(evaluate(p, design, fixed, view, u)[2])[0]
    exact = objective.backward(evaluate(p, design, fixed._replace(settings=EXACT), view, u)[2])[0]
    for name in p.arrays:
        assert np.allclose(
            fast[name], exact[name], rtol=1e-8, atol=1e-10 * np.abs(exact[name]).max()
        ), name


def test_gradient_checker_sees_a_lost_factor(monkeypatch):
    """The check above rejects a gradient that forgets the logarithm of l (a fault of real codes)."""
    p, design, fixed, view, u = setting(stage=2)
    real = objective.backward

    def forgetful(res):
        gradients, mean2d = real(res)
        gradients["log_l"][...] /= np.exp(res["p"]["log_l"])
        return gradients, mean2d

    monkeypatch.setattr(objective, "backward", forgetful)
    with pytest.raises(AssertionError, match="log_l"):
        check(p, design, fixed, view, u, monkeypatch)
