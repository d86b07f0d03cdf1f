"""Vectors of levels L0, L2 and L4: right, not trivial, small; the optimisation trace has its own file."""

import numpy as np
import pytest

from p4dgs_ref.equations import EQUATIONS, FLAGS
from p4dgs_ref.oracle import pipeline
from p4dgs_ref.oracle.pipeline import SUBJECTS_L4
from p4dgs_ref.oracle.scalars import SUBJECTS_L0
from p4dgs_ref.oracle.stages import SUBJECTS_L2
from p4dgs_ref.oracle.undeclared import camera_of
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting.settings import EXACT
from tests.core import test_equations as generic

LEVELS = {"L0": SUBJECTS_L0, "L2": SUBJECTS_L2, "L4": SUBJECTS_L4}
ROWS = [row for rows in LEVELS.values() for row in rows]


def every(*rows, only=lambda eq, case: True):
    return pytest.mark.parametrize(
        "eq, case",
        [
            pytest.param(eq, case, id=f"{eq.key}-{case.name}")
            for _, eq in rows
            for case in eq.cases()
            if only(eq, case)
        ],
    )


def gradients_of(eq, case):
    out, res = eq.forward(**case.inputs)
    return eq.backward(
        res, **generic.draw_cotangents(eq, out, np.random.default_rng(3).standard_normal)
    )


# --- what holds for every equation holds here ------------------------------------------------------------------------
def test_every_subject_blames_an_equation_and_none_bears_the_name_of_one():
    keys = [eq.key for _, eq in ROWS]
    assert len(set(keys)) == len(keys) and not set(keys) & set(EQUATIONS)
    assert {blamed for blamed, _ in ROWS} <= set(EQUATIONS)
    for _, eq in ROWS:
        cases = list(eq.cases())
        assert len(cases) >= (1 if eq.key == "trace" else 2)
        assert len({case.name for case in cases}) == len(cases) and all(
            set(case.flags) <= set(FLAGS) for case in cases
        )


@every(*ROWS, only=lambda eq, case: eq.differentiable and case.smooth)
def test_backward_is_the_adjoint_of_the_derivative(eq, case):
    generic.check_adjoint(eq, case)


@every(*ROWS, only=lambda eq, case: case.expected)
def test_closed_forms(eq, case):
    generic.test_closed_forms(eq, case)


@every(*ROWS, only=lambda eq, case: eq.differentiable and not case.smooth)
def test_on_a_kink_a_closed_form_says_what_the_gradient_is(eq, case):
    assert any(name.endswith("_bar") for name in case.expected)


@every(*ROWS)
def test_declared_shapes_hold(eq, case):
    generic.test_declared_shapes_hold(eq, case)


@every(*SUBJECTS_L0, *SUBJECTS_L2, only=lambda eq, case: eq.key != "lens")
def test_float32_stays_float32(eq, case):
    inputs = {name: generic.cast(a, np.float32) for name, a in case.inputs.items()}
    with np.errstate(all="ignore"):
        out, res = eq.forward(**inputs)
        bars = generic.draw_cotangents(eq, out, np.random.default_rng(4).standard_normal)
        arrays = (
            {**out._asdict(), **eq.backward(res, **bars)} if eq.differentiable else out._asdict()
        )
    for name, a in arrays.items():
        for b in generic.leaves(a):
            assert b.dtype.kind != "f" or b.dtype == np.float32, name


# --- nothing is trivial ----------------------------------------------------------------------------------------------
def has_gradients(eq, case):
    """A single number on or beyond its clamp may have none; heads of zero width give the trunk of psi_d none."""
    single = eq.key in {eq.key for _, eq in SUBJECTS_L0}
    beyond = single and {"saturated", "clamped", "kink"} & set(case.flags)
    return eq.differentiable and case.name != "rests" and not beyond


@every(*SUBJECTS_L0, *SUBJECTS_L2, only=has_gradients)
def test_no_gradient_is_nearly_zero(eq, case):
    for name, gradient in gradients_of(eq, case).items():
        for i, g in enumerate(generic.leaves(gradient)):
            if g.size:
                assert np.linalg.norm(g) > 1e-6, (name, i)
                assert np.mean(g == 0) < 0.9, (name, i, np.mean(g == 0))


@every(*ROWS, only=lambda eq, case: "image" in eq.shapes)
def test_no_image_is_nearly_empty(eq, case):
    image, background = eq(**case.inputs).image, case.inputs["background"]
    assert np.mean(np.abs(image - background).max(axis=2) > 0.05) > 0.3
    assert np.ptp(image, axis=(0, 1)).min() > 0.2  # in every channel
    assert len({*background.round(3)}) == 3 and image.shape[0] != image.shape[1]


def test_a_culled_row_has_neither_place_nor_gradient():
    eq = dict((eq.key, eq) for _, eq in SUBJECTS_L2)["projection_stage"]
    case = next(case for case in eq.cases() if case.name == "some_behind")
    out, bars = eq(**case.inputs), gradients_of(eq, case)
    assert 0 < out.visible.sum() < len(out.visible)
    for a in (*out[:3], *bars.values()):
        assert not a[~out.visible].any() and a[out.visible].all(axis=tuple(range(1, a.ndim))).any()


# --- single numbers --------------------------------------------------------------------------------------------------
def test_hash_rows_in_whole_numbers_without_limit():
    eq = dict((eq.key, eq) for _, eq in SUBJECTS_L0)["hash_index"]
    largest = 0
    for case in eq.cases():
        corners, res, table = (case.inputs[name] for name in ("corner", "res", "table"))
        for corner, row in zip(corners.tolist(), eq(**case.inputs).row.tolist()):
            dense = sum(c * res**i for i, c in enumerate(corner))
            products = [c * prime for c, prime in zip(corner, (1, 2654435761, 805459861))]
            hashed = 0
            for product in products:
                hashed ^= product % 2**32
            assert row == (dense if res ** len(corner) <= table else hashed % table)
            largest = max(largest, *products)
    assert largest > 2**53


def test_bins_are_even_and_rise_towards_the_middle():
    eq = dict((eq.key, eq) for _, eq in SUBJECTS_L0)["gaussian_bin"]
    for case in eq.cases():
        if "tail" in case.flags and "wide" not in case.flags and case.name != "regimes":
            out = eq(**case.inputs)
            assert np.array_equal(out.log_p[::2], out.log_p[1::2])
            assert np.array_equal(out.slope_z[::2], -out.slope_z[1::2])
            assert (
                np.isfinite(out.log_p).all()
                and (np.diff(out.log_p[::2]) < 0).all()
                and (out.slope_z[::2] < 0).all()
            )


# --- frames ----------------------------------------------------------------------------------------------------------
def test_frames_are_those_of_the_decoded_model():
    golden, eq = pipeline.golden_model(), SUBJECTS_L4[0][1]
    exact = [case for case in eq.cases() if case.inputs["renderer"] == "exact"]
    seen = {(case.inputs["t"], case.inputs["focal"][0]) for case in exact}
    assert len(exact) == len(seen) == 6 and len({t for t, _ in seen}) == 3
    for case in exact:
        camera = camera_of(*(case.inputs[name] for name in ("W", "T", "focal", "center", "size")))
        assert camera.f_x != camera.f_y and camera.width != camera.height
        assert (
            abs(camera.c_x - (camera.width - 1) / 2) > 0.5
            and abs(camera.c_y - (camera.height - 1) / 2) > 0.5
        )
        assert np.array_equal(
            eq(**case.inputs).image, golden.render(camera, case.inputs["t"], EXACT)
        )


def test_the_model_moves_hides_and_is_small():
    golden, eq = pipeline.golden_model(), SUBJECTS_L4[0][1]
    assert pipeline.MODEL.stat().st_size <= 30_000 and golden.design.effects == MODEL_EFFECTS
    assert 0.5 < golden.anchors.mask.mean() < 1  # some children are masked for good
    images = {case.name: eq(**case.inputs).image for case in eq.cases()}
    for a, b in (
        ("front_000", "front_035"),
        ("front_035", "front_100"),
        ("side_000", "side_100"),
        ("front_035", "side_035"),
    ):
        assert np.abs(images[a] - images[b]).max() > 0.1
    off = np.abs(images["paper_settings"] - images["front_035"]).max()
    assert 1e-4 < off < 0.05  # another rule, not another picture
    without = next(case for case in eq.cases() if case.name == "front_035").inputs
    effects = tuple(effect for effect in MODEL_EFFECTS if effect != "occlusion")
    assert np.abs(eq(**{**without, "effects": effects}).image - images["front_035"]).max() > 0.2


# --- size ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("level, most", [("L0", 100_000), ("L2", 500_000), ("L4", 1_200_000)])
def test_levels_are_small(level, most):
    """Inputs; outputs and gradients with their cotangents and scales (half as wide)."""

    def size(values):
        return sum(
            b.nbytes for a in values if isinstance(a, (list, np.ndarray)) for b in generic.leaves(a)
        )

    total = 0
    for _, eq in LEVELS[level]:
        for case in eq.cases():
            total += size(case.inputs.values()) + 2.5 * size(eq(**case.inputs))
            total += 1.5 * size(gradients_of(eq, case).values()) if eq.differentiable else 0
    assert 0.02 * most < total < most
