"""The model's file: what is decoded is what was quantised, to the bit, and sizes are those of the entropy."""

import dataclasses
import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.codec.container import read_container, write_container
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS, decode, encode, quantised_of
from p4dgs_ref.codec.inspect import components, ledger
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.codec.streams import decode_bits
from p4dgs_ref.equations import hash_grid, likelihood, prior
from p4dgs_ref.model import Anchors, context, join, split
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.training.initial import design_of, initial_parameters
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import SMOKE
from p4dgs_ref.training.trainer import assemble

CAMERAS = [
    look_at(eye, (0, 0, 0), 30.0, 28.0, 40, 24) for eye in ((1.5, -2.5, 1.0), (-0.4, 2.8, 0.6))
]


def random_model(seed=0, effects=MODEL_EFFECTS, points=None, **changes):
    """A model with every array awake: attributes drawn from the prior of its own context, three children in four."""
    rng = np.random.default_rng(seed)
    preset = SMOKE._replace(deformation_gain=0.3, **changes)
    design = design_of(preset, effects)
    p = Parameters(initial_parameters(preset, design, rng, points).arrays)
    last = f"psi_p.b{len(design.context)}"
    p[last][...] = rng.uniform(-5, 0.5, p[last].shape)  # of raw sigma: from fine to coarse
    p[last][prior.layout(design.widths)[0]] = np.repeat(
        [0.0, 2.0, 0.0], (design.d, 6, 3 * design.k)
    )
    for name in p.arrays:
        if name.startswith("grid"):
            p[name][...] = np.where(rng.random(p[name].shape) < 0.3, 1, -1) * rng.random(
                p[name].shape
            )
            p[name][:1] = -0.0  # zero of either sign counts as +1
    mask = rng.random((len(p["x_a"]), design.k)) < 0.75
    mask[0, 0] = True  # one anchor at least stays
    model = assemble(p, design, mask, None, rng.random(3))
    corners = [c.astype(float) for c in model.box]
    located = hash_grid.locate(
        model.anchors.x_a, *corners, design.grid, [T for T, _ in design.levels()]
    )
    ctx, _ = context(design, model.networks, model.grids, located)
    f, s, l, O = split(ctx.mu + ctx.sigma * rng.normal(size=ctx.mu.shape), design)
    return changed(model, f_a=f, s_a=s, l_a=l, O_a=O)


def changed(model, **arrays):
    """The model with some of its anchors' arrays replaced."""
    return dataclasses.replace(model, anchors=model.anchors._replace(**arrays))


def flat(seed):
    return np.random.default_rng(seed).uniform(-1, 1, (30, 3)) * [1, 1, 0] + [0, 0, 0.3]


MAKE = {
    "trained": lambda: p4.train(p4.load_scene("bouncing"), preset="smoke"),
    "random": lambda: random_model(1),
    "many": lambda: random_model(
        2,
        anchors=2500,
        d=16,
        k=3,
        hidden=(32, 32),
        context=(32,),
        F=3,
        grid_2d=(8, 40),
        table_2d=300,
    ),
    "static": lambda: random_model(3, ("view_color", "occlusion", "background")),
    "no_effects": lambda: random_model(4, (), k=1, hidden=(), context=(), grid_3d=(), grid_2d=(5,)),
    "turning": lambda: random_model(
        5, ("rotation", "view_geometry"), deformation=(), grid_3d=(3, 4), grid_2d=()
    ),
    "flat": lambda: random_model(6, points=flat(6), grid_3d=(1, 6)),
    "one_anchor": lambda: random_model(7, anchors=1, d=1, k=1),
}


@pytest.fixture(scope="module", params=MAKE)
def made(request):
    """A model, its quantised form, its file and what is decoded from it."""
    model = MAKE[request.param]()
    data = encode(model)
    return model, quantise(model), data, decode(data)


@pytest.fixture(scope="module")
def model():
    return MAKE["random"]()


def arrays_of(model):
    """Every array of a model by name."""
    arrays = {
        **model.anchors._asdict(),
        "lo": model.box[0],
        "hi": model.box[1],
        "background": model.background,
    }
    arrays.update({f"grid.{i}": grid for i, grid in enumerate(model.grids)})
    for name, pair in model.networks.items():
        arrays.update(
            {f"{name}.{kind}{i}": a for kind, part in zip("Wb", pair) for i, a in enumerate(part)}
        )
    return arrays


def digest(model):
    """SHA-256 over names, types, shapes and bytes of all arrays."""
    parts = [
        (name, a.dtype.str, a.shape, a.tobytes()) for name, a in sorted(arrays_of(model).items())
    ]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def test_decoded_is_quantised_to_the_bit(made):
    _, quantised, data, decoded = made
    expected, found = arrays_of(quantised.model), arrays_of(decoded)
    assert set(found) == set(expected)
    for name, a in expected.items():
        assert found[name].dtype == a.dtype and found[name].shape == a.shape, name
        assert found[name].tobytes() == a.tobytes() and (
            found[name].strides == a.strides or not a.size
        ), name
    assert repr(decoded.design) == repr(quantised.model.design)
    again = quantised_of(read_container(data))
    for a, b in zip(
        (again.positions, again.symbols, again.kept, *again.context),
        (quantised.positions, quantised.symbols, quantised.kept, *quantised.context),
    ):
        assert np.array_equal(a, b)


def test_pictures_are_those_of_the_quantised_model(made):
    _, quantised, _, decoded = made
    for camera, t in zip(CAMERAS, (0.0, 0.61)):
        picture = decoded.render(camera, t)
        assert np.isfinite(picture).all() and np.array_equal(
            picture, quantised.model.render(camera, t)
        )


def test_the_same_bytes_again(made):
    model, _, data, decoded = made
    assert encode(model) == data
    assert encode(decoded) == data  # symbols times q, divided by q, round to the symbols
    assert write_container(read_container(data)) == data


@pytest.mark.parametrize("threads", ["1", "3"])
def test_another_process_decodes_the_same(tmp_path, threads):
    for name in ("trained", "many"):
        path = tmp_path / f"{name}.p4dgs"
        path.write_bytes(encode(MAKE[name]()))
        code = (
            "import sys; sys.path.insert(0, sys.argv[1]); from test_file import *\n"
            "data = open(sys.argv[2], 'rb').read(); model = decode(data)\n"
            "print(digest(model), encode(model) == data)"
        )
        out = subprocess.run(
            [sys.executable, "-W", "error", "-c", code, os.path.dirname(__file__), path],
            env={**os.environ, "OPENBLAS_NUM_THREADS": threads},
            capture_output=True,
            text=True,
        )
        assert out.stdout.split() == [digest(decode(path.read_bytes())), "True"], out.stderr


def test_rounding_is_the_papers(made):
    """Within half a step of what was trained; positions within half a node; networks and grids as Q18 and Eq. (9)."""
    model, (rounded, positions, symbols, kept, ctx), _, decoded = made
    alive = model.anchors.mask.any(axis=1)
    before = join(Anchors(*(a[alive] for a in model.anchors)))
    q = np.repeat(ctx.q, model.design.widths, axis=1)
    assert np.array_equal(
        kept[:, -3 * model.design.k :], np.repeat(model.anchors.mask[alive], 3, axis=1)
    )
    assert np.all(np.abs(join(rounded.anchors) - before)[kept] <= (q / 2)[kept] * (1 + 1e-12))
    assert not join(decoded.anchors)[~kept].any() and np.array_equal(
        symbols * q, join(decoded.anchors)
    )
    node = (model.box[1].astype(float) - model.box[0]) / 65535
    assert np.all(np.abs(decoded.anchors.x_a - model.anchors.x_a[alive]) <= node * 0.5001)
    assert positions.min() >= 0 and (positions.max(axis=0) <= np.where(node > 0, 65535, 0)).all()
    for name, pair in model.networks.items():
        for a, b in zip(sum(pair, []), sum(decoded.networks[name], [])):
            assert np.array_equal(a.astype(np.float16), b)
    for a, b in zip(model.grids, decoded.grids, strict=True):
        assert np.array_equal(np.where(a >= 0, 1, -1), b)


def test_integer_context_stays_beside_the_float_context(made):
    """The coder's integers are the float model's, to a lattice unit and the fixed-point error, and so are the bits."""
    _, (rounded, _, symbols, kept, ctx), _, _ = made
    design, corners = rounded.design, [c.astype(float) for c in rounded.box]
    located = hash_grid.locate(
        rounded.anchors.x_a, *corners, design.grid, [T for T, _ in design.levels()]
    )
    exact, _ = context(design, rounded.networks, rounded.grids, located)
    unit = 2 * np.array(design.Q_0) / 2**16
    assert np.all(np.abs(ctx.q - exact.q) <= 0.75 * unit + 3e-4 * exact.q)
    assert np.array_equal(np.rint(ctx.q / unit) * unit, ctx.q)
    q = np.repeat(ctx.q, design.widths, axis=1)
    mu, sigma = ctx.mu_units / 1024 * q, 2.0 ** (ctx.sigma_units / 16) * q
    assert np.all(np.abs(mu - exact.mu) <= 0.001 * q + 0.01 * exact.sigma + 1e-5 * np.abs(exact.mu))
    assert np.all(np.abs(np.log2(sigma / exact.sigma)) <= 0.51 / 16)
    wanted, got = (
        likelihood.forward(symbols * q, *prior, q)[0].bits[kept].sum()
        for prior in ((exact.mu, exact.sigma), (mu, sigma))
    )
    assert abs(got - wanted) <= 1e-3 * wanted


def test_sections_read_by_hand(model):
    """A reader written from the format's description alone finds the numbers where it says they are."""
    sections, decoded = read_container(encode(model)), decode(encode(model))
    A, design = len(decoded.anchors.mask), decoded.design
    header = json.loads(sections["header"])
    assert header["anchors"] == A and header["grid"] == [
        ["xyz", 4],
        ["xy", 8],
        ["xz", 8],
        ["yz", 8],
    ]
    assert header["background"] == decoded.background.tolist() and header["effects"] == list(
        MODEL_EFFECTS
    )
    box = np.frombuffer(sections["positions"][:24], "<f4").astype(float).reshape(2, 3)
    x = np.frombuffer(sections["positions"][24:], "<u2").reshape(A, 3) / 65535
    assert np.allclose(box[0] + x * (box[1] - box[0]), decoded.anchors.x_a, rtol=0, atol=1e-12)
    assert np.array_equal(
        decode_bits(sections["masks"], A * design.k), decoded.anchors.mask.ravel()
    )
    signs = decode_bits(sections["hash_grid"], 64 + 3 * 64)
    assert np.array_equal(signs, np.concatenate([g.ravel() for g in decoded.grids]) > 0)
    for section, names in (
        ("anchor_mlps", "alpha c r s"),
        ("context_mlps", "p q"),
        ("deformation_mlp", "d"),
    ):
        stored = np.frombuffer(sections[section], "<f2")
        layers = [pair for name in names.split() for pair in zip(*decoded.networks[f"psi_{name}"])]
        assert np.array_equal(stored, np.concatenate([np.append(W, b) for W, b in layers]))


def test_what_does_not_move_has_no_section():
    everything = set(read_container(encode(MAKE["random"]())))
    for name in ("static", "no_effects"):
        assert everything - set(read_container(encode(MAKE[name]()))) == {"deformation_mlp"}
    turning = read_container(encode(MAKE["turning"]()))["deformation_mlp"]
    assert len(turning) == 2 * 4 * (
        1 + 3 * 5 + 5
    )  # one head of four outputs on E(x) and E(t), L = 2


def test_sizes_are_those_of_the_entropy(made):
    """Every section against its content or its entropy under the float model, steps not on the coder's lattice."""
    _, (rounded, _, symbols, kept, _), data, _ = made
    rows = {row["name"]: row for row in ledger(data)}
    assert sum(row["bytes"] for row in rows.values()) == sum(components(data).values()) == len(data)
    assert {name: len(body) for name, body in read_container(data).items()} == {
        name: row["bytes"] for name, row in rows.items() if name != "container"
    }
    design, A = rounded.design, len(kept)
    assert rows["positions"]["bytes"] == 24 + 6 * A and rows["container"]["bytes"] == 18 + 9 * (
        len(rows) - 1
    )
    for section, members in (
        ("anchor_mlps", "alpha c r s"),
        ("context_mlps", "p q"),
        ("deformation_mlp", "d"),
    ):
        arrays = [
            a
            for m in members.split()
            for part in rounded.networks.get(f"psi_{m}", ())
            for a in part
        ]
        assert sum(a.size for a in arrays) * 2 == (rows[section]["bytes"] if arrays else 0)
    located = hash_grid.locate(
        rounded.anchors.x_a,
        *(c.astype(float) for c in rounded.box),
        design.grid,
        [T for T, _ in design.levels()],
    )
    exact = context(design, rounded.networks, rounded.grids, located)[0]
    free = np.repeat(exact.q, design.widths, axis=1)
    bits = np.where(
        kept, likelihood.forward(symbols * free, exact.mu, exact.sigma, free)[0].bits, 0
    )
    groups = [part.sum() for part in np.split(bits, np.cumsum(design.widths[:3]), axis=1)]
    estimate = dict(zip(ATTRIBUTE_SECTIONS, groups))
    signs = np.concatenate([g.ravel() for g in rounded.grids]) > 0
    for name, flags in (("masks", rounded.anchors.mask), ("hash_grid", signs)):
        share = [np.mean(flags), 1 - np.mean(flags)]
        estimate[name] = -np.size(flags) * sum(p * np.log2(p) for p in share if p)
    for name, ideal in estimate.items():
        assert abs(rows[name]["estimate_bytes"] - ideal / 8) <= 0.003 * ideal / 8 + 1, name
        assert abs(rows[name]["bytes"] - ideal / 8) <= 0.01 * ideal / 8 + 64, name
    listed = sum(row["bytes"] for name, row in rows.items() if name not in estimate)
    total = sum(estimate.values()) / 8
    assert abs(len(data) - listed - total) <= 0.01 * total + 64
    assert [rows[name]["symbols"] for name in ATTRIBUTE_SECTIONS] == [
        A * design.d,
        3 * A,
        3 * A,
        3 * rounded.anchors.mask.sum(),
    ]


def test_inspect_prints_sections_that_sum_to_the_file(model, tmp_path, capsys):
    path = tmp_path / "model.p4dgs"
    path.write_bytes(encode(model))
    assert cli.run(["inspect", str(path), "--json"], 0.0) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (
        sum(row["bytes"] for row in printed["sections"]) == printed["bytes"] == path.stat().st_size
    )
    assert {"header", "positions", "offsets", "context_mlps"} < {
        row["name"] for row in printed["sections"]
    }


def test_masked_children_and_dead_anchors_leave_no_trace(model):
    """Nothing of them is coded, whatever numbers they hold."""
    mask = model.anchors.mask.copy()
    mask[:2], mask[2] = False, [True, False]
    before = changed(model, mask=mask)
    poison = {name: a.copy() for name, a in before.anchors._asdict().items()}
    for name in ("f_a", "s_a", "l_a", "x_a"):
        poison[name][:2] = [[np.nan], [1e300]]
    poison["O_a"][~mask] = 1e300
    data = encode(before)
    assert encode(changed(model, **poison)) == data
    decoded = decode(data)
    assert (
        np.array_equal(decoded.anchors.mask, mask[mask.any(axis=1)])
        and len(decoded.anchors.mask) < len(mask) - 1
    )
    kept = dict(anchors=Anchors(*(a[mask.any(axis=1)] for a in before.anchors)))
    assert encode(dataclasses.replace(before, **kept)) == data


def test_everything_masked_leaves_one_anchor_and_the_background(model):
    data = encode(changed(model, mask=np.zeros_like(model.anchors.mask)))
    decoded = decode(data)
    assert decoded.anchors.mask.shape == (1, 2) and not decoded.anchors.mask.any()
    assert len(read_container(data)["offsets"]) == 0 and encode(decoded) == data
    picture = decoded.render(CAMERAS[0], 0.5)
    assert np.array_equal(
        picture, np.broadcast_to(decoded.background.astype(picture.dtype), (24, 40, 3))
    )
    assert sum(row["bytes"] for row in ledger(data)) == len(data)


def test_the_order_of_axes_in_memory_does_not_matter(model):
    networks = {
        name: tuple([*map(np.asfortranarray, part)] for part in pair)
        for name, pair in model.networks.items()
    }
    turned = dataclasses.replace(
        model,
        anchors=Anchors(*map(np.asfortranarray, model.anchors)),
        networks=networks,
        grids=[*map(np.asfortranarray, model.grids)],
    )
    assert not turned.networks["psi_p"][0][0].flags.c_contiguous and encode(turned) == encode(model)
    for name, a in arrays_of(quantise(turned).model).items():
        assert a.strides == arrays_of(quantise(model).model)[name].strides, name


def test_whole_numbers_in_the_design_and_float64_boxes_are_brought_to_the_files_precision(model):
    design = model.design._replace(Q_0=(1, 1, 1, 1), tau_alpha=0)
    box = tuple(c.astype(float) + shift for c, shift in zip(model.box, (-1e-9, 1e-9)))
    model = dataclasses.replace(model, design=design, box=box)
    decoded, rounded = decode(encode(model)), quantise(model).model
    assert encode(decoded) == encode(model) and digest(decoded) == digest(rounded)
    assert decoded.design.Q_0 == (1, 1, 1, 1) and "(1.0, 1.0" in repr(decoded.design) == repr(
        rounded.design
    )
