"""Models that several tests of the codec encode and decode."""

import contextlib
import dataclasses
import hashlib
import json
import tracemalloc
from functools import cache

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec.container import BitstreamError, write_container
from p4dgs_ref.equations import hash_grid, prior
from p4dgs_ref.limits import MAX_OF
from p4dgs_ref.model import context, split
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.training.fit import fit
from p4dgs_ref.training.initial import design_of, initial_parameters
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import assemble
from tests.workshop.damage import sections_in


def random_model(seed=0, effects=MODEL_EFFECTS, points=None, **changes):
    """A model without zeros: attributes drawn from its own prior, three children of four kept.

    `changes` replace fields of the preset.
    """
    rng = np.random.default_rng(seed)
    preset = dataclasses.replace(SMOKE, deformation_gain=0.3, **changes)
    design = design_of(preset, effects)
    p = Parameters(initial_parameters(preset, design, rng, points).arrays)
    last = f"psi_p.b{len(design.context)}"
    p[last][...] = rng.uniform(-5, 0.5, p[last].shape)  # raw deviations from fine to coarse
    means = np.repeat([0.0, 2.0, 0.0], (design.d, 6, 3 * design.k))
    p[last][prior.layout(design.widths)[0]] = means
    for name in p.arrays:
        if name.startswith("grid"):
            signs = np.where(rng.random(p[name].shape) < 0.3, 1, -1)
            p[name][...] = signs * rng.random(p[name].shape)
            p[name][:1] = -0.0  # zero of either sign counts as +1
    mask = rng.random((len(p["x_a"]), design.k)) < 0.75
    mask[0, 0] = True  # at least one anchor stays
    model = assemble(p, design, mask, None, rng.random(3))
    ctx = exact_context(model)
    f, s, l, O = split(ctx.mu + ctx.sigma * rng.normal(size=ctx.mu.shape), design)
    return changed(model, f_a=f, s_a=s, l_a=l, O_a=O)


def exact_context(model):
    """The context of a model in floating-point numbers, as the equations compute it."""
    design, corners = model.design, [corner.astype(float) for corner in model.box]
    tables = [T for T, _ in design.levels()]
    located = hash_grid.locate(model.anchors.x_a, *corners, design.grid, tables)
    return context(design, model.networks, model.grids, located)[0]


def changed(model, **arrays):
    """The model with some of its anchors' arrays replaced."""
    return dataclasses.replace(model, anchors=model.anchors._replace(**arrays))


def points_in_a_plane(seed):
    """Thirty points with the same z."""
    return np.random.default_rng(seed).uniform(-1, 1, (30, 3)) * [1, 1, 0] + [0, 0, 0.3]


MANY = dict(
    anchors=2500,
    d=16,
    k=3,
    hidden=(32, 32),
    context=(32,),
    F=3,
    grid_2d=(8, 40),
    table_2d=300,
)
LEAST = dict(k=1, hidden=(), context=(), grid_3d=(), grid_2d=(5,))
TURNING = dict(deformation=(), grid_3d=(3, 4), grid_2d=())

MAKE = {
    "trained": cache(lambda: fit(p4.load_scene("bouncing"), "smoke", 0).model()),
    "random": lambda: random_model(1),
    "many": lambda: random_model(2, **MANY),
    "static": lambda: random_model(3, ("view_color", "occlusion", "background")),
    "no_effects": lambda: random_model(4, (), **LEAST),
    "turning": lambda: random_model(5, ("rotation", "view_geometry"), **TURNING),
    "flat": lambda: random_model(6, points=points_in_a_plane(6), grid_3d=(1, 6)),
    "one_anchor": lambda: random_model(7, anchors=1, d=1, k=1),
}


def refusal(read, *arguments):
    """The error by which damaged data are refused: one line, with the section and the byte."""
    with pytest.raises(BitstreamError) as caught:
        read(*arguments)
    assert caught.value.offset >= 0 and "\n" not in str(caught.value)
    return caught.value


# The ends of the ranges of the header's fields: values that a field may have, and that it may not.
BEYOND = 2.0**20 + 2.0**-32, -(2.0**20) - 2.0**-32
ENDS = {
    "background": (
        [[2**20, -(2**20), 2.0**-1074]],
        [[beyond, 0, 0] for beyond in BEYOND],
    ),
    "hidden": ([[1], [2**14], []], [[0], [2**14 + 1], [1] * 9]),
    "deformation": ([[1] * 8, [2**14]], [[0], [2**14 + 1], [1] * 9]),
    "context": ([[1], [2**14], []], [[0], [2**14 + 1], [1] * 9]),
    "grid": ([[["xyz", 2**16]], [["yz", 1]] * 64], [[], [["xy", 0]], [["xy", 2**16 + 1]]]),
    "table": ([[1, 1], [2**24, 2**24]], [[0, 1], [1, 2**24 + 1], [1]]),
    # An integer is read as the nearest double, too.
    "Q_0": (
        [[2**100, 2.0**-100, 1, 2**100 + 1]],
        [[2**100 + 2**48, 1, 1, 1], [1, 1, 1, 2.0**-101], [1, 1, 1]],
    ),
    "tau_alpha": ([0, 1, 2.0**-1074, -0.0], [-(2.0**-1074), -1, 1 + 2.0**-52]),
    **{name: ([1, most], [0, most + 1]) for name, most in MAX_OF.items()},
}
ENDS_OF_RANGES = [
    (name, value, allowed)
    for name, (inside, outside) in ENDS.items()
    for values, allowed in ((inside, True), (outside, False))
    for value in values
]


def with_header(sections, **fields):
    """The sections with some fields of the header replaced, or removed where the value is `...`."""
    header = {**json.loads(sections["header"]), **fields}
    kept = {name: value for name, value in header.items() if value is not ...}
    return {**sections, "header": json.dumps(kept).encode()}


def with_field(data, name, value):
    """A file with another value of a field of its header."""
    return write_container(with_header(sections_in(data), **{name: value}))


@contextlib.contextmanager
def traced(most):
    """Check that the block allocates at most this many bytes at any time."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= most, f"{peak / 2**20:.1f} MiB, expected at most {most / 2**20:.1f}"


def prefixes(data):
    """All truncations of some data."""
    return [data[:n] for n in range(len(data))]


def flips(data, step=1):
    """The data with every bit flipped, one at a time, or with every bit in `step`."""
    for at in range(0, 8 * len(data), step):
        bad = bytearray(data)
        bad[at // 8] ^= 1 << at % 8
        yield bytes(bad)


def arrays_of(model):
    """Every array of a model, {name: array}."""
    lo, hi = model.box
    arrays = {**model.anchors._asdict(), "lo": lo, "hi": hi, "background": model.background}
    arrays.update({f"grid.{i}": grid for i, grid in enumerate(model.grids)})
    for name, (weights, biases) in model.networks.items():
        arrays.update({f"{name}.W{i}": W for i, W in enumerate(weights)})
        arrays.update({f"{name}.b{i}": b for i, b in enumerate(biases)})
    return arrays


def digest(model):
    """SHA-256 of the names, types, shapes and bytes of all arrays."""
    parts = [
        (name, a.dtype.str, a.shape, a.tobytes()) for name, a in sorted(arrays_of(model).items())
    ]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


# What another process runs to decode the file in its first argument.
DECODE_AND_PRINT = """
import sys
from p4dgs_ref.codec.file import decode, encode
from tests.codec.models import digest
data = open(sys.argv[1], "rb").read()
model = decode(data)
print(digest(model), encode(model) == data)
"""
