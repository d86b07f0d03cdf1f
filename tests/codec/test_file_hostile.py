"""Damaged and forged files, and models that the format cannot hold, are refused by name."""

import dataclasses
import json

import numpy as np
import pytest

from p4dgs_ref.codec.container import (
    SECTIONS,
    BitstreamError,
    EncodeError,
    write_container,
)
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.gaussian_table import MU_LIMIT
from p4dgs_ref.codec.header import check_work, declared_numbers, read_header
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.limits import MAX_NUMBERS, MAX_OF
from p4dgs_ref.report.inspect import ledger
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import PRESETS
from tests.codec.models import MAKE, changed, random_model, refusal, with_header
from tests.workshop.damage import sections_in
from tests.workshop.sample_model import sample_model

# An overflow or a NaN on the way is a failure, too.
pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="module")
def model():
    return MAKE["random"]()


@pytest.fixture(scope="module")
def sections(model):
    return sections_in(encode(model))


def refused(sections, where, why=""):
    """Check that a forged file with valid checksums is refused in this section."""
    data = write_container(sections)
    for read in (decode, ledger):
        error = refusal(read, data)
        assert error.section == where and why in error.message


@pytest.mark.parametrize("name", SECTIONS)
def test_every_section_is_needed_and_has_one_length(sections, name):
    without = {key: body for key, body in sections.items() if key != name}
    refused(without, name, "section is missing")
    body = sections[name]
    shorter = (b"", body[:-1], body[: len(body) // 2], body[1:])
    for wrong in (*shorter, body + b"\0", body + bytes(4), body + body):
        refused({**sections, name: wrong}, name)


def test_a_scene_without_motion_may_not_have_the_section_for_it(sections):
    static = sections_in(encode(MAKE["static"]()))
    moving = {**static, "deformation_mlp": sections["deformation_mlp"]}
    without_effect = with_header(sections, effects=["view_color", "view_geometry"])
    for forged in (moving, without_effect):
        refused(forged, "deformation_mlp", "no effect that needs")


def test_other_counts_do_not_fit_the_sections(sections):
    anchors = json.loads(sections["header"])["anchors"]
    for name, value, where in (
        ("anchors", anchors + 1, "positions"),
        ("d", 5, "anchor_mlps"),
        ("F", 2, "context_mlps"),
        ("L_x", 3, "deformation_mlp"),
        ("L_t", 1, "deformation_mlp"),
        ("effects", ["rotation"], "anchor_mlps"),
        ("grid", [["xyz", 5]] + 3 * [["xy", 8]], "hash_grid"),
        ("table", [8, 8], "hash_grid"),
        ("anchors", 2**22, "header"),
    ):
        refused(with_header(sections, **{name: value}), where)


# Values that no field of their kind may have.
NO_INTEGERS = [0, 1.0, True, "4", 10**400]
NO_WIDTHS = [4, {}, [0], [True], [2**15], [8] * 9]
NO_GRIDS = [
    *NO_WIDTHS,
    [],
    [["xyz", 8, 8]],
    [["zyx", 8]],
    [[8, "xyz"]],
    [[["xy"], 8]],
    [["xy", 2**16 + 1]],
    [["xy", 8]] * 65,
]
NO_STEPS = [
    1,
    [1] * 3,
    *([1, 1, 1, v] for v in (0, True, 1e31, 10**400, float("nan"))),
]
NO_OPACITIES = [True, "0", 1.5, -(2.0**-1074), float("nan")]
NO_COLORS = [None, [1] * 4, [1, 1, "1"], [1, 1, float("-inf")]]
NO_EFFECTS = ["view_color", ["wind"], [["rotation"]], ["occlusion"] * 2]
NONSENSE = {
    **{name: [*NO_INTEGERS, most + 1] for name, most in {"anchors": 2**22, **MAX_OF}.items()},
    "hidden": NO_WIDTHS,
    "deformation": NO_WIDTHS,
    "context": NO_WIDTHS,
    "grid": NO_GRIDS,
    "table": [*NO_WIDTHS, [8], [8, 8, 8], [8, 2**24 + 1]],
    "Q_0": NO_STEPS,
    "tau_alpha": NO_OPACITIES,
    "background": NO_COLORS,
    "effects": NO_EFFECTS,
}


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_in_the_header_names_the_field(sections, name):
    for value in NONSENSE[name]:
        refused(with_header(sections, **{name: value}), "header", f"field {name!r}")
    refused(with_header(sections, **{name: ...}), "header", "expected the fields")


def test_headers_that_are_not_such_an_object(sections):
    header = sections["header"]
    for bad in (
        b"[]",
        json.dumps([[name, value] for name, value in json.loads(header).items()]).encode(),
        b"\xef\xbb\xbf" + header,
        header + b"x",
        header[:-1] + b',"more":1}',
        b"[" * 10**5,
        header.replace(b'"d":', b'"\xe9":'),
        header.replace(b'"d":4', b'"d":' + b"4" * 5000),
        header.replace(b'"k":2', b'"k":2,"k":2'),
        header.decode().encode("utf-16"),
    ):
        assert bad != header
        refused({**sections, "header": bad}, "header")


@pytest.mark.parametrize("name", ["anchor_mlps", "context_mlps", "deformation_mlp"])
def test_weights_that_are_not_finite_are_refused_by_their_place(sections, name):
    body = sections[name]
    for at in (0, 14, len(body) - 2):
        for pattern in (0x7C00, 0xFC00, 0x7E00):  # both infinities, NaN
            spoilt = body[:at] + pattern.to_bytes(2, "little") + body[at + 2 :]
            refused({**sections, name: spoilt}, name, "expected finite weights")
            assert refusal(decode, write_container({**sections, name: spoilt})).offset == at


def test_invalid_boxes_are_refused(sections):
    body = sections["positions"]
    lo, hi = body[:12], body[12:24]
    patterns = (0x7F800000, 0x7FC00000, 0x7F000000)  # infinity, NaN, 1.7e38
    numbers = [np.array(pattern, "<u4").tobytes() for pattern in patterns]
    low, high = [lo[:4] + v + lo[8:] + hi for v in numbers], [lo + hi[:8] + v for v in numbers]
    for box in (hi + lo, *low, *high):
        forged = {**sections, "positions": box + body[24:]}
        refused(forged, "positions", "expected a box with lo <= hi")


def test_the_largest_weights_keep_the_context_finite():
    """The most layers, weights at float16's limit, the smallest and the largest base steps."""
    steps = dict(Q_f=2.0**-100, Q_s=2.0**-100, Q_l=2.0**100, Q_O=2.0**-100)
    model = random_model(8, context=(6,) * 8, **steps)
    for sign in (1.0, -1.0):
        networks = {
            name: (
                [np.full_like(W, 65504) for W in weights],
                [np.full_like(b, sign * 65504) for b in biases],
            )
            for name, (weights, biases) in model.networks.items()
        }
        nothing = {name: 0 * getattr(model.anchors, name) for name in ("f_a", "s_a", "l_a", "O_a")}
        data = encode(dataclasses.replace(changed(model, **nothing), networks=networks))
        ctx = quantise(decode(data)).context
        assert np.isfinite(ctx.q).all()
        assert sign < 0 or np.abs(ctx.mu_units).max() == MU_LIMIT
        assert all(np.isfinite(row["estimate_bytes"]) for row in ledger(data))


@pytest.mark.parametrize("name", ["psi_alpha", "psi_p", "psi_d"])
@pytest.mark.parametrize("value", [65520.0, np.nan])
def test_weights_beyond_float16_name_the_network(model, name, value):
    weights, biases = model.networks[name]
    for spoilt in (
        ([weights[0] + value, *weights[1:]], biases),
        (weights, [*biases[:-1], biases[-1] + value]),
    ):
        with pytest.raises(EncodeError, match=f"network {name}: expected finite weights"):
            encode(dataclasses.replace(model, networks={**model.networks, name: spoilt}))
    # 65519 rounds to 65504, the largest number of float16
    largest = [np.full_like(weights[0], 65519.0), *weights[1:]]
    networks = {**model.networks, name: (largest, biases)}
    assert encode(dataclasses.replace(model, networks=networks))


@pytest.mark.parametrize("name", ["x_a", "f_a", "s_a", "l_a", "O_a"])
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_numbers_that_are_not_finite_name_the_array(model, name, value):
    array = getattr(model.anchors, name).copy()
    array[np.flatnonzero(model.anchors.mask.all(axis=1))[0]] = value
    with pytest.raises(EncodeError, match=rf"anchors {name}: expected finite numbers"):
        encode(changed(model, **{name: array}))


def test_invalid_grids_backgrounds_boxes_and_anchors_are_named(model):
    lo, hi = model.box
    grids = [model.grids[0], model.grids[1] * np.nan, *model.grids[2:]]
    none = type(model.anchors)(*(array[:0] for array in model.anchors))
    for change, message in (
        (dict(grids=grids), "hash grid level 1: expected finite"),
        (dict(background=np.array([0.1, np.nan, 0.2])), "field 'background': expected a number"),
        (dict(box=(hi, lo)), "box: expected"),
        (dict(box=(lo, hi * np.inf)), "box: expected"),
        (dict(box=(lo, np.full(3, 1e39))), "box: expected"),
        (dict(anchors=none), "anchors mask: expected booleans for at least one anchor"),
    ):
        with pytest.raises(EncodeError, match=message):
            encode(dataclasses.replace(model, **change))


@pytest.mark.parametrize("name, group", [("f_a", 0), ("s_a", 1), ("l_a", 2), ("O_a", 3)])
def test_huge_symbols_name_the_array(model, name, group):
    anchor = np.flatnonzero(model.anchors.mask.all(axis=1))[0]
    step = quantise(model).context.q[model.anchors.mask.any(axis=1)[:anchor].sum(), group]
    array = getattr(model.anchors, name).copy()
    array[anchor] = step * (2.0**31 - 1)
    large = changed(model, **{name: array})
    assert np.abs(quantise(large).symbols).max() == 2**31 - 1
    assert getattr(decode(encode(large)).anchors, name).max() == step * (2.0**31 - 1)
    array[anchor] = step * -(2.0**31)
    largest = encode(changed(model, **{name: array}))
    assert getattr(decode(largest).anchors, name).min() == step * -(2.0**31)
    assert encode(decode(largest)) == largest
    array[anchor] = step * -(2.0**31 + 1)
    with pytest.raises(OverflowError, match=rf"anchors {name}, .*: expected \|f/q\| up to 2\^31"):
        encode(changed(model, **{name: array}))


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("tau_alpha", 2.0, "'tau_alpha': expected a number from 0"),
        ("effects", ("view_color", "wind"), "'effects': expected some of"),
        ("grid", (), "expected a list of 1 to 64"),
        ("Q_0", (1.0, 0.0, 1.0, 1.0), "'Q_0': expected a number from"),
    ],
)
def test_designs_beyond_the_header_are_not_written(model, field, value, message):
    """The model is consistent, but the header of a file cannot describe it."""
    design = dataclasses.replace(model.design, **{field: value})
    networks = {
        name: ([np.zeros(shape) for shape in pairs], [np.zeros(n) for _, n in pairs])
        for name, pairs in design.layers().items()
    }
    spoilt = dataclasses.replace(
        model, design=design, networks=networks, grids=model.grids if design.grid else []
    )
    with pytest.raises(EncodeError) as caught:
        encode(spoilt)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "field, value, message",
    [
        ("d", 5, "anchors f_a: expected"),
        ("k", 3, "anchors O_a: expected"),
        ("F", 2, "hash grid: expected"),
        ("hidden", (8, 7), "network psi_alpha: expected"),
        ("context", (8,), "network psi_p: expected"),
        ("effects", ("view_color", "view_geometry"), "network psi_d: expected None"),
    ],
)
def test_arrays_that_contradict_the_design_are_named(model, field, value, message):
    with pytest.raises(EncodeError, match=message):
        encode(
            dataclasses.replace(model, design=dataclasses.replace(model.design, **{field: value}))
        )


# --- Time ---


def test_work_is_bounded_by_the_bytes_of_the_file(sections):
    """The largest grids cost milliseconds for every anchor, whose position has six bytes."""
    size = sum(map(len, sections.values()))
    costly = {"grid": [["xyz", 2]] * 64, "F": 64}
    for anchors, message in ((9000, "multiplications declared"), (4000, "expected")):
        where = "header" if anchors == 9000 else "positions"
        refused(with_header(sections, anchors=anchors, **costly), where, message)
    many = with_header(sections, grid=[["xyz", 200]], F=1, table=[2**23, 8])
    refused({**many, "hash_grid": bytes(4)}, "header", "8002409 numbers declared")
    design = dataclasses.replace(read_header(sections["header"])[0], grid=(("xyz", 2),) * 64, F=64)
    layers = [layer for name in ("psi_p", "psi_q") for layer in design.layers()[name]]
    of_one = sum(rows * columns for rows, columns in layers) + 64 * 8 * 64 * (64 + 8)
    most = (2**34 + 2**15 * size) // of_one
    check_work(design, most, size)
    with pytest.raises(BitstreamError, match="multiplications declared"):
        check_work(design, most + 1, size)
    check_work(design, most + 1, size + of_one // 2**15 + 1)


@pytest.mark.parametrize("name", PRESETS)
def test_files_of_all_presets_are_within_the_bounds_of_work(name):
    """Even if every stream is empty, so that an anchor has the six bytes of its position alone."""
    design = design_of(PRESETS[name], MODEL_EFFECTS)
    fixed, per_anchor = declared_numbers(design, 0), declared_numbers(design, 1)["anchors"]
    most = (MAX_NUMBERS - sum(fixed.values())) // per_anchor
    for anchors in (1, 1000, 20_000, 100_000, most):
        check_work(design, anchors, 6 * anchors + 2 * fixed["networks"])


def test_models_that_no_decoder_may_read_are_not_written():
    fields = dict(grid=(("xyz", 170),), F=1, table=(2**23, 16), context=())
    model = sample_model(1, 1, **fields)
    uniform = dataclasses.replace(model, grids=[np.ones_like(grid) for grid in model.grids])
    with pytest.raises(EncodeError, match="design: 49.* numbers declared, expected at most"):
        encode(uniform)
