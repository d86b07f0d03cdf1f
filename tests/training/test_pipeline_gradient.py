"""The gradient of the whole pipeline, from the loss to every array of parameters.

It is compared with finite differences in stages 1 to 4 of training.
"""

import numpy as np
import pytest

from p4dgs_ref.equations import hash_grid, hash_rate, masking, positional_encoding
from p4dgs_ref.model import bounding_box, snap
from p4dgs_ref.scenes.scene import MODEL_EFFECTS, View
from p4dgs_ref.splatting import fast, tiles
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.training import coded_networks, objective
from p4dgs_ref.training.initial import design_of, initial_parameters
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import SMOKE
from tests.golden.cases.hash_rate import surrogate
from tests.sampling import few

WIDTH, HEIGHT = 16, 12


def setting(effects=MODEL_EFFECTS, stage=4, seed=0, changes=(), body=False):
    """A small model in float64 with every network awake, one view of it, and noise.

    `changes` are fields of the design.
    """
    rng = np.random.default_rng(seed)
    preset = SMOKE._replace(anchors=9, deformation_gain=1.0, feature_std=0.7, extent=0.6)
    design = design_of(preset, effects)._replace(**dict(changes))
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
        lo, hi = (corner.astype(float) for corner in box)
        tables = [T for T, _ in design.levels()]
        located = hash_grid.locate(p["x_a"], lo, hi, design.grid, tables)
    camera = look_at((1.0, -2.2, 1.1), (0, 0, 0), 17.0, 15.0, WIDTH, HEIGHT, c_x=7.1, c_y=6.2)
    view = View("v", rng.random((HEIGHT, WIDTH, 3)), None, camera, 0.37)
    u = rng.random((len(p["x_a"]), sum(design.widths))) - 0.5
    mask = rng.random((len(p["x_a"]), design.k)) < 0.85
    fixed = objective.Fixed(
        mask=mask,
        located=located,
        background=np.array([0.9, 0.8, 0.3]),
        stage=stage,
        lambda_rate=0.02,
        lambda_ssim=0.2,
        settings=FAST._replace(dtype="float64", cut=1e-14, stop=0.0),
        weight=rng.uniform(1, 6, (HEIGHT, WIDTH, 1)) if body else 1.0,
    )
    return p, design, fixed, view, u


def evaluate(p, design, fixed, view, u):
    networks = {name: p.network(name) for name in design.layers()}
    return objective.loss(p, design, networks, p.listed("grid"), fixed, view, u)


def hold(p, design, fixed, view, u, monkeypatch):
    """Stand-ins {what is replaced: function} for all that carries no gradient.

    They hold the values of the base point: which Gaussians are kept, E(x) and E(t), the tile
    lists, and the signs of the grids. The signs move with the parameters instead, as the
    straight-through gradient assumes; all parameters of the grids are below 1 in magnitude here.
    """
    encoded, lists = [], []
    encode, read_grids = positional_encoding.forward, hash_grid.query

    def record_encoding(p, L):
        encoded.append(encode(p, L))
        return encoded[-1]

    def record_lists(*args):
        lists.append(tiles.bin_splats(*args))
        return lists[-1]

    with monkeypatch.context() as patch:
        patch.setattr(positional_encoding, "forward", record_encoding)
        patch.setattr(fast, "bin_splats", record_lists)
        _, seen, _ = evaluate(p, design, fixed, view, u)

    def gather(alpha, mask, tau_alpha, *attributes):
        kept = [a.reshape(-1, a.shape[2])[seen.index] for a in attributes]
        return (alpha.reshape(-1)[seen.index], *kept, seen.index), (seen.index, alpha.shape)

    base = p.listed("grid")
    signs_less_base = [np.where(grid >= 0, 1.0, -1.0) - grid for grid in base]

    def query(located, grids):
        signs = [grid + start for grid, start in zip(grids, signs_less_base)]
        h = (located @ np.concatenate(signs)).reshape(-1, len(grids) * grids[0].shape[1])
        return h, read_grids(located, base)[1]

    smooth_rate, (_, saved_rate) = surrogate(base), hash_rate.forward(base)
    coding = {}
    if fixed.coded:  # scales carry no gradient, and steps move off their lattice
        layout, log_step = fixed.coded, p["log_step"].copy()
        steps = coded_networks.steps_of(log_step)
        step = steps[layout.tensor]
        w = p.vector[layout.part]
        b = coded_networks.scales(layout.rounded.vector / step, layout)
        error = np.rint(w / step) - w / step
        coding = {
            (coded_networks, "scales"): lambda k, layout: b,
            (coded_networks, "steps_of"): lambda moved: steps * np.exp(moved - log_step),
            (np, "rint"): lambda k: k + error,
        }
    return {
        (masking, "forward"): gather,
        # x and t are told apart by their number of columns
        (positional_encoding, "forward"): lambda p, L: encoded[0 if p.shape[1] == 3 else 1],
        (fast, "bin_splats"): lambda *args: lists[0],
        (hash_grid, "query"): query,
        (hash_rate, "forward"): lambda grids: (smooth_rate(grids), saved_rate),
        **coding,
    }


def check(p, design, fixed, view, u, monkeypatch, limit=1e-5):
    """Compare the gradient of every array with finite differences along a random direction.

    Returns the names of the arrays that have a gradient.
    """
    held = hold(p, design, fixed, view, u, monkeypatch)
    _, seen, back = evaluate(p, design, fixed, view, u)
    assert len(seen.index) > 3 and np.ptp(seen.image) > 0.1  # something is seen
    gradients, _ = back()
    rng = np.random.default_rng(5)

    def loss(name, change):
        moved = Parameters(p.arrays, np.float64)
        moved[name][...] += change
        with monkeypatch.context() as patch:
            for (module, function), stand_in in held.items():
                patch.setattr(module, function, stand_in)
            return evaluate(moved, design, fixed, view, u)[0].L_total

    names = [name for name in p.arrays if gradients[name].any()]
    for name in names:
        direction = rng.normal(size=p[name].shape) * np.maximum(np.abs(p[name]), 0.05)
        terms = gradients[name] * direction
        errors = []
        while min(errors, default=1) > limit:  # one of three step sizes has to agree
            assert len(errors) < 3, (name, errors)
            h = 10.0 ** -(3 + len(errors))
            one = loss(name, h * direction) - loss(name, -h * direction)
            two = loss(name, 2 * h * direction) - loss(name, -2 * h * direction)
            error = abs((8 * one - two) / (12 * h) - terms.sum())
            errors.append(error / np.abs(terms).sum())
    return names


STAGES_1_AND_2 = {"psi_d", "psi_p", "psi_q", "grid"}
RESTS, MOVES = ("occlusion", "background"), ("translation", "view_color", "background")
TURNS = ("rotation", "scaling", "occlusion", "view_geometry")
D3DGS = dict(deformation=(9, 8, 7), time_net=(6, 4), skip=True)
# name: (arguments of `setting`, the arrays without a gradient)
SETTINGS = {
    "stage 4": ({}, set()),
    "nothing moves": (dict(effects=RESTS, seed=1), set()),
    "stage 1": (dict(stage=1), STAGES_1_AND_2),
    "stage 2": (dict(stage=2), STAGES_1_AND_2),
    "stage 3": (dict(stage=3), {"psi_p", "psi_q", "grid"}),
    "weights of pixels": (dict(stage=3, body=True), {"psi_p", "psi_q", "grid"}),
    "few effects": (dict(effects=MOVES, seed=1), set()),
    "turning": (dict(effects=TURNS, seed=1), set()),
    "time net and skip of D3DGS": (dict(changes=D3DGS), set()),
}


@pytest.mark.parametrize("name", few(SETTINGS, 2))
def test_every_array_has_its_gradient(name, monkeypatch):
    arguments, without_gradient = SETTINGS[name]
    p, *others = setting(**arguments)
    names = check(p, *others, monkeypatch)
    stems, with_gradient = ({name.split(".")[0] for name in some} for some in (p.arrays, names))
    assert stems - with_gradient == without_gradient
    assert ("psi_d" in stems) == (name != "nothing moves") and ("psi_t" in stems) == ("D3" in name)


def test_every_array_with_coded_networks(monkeypatch):
    """The errors of rounding are held, as straight-through assumes."""
    p, design, fixed, view, u = setting(changes=dict(coded=True), seed=2)
    layout = coded_networks.Layout(p, design.layers())
    fixed = fixed._replace(coded=layout, network_price=0.3)
    names = check(p, design, fixed, view, u, monkeypatch)
    assert set(names) == set(p.arrays)


def test_gradient_checker_sees_a_lost_factor(monkeypatch):
    """The check rejects a gradient that forgets the logarithm of l, a fault of real codes."""
    p, design, fixed, view, u = setting(stage=2)
    real = objective.loss

    def forgetful(*inputs):
        losses, seen, back = real(*inputs)
        gradients, mean2d = back()
        gradients["log_l"][...] /= np.exp(p["log_l"])
        return losses, seen, lambda: (gradients, mean2d)

    monkeypatch.setattr(objective, "loss", forgetful)
    with pytest.raises(AssertionError, match="log_l"):
        check(p, design, fixed, view, u, monkeypatch)
