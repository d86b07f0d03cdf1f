"""The gradient of the whole pipeline against finite differences, for tests of several rooms."""

from dataclasses import replace

import numpy as np

from p4dgs_ref.equations import hash_grid, hash_rate, masking, positional_encoding
from p4dgs_ref.model import bounding_box, snap
from p4dgs_ref.scenes.scene import MODEL_EFFECTS, View
from p4dgs_ref.splatting import fast, tiles
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.training import initial, objective
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import SMOKE
from tests.workshop.cases.hash_rate import surrogate

WIDTH, HEIGHT = 16, 12


SMALL = replace(SMOKE, anchors=9, deformation_gain=1.0, feature_std=0.7, extent=0.6)


def setting(effects=MODEL_EFFECTS, stage=4, seed=0, preset=SMALL, kind=initial):
    """A small model in float64 with every network awake, one view of it, and noise.

    `kind` has the functions `design_of` and `initial_parameters`.
    """
    rng = np.random.default_rng(seed)
    design = kind.design_of(preset, effects)
    p = Parameters(kind.initial_parameters(preset, design, rng).arrays, np.float64)
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
    inputs = objective.StepInputs(
        mask=mask,
        located=located,
        background=np.array([0.9, 0.8, 0.3]),
        stage=stage,
        lambda_rate=0.02,
        lambda_ssim=0.2,
        settings=FAST._replace(dtype="float64", cut=1e-14, stop=0.0),
    )
    return p, design, inputs, view, u


def evaluate(p, design, inputs, view, u, loss=None):
    networks = {name: p.network(name) for name in design.layers()}
    return (loss or objective.loss)(p, design, networks, p.arrays_of("grid"), inputs, view, u)


def hold(p, *others, monkeypatch, loss):
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
        _, rendered, _ = evaluate(p, *others, loss)

    def gather(x, s, r, alpha, color, mask, tau_alpha):
        kept = [a.reshape(-1, a.shape[2])[rendered.index] for a in (x, color, s, r)]
        return (alpha.reshape(-1)[rendered.index], *kept, rendered.index), (
            rendered.index,
            alpha.shape,
        )

    base = p.arrays_of("grid")
    signs_less_base = [np.where(grid >= 0, 1.0, -1.0) - grid for grid in base]

    def query(located, grids):
        signs = [grid + start for grid, start in zip(grids, signs_less_base)]
        h = (located @ np.concatenate(signs)).reshape(-1, len(grids) * grids[0].shape[1])
        return h, read_grids(located, base)[1]

    smooth_rate, (_, saved_rate) = surrogate(base), hash_rate.forward(base)
    return {
        (masking, "forward"): gather,
        # x and t are told apart by their number of columns
        (positional_encoding, "forward"): lambda p, L: encoded[0 if p.shape[1] == 3 else 1],
        (fast, "bin_splats"): lambda *args: lists[0],
        (hash_grid, "query"): query,
        (hash_rate, "forward"): lambda grids: (smooth_rate(grids), saved_rate),
    }


def check(p, *others, monkeypatch, limit=1e-5, loss=None, held=()):
    """Compare the gradient of every array with finite differences along a random direction.

    `loss` is `objective.loss` or another one, `held` more of what `hold` returns. Returns the names
    of the arrays that have a gradient.
    """
    held = {**hold(p, *others, monkeypatch=monkeypatch, loss=loss), **dict(held)}
    _, rendered, back = evaluate(p, *others, loss)
    assert len(rendered.index) > 3 and np.ptp(rendered.image) > 0.1  # something is drawn
    gradients, _ = back()
    rng = np.random.default_rng(5)

    def loss_at(name, change):
        moved = Parameters(p.arrays, np.float64)
        moved[name][...] += change
        with monkeypatch.context() as patch:
            for (module, function), stand_in in held.items():
                patch.setattr(module, function, stand_in)
            return evaluate(moved, *others, loss)[0].L_total

    names = [name for name in p.arrays if gradients[name].any()]
    for name in names:
        direction = rng.normal(size=p[name].shape) * np.maximum(np.abs(p[name]), 0.05)
        terms = gradients[name] * direction
        errors = []
        while min(errors, default=1) > limit:  # one of three step sizes has to agree
            assert len(errors) < 3, (name, errors)
            h = 10.0 ** -(3 + len(errors))
            one = loss_at(name, h * direction) - loss_at(name, -h * direction)
            two = loss_at(name, 2 * h * direction) - loss_at(name, -2 * h * direction)
            error = abs((8 * one - two) / (12 * h) - terms.sum())
            errors.append(error / np.abs(terms).sum())
    return names
