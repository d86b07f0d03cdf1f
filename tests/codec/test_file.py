"""The file of a model decodes to the quantised model, bit for bit, and has its entropy's size."""

import dataclasses

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.codec.container import read_container, write_container
from p4dgs_ref.codec.file import (
    ATTRIBUTE_SECTIONS,
    NETWORK_SECTIONS,
    decode,
    encode,
    quantised_of,
)
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.equations import likelihood
from p4dgs_ref.model import ANCHOR_NETWORKS, Anchors, join
from p4dgs_ref.report.inspect import ledger
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.training.fit import fit
from p4dgs_ref.training.presets import SMOKE, TINY
from tests.codec.models import (
    MAKE,
    arrays_of,
    changed,
    digest,
    exact_context,
)
from tests.sampling import few
from tests.workshop.sample_model import sample_model

EYES = ((1.5, -2.5, 1.0), (-0.4, 2.8, 0.6))
CAMERAS = [look_at(eye, (0, 0, 0), 30.0, 28.0, 40, 24) for eye in EYES]


@pytest.fixture(scope="module", params=MAKE)
def made(request):
    """A model, its quantised form, its file, and the decoded file."""
    model = MAKE[request.param]()
    data = encode(model)
    return model, quantise(model), data, decode(data)


@pytest.fixture(scope="module")
def model():
    return MAKE["random"]()


def network_arrays(model, section):
    """The weights and biases of one section, in the order of the file."""
    networks = [model.networks.get(name, ((), ())) for name in NETWORK_SECTIONS[section]]
    return [array for network in networks for layer in zip(*network) for array in layer]


def test_the_decoded_model_is_the_quantised_one_bit_for_bit(made):
    _, quantised, data, decoded = made
    assert digest(decoded) == digest(quantised.model)
    found = arrays_of(decoded)
    for name, a in arrays_of(quantised.model).items():
        assert found[name].strides == a.strides or not a.size, name
    assert repr(decoded.design) == repr(quantised.model.design)
    again = quantised_of(read_container(data))
    for name in ("positions", "symbols", "kept"):
        assert np.array_equal(getattr(again, name), getattr(quantised, name)), name
    assert all(map(np.array_equal, again.context, quantised.context))


def test_encoding_again_gives_the_same_bytes(made):
    model, _, data, decoded = made
    assert encode(model) == data
    assert encode(decoded) == data  # symbols times q, divided by q, round to the symbols
    assert write_container(read_container(data)) == data


@pytest.mark.parametrize(
    "scene, preset",
    few(
        [
            ("static", SMOKE),
            ("orientation", dataclasses.replace(SMOKE, hidden=(24, 40), d=8)),
            (
                "glossy",
                dataclasses.replace(TINY, stage_ends=(4, 6, 12, 20), mask_from=12, anchors=60),
            ),
        ],
        1,
    ),
)
def test_files_of_trainings_encode_to_themselves(scene, preset):
    """The demo's scene with the preset smoke is among the models of the test above."""
    data = encode(fit(p4.load_scene(scene), preset, 3).model())
    assert encode(decode(data)) == data


def cancelling_model(seed, half):
    """A model whose second hidden layer cancels all its inputs, which come in equal pairs.

    Whether a unit of it is positive or 0 depends on the last bits of a sum. Some units of the first
    layer are silent, and without them the sum has another order.
    """
    model = sample_model(seed, 6, d=4, effects=(), hidden=(2 * half, 2 * half))
    silent = np.random.default_rng(seed).random(half) < 0.4
    for name in ANCHOR_NETWORKS:
        (first, second, _), (b_first, b_second, _) = model.networks[name]
        first[:, :half][:, silent], b_first[:half][silent] = 0, -1
        first[:, half:], b_first[half:] = first[:, :half], b_first[:half]
        second[half:], b_second[...] = -second[:half], 0
    return model


def test_units_that_hang_on_the_last_bit_are_removed_until_none_is_silent():
    for seed in range(8):
        data = encode(cancelling_model(seed, half=3 + seed % 13))
        assert encode(decode(data)) == data, seed


def test_rounding_is_that_of_the_paper(made):
    """Attributes move by half a step at most and positions by half a node.

    Networks are rounded to float16 (Q18), and grids keep their signs (Eq. 9).
    """
    model, (rounded, positions, symbols, kept, ctx), _, decoded = made
    alive = model.anchors.mask.any(axis=1)
    before = join(Anchors(*(a[alive] for a in model.anchors)))
    q = np.repeat(ctx.q, model.design.widths, axis=1)
    offsets_kept = np.repeat(model.anchors.mask[alive], 3, axis=1)
    assert np.array_equal(kept[:, -3 * model.design.k :], offsets_kept)
    assert np.all(np.abs(join(rounded.anchors) - before)[kept] <= (q / 2)[kept] * (1 + 1e-12))
    assert not join(decoded.anchors)[~kept].any()
    assert np.array_equal(symbols * q, join(decoded.anchors))
    node = (model.box[1].astype(float) - model.box[0]) / 65535
    assert np.all(np.abs(decoded.anchors.x_a - model.anchors.x_a[alive]) <= node * 0.5001)
    assert np.all((positions >= 0) & (positions <= np.where(node > 0, 65535, 0)))
    for name, pair in model.networks.items():
        for a, b in zip(sum(pair, []), sum(decoded.networks[name], [])):
            assert np.array_equal(a.astype(np.float16), b)
    for a, b in zip(model.grids, decoded.grids, strict=True):
        assert np.array_equal(np.where(a >= 0, 1, -1), b)


def test_the_integer_context_is_close_to_the_float_context(made):
    """They differ by a unit of the coder and the error of fixed point, and cost the same bits."""
    _, (rounded, _, symbols, kept, ctx), _, _ = made
    design, exact = rounded.design, exact_context(rounded)
    unit = 2 * np.array(design.Q_0) / 2**16
    assert np.all(np.abs(ctx.q - exact.q) <= 0.75 * unit + 3e-4 * exact.q)
    assert np.array_equal(np.rint(ctx.q / unit) * unit, ctx.q)
    q = np.repeat(ctx.q, design.widths, axis=1)
    mu, sigma = ctx.mu_units / 1024 * q, 2.0 ** (ctx.sigma_units / 16) * q
    assert np.all(np.abs(mu - exact.mu) <= 0.001 * q + 0.01 * exact.sigma + 1e-5 * np.abs(exact.mu))
    assert np.all(np.abs(np.log2(sigma / exact.sigma)) <= 0.51 / 16)
    wanted = likelihood.forward(symbols * q, exact.mu, exact.sigma, q)[0][kept].sum()
    found = likelihood.forward(symbols * q, mu, sigma, q)[0][kept].sum()
    assert abs(found - wanted) <= 1e-3 * wanted


def test_a_scene_without_motion_has_no_section_for_it():
    everything = set(read_container(encode(MAKE["random"]())))
    for name in ("static", "no_effects"):
        assert everything - set(read_container(encode(MAKE[name]()))) == {"deformation_mlp"}
    turning = read_container(encode(MAKE["turning"]()))["deformation_mlp"]
    inputs = 3 * 5 + 5  # E(x) and E(t) with two frequencies each
    assert len(turning) == 2 * 4 * (inputs + 1)  # one layer of four outputs in float16


def test_sizes_are_those_of_the_entropy(made):
    """Every section has the size of its content, or of its entropy under the float model.

    The steps of the float model are not rounded as the coder's are.
    """
    _, (rounded, _, symbols, kept, _), data, _ = made
    rows = {row["name"]: row for row in ledger(data)}
    design, A = rounded.design, len(kept)
    exact = exact_context(rounded)
    q = np.repeat(exact.q, design.widths, axis=1)
    bits = likelihood.forward(symbols * q, exact.mu, exact.sigma, q)[0]
    groups = np.split(np.where(kept, bits, 0), np.cumsum(design.widths[:3]), axis=1)
    estimate = {name: part.sum() for name, part in zip(ATTRIBUTE_SECTIONS, groups)}
    signs = np.concatenate([g.ravel() for g in rounded.grids]) > 0
    for name, flags in (("masks", rounded.anchors.mask), ("hash_grid", signs)):
        shares = [np.mean(flags), 1 - np.mean(flags)]
        estimate[name] = -np.size(flags) * sum(p * np.log2(p) for p in shares if p)
    for name, ideal in estimate.items():
        assert abs(rows[name]["estimate_bytes"] - ideal / 8) <= 0.003 * ideal / 8 + 1, name
        bytes_of, row = rows[name]["bytes"], rows[name]
        # An outlier may cost less than under the float model, whose tail has no escape.
        assert row["integer_bytes"] - 1 <= bytes_of <= 1.003 * row["estimate_bytes"] + 16, name
    plain = sum(row["bytes"] for name, row in rows.items() if name not in estimate)
    total = sum(estimate.values()) / 8
    assert abs(len(data) - plain - total) <= 0.01 * total + 64
    symbols_of = [rows[name]["symbols"] for name in ATTRIBUTE_SECTIONS]
    assert symbols_of == [A * design.d, 3 * A, 3 * A, 3 * rounded.anchors.mask.sum()]


def test_masked_children_and_dead_anchors_leave_no_trace(model):
    """None of their numbers is coded, whatever its value."""
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
    assert np.array_equal(decoded.anchors.mask, mask[mask.any(axis=1)])
    kept = dict(anchors=Anchors(*(a[mask.any(axis=1)] for a in before.anchors)))
    assert encode(dataclasses.replace(before, **kept)) == data


def test_everything_masked_leaves_one_anchor_and_the_background(model):
    data = encode(changed(model, mask=np.zeros_like(model.anchors.mask)))
    decoded = decode(data)
    assert decoded.anchors.mask.tolist() == [[False, False]]
    assert len(read_container(data)["offsets"]) == 0
    assert encode(decoded) == data
    picture = decoded.render(CAMERAS[0], 0.5)
    background = decoded.background.astype(picture.dtype)
    assert np.array_equal(picture, np.broadcast_to(background, (24, 40, 3)))
    assert sum(row["bytes"] for row in ledger(data)) == len(data)


def test_integers_in_the_design_and_float64_boxes_get_the_types_of_the_file(model):
    design = dataclasses.replace(model.design, Q_0=(1, 1, 1, 1), tau_alpha=0)
    box = tuple(c.astype(float) + shift for c, shift in zip(model.box, (-1e-9, 1e-9)))
    model = dataclasses.replace(model, design=design, box=box)
    decoded, rounded = decode(encode(model)), quantise(model).model
    assert encode(decoded) == encode(model)
    assert digest(decoded) == digest(rounded)
    assert decoded.design.Q_0 == (1, 1, 1, 1)
    assert "(1.0, 1.0" in repr(decoded.design) == repr(rounded.design)
