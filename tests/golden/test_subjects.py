"""Scalars, stages and the pipeline as subjects of vectors: right, not trivial, small."""

import numpy as np
import pytest

from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.table import EQUATIONS
from tests.core import adjoint
from tests.core.adjoint import leaves
from tests.golden import pipeline, scalars, scalars_coding, stages, stages_coding
from tests.golden.cases import FLAGS
from tests.golden.flat import camera_of

LEVELS = {
    "L0": (*scalars.SUBJECTS, *scalars_coding.SUBJECTS),
    "L2": (*stages.SUBJECTS, *stages_coding.SUBJECTS),
    "L4": pipeline.SUBJECTS,
}
ROWS = [subject for subjects in LEVELS.values() for subject in subjects]
BY_KEY = {subject.key: subject for subject in ROWS}


def every(*levels, only=lambda subject, case: True):
    return pytest.mark.parametrize(
        "subject, case",
        [
            pytest.param(subject, case, id=f"{subject.key}-{case.name}")
            for level in levels
            for subject in LEVELS[level]
            for case in subject.cases()
            if only(subject, case)
        ],
    )


def answers(subject, case, seed):
    """Outputs, and gradients for random cotangents."""
    outputs, pullback = subject.vjp(**case.inputs)
    draw = np.random.default_rng(seed).standard_normal
    bars = adjoint.draw_cotangents(outputs, draw) if subject.gradients else {}
    return outputs, pullback(**bars)


# --- what holds for every equation holds here ---------------------------------------------------
def test_every_subject_blames_an_equation_and_none_has_the_key_of_one():
    assert len(BY_KEY) == len(ROWS) and not set(BY_KEY) & set(EQUATIONS)
    assert {subject.equation for subject in ROWS} <= set(EQUATIONS)
    for subject in ROWS:
        cases = list(subject.cases())
        assert len(cases) >= (1 if subject.key == "trace" else 2)
        assert len({case.name for case in cases}) == len(cases) and all(
            set(case.flags) <= set(FLAGS) for case in cases
        )


@every(*LEVELS, only=lambda subject, case: subject.gradients and case.smooth)
def test_backward_is_the_adjoint_of_the_derivative(subject, case):
    surrogate = subject.surrogate
    adjoint.check_adjoint(subject, case, surrogate(**case.inputs) if surrogate else subject)


@every(*LEVELS, only=lambda subject, case: case.expected)
def test_closed_forms(subject, case):
    outputs, pullback = subject.vjp(**case.inputs)
    zero = adjoint.draw_cotangents(outputs, np.zeros) if subject.gradients else {}
    gradients = pullback(**{**zero, **case.cotangents})
    got = {**outputs, **{name + "_bar": a for name, a in gradients.items()}}
    for name, want in case.expected.items():
        adjoint.close(got[name], want, case.tolerance, f"{subject.key}, {case.name}, {name}")
    assert {name.removesuffix("_bar") for name in case.cotangents} <= set(outputs)


@every(*LEVELS, only=lambda subject, case: subject.gradients and not case.smooth)
def test_on_a_kink_a_closed_form_says_what_the_gradient_is(subject, case):
    assert any(name.endswith("_bar") for name in case.expected)


@every("L0", "L2", only=lambda subject, case: subject.key != "lens")
def test_float32_stays_float32(subject, case):
    with np.errstate(all="ignore"):
        single = case._replace(inputs=cast(case.inputs, np.float32))
        outputs, gradients = answers(subject, single, 4)
    for name, a in {**outputs, **gradients}.items():
        for b in leaves(a):
            assert b.dtype.kind != "f" or b.dtype == np.float32, name


# --- nothing is trivial -------------------------------------------------------------------------
def has_gradients(subject, case):
    """Whether gradients must not vanish.

    A scalar on or beyond its clamp may have none, and heads of zero width give the trunk of psi_d
    none.
    """
    beyond = subject.level == "L0" and {"saturated", "clamped", "kink"} & set(case.flags)
    return subject.gradients and case.name != "rests" and not beyond


@every("L0", "L2", only=has_gradients)
def test_no_gradient_is_nearly_zero(subject, case):
    for name, gradient in answers(subject, case, 3)[1].items():
        for i, g in enumerate(leaves(gradient)):
            if g.size:
                assert np.linalg.norm(g) > 1e-6, (name, i)
                assert np.mean(g == 0) < 0.9, (name, i, np.mean(g == 0))


@every(*LEVELS, only=lambda subject, case: "image" in subject.shapes)
def test_no_image_is_nearly_empty(subject, case):
    image, background = subject(**case.inputs)["image"], case.inputs["background"]
    assert np.mean(np.abs(image - background).max(axis=2) > 0.05) > 0.3
    assert np.ptp(image, axis=(0, 1)).min() > 0.2  # in every channel
    assert len({*background.round(3)}) == 3 and image.shape[0] != image.shape[1]


def test_a_culled_row_has_neither_place_nor_gradient():
    subject = BY_KEY["projection_stage"]
    case = next(case for case in subject.cases() if case.name == "some_behind")
    outputs, gradients = answers(subject, case, 3)
    visible = outputs.pop("visible")
    assert 0 < visible.sum() < len(visible)
    for a in (*outputs.values(), *gradients.values()):
        assert not a[~visible].any() and a[visible].all(axis=tuple(range(1, a.ndim))).any()


# --- single numbers -----------------------------------------------------------------------------
def test_hash_rows_in_whole_numbers_without_limit():
    subject = BY_KEY["hash_index"]
    largest = 0
    for case in subject.cases():
        corners, res, table = (case.inputs[name] for name in ("corner", "res", "table"))
        for corner, row in zip(corners.tolist(), subject(**case.inputs)["row"].tolist()):
            dense = sum(c * res**i for i, c in enumerate(corner))
            products = [c * prime for c, prime in zip(corner, (1, 2654435761, 805459861))]
            hashed = 0
            for product in products:
                hashed ^= product % 2**32
            assert row == (dense if res ** len(corner) <= table else hashed % table)
            largest = max(largest, *products)
    assert largest > 2**53


def test_bins_are_even_and_rise_towards_the_middle():
    subject = BY_KEY["gaussian_bin"]
    for case in subject.cases():
        if "tail" in case.flags and "wide" not in case.flags and case.name != "regimes":
            log_p, slope_z, _ = subject(**case.inputs).values()
            assert np.array_equal(log_p[::2], log_p[1::2])
            assert np.array_equal(slope_z[::2], -slope_z[1::2])
            assert np.isfinite(log_p).all() and (np.diff(log_p[::2]) < 0).all()
            assert (slope_z[::2] < 0).all()


# --- frames -------------------------------------------------------------------------------------
def test_frames_are_those_of_the_decoded_model():
    golden, frames = pipeline.golden_model(), BY_KEY["frames"]
    exact = [case for case in frames.cases() if case.inputs["renderer"] == "exact"]
    seen = {(case.inputs["t"], case.inputs["focal"][0]) for case in exact}
    assert len(exact) == len(seen) == 6 and len({t for t, _ in seen}) == 3
    for case in exact:
        camera = camera_of(*(case.inputs[name] for name in ("W", "T", "focal", "center", "size")))
        assert camera.f_x != camera.f_y and camera.width != camera.height
        assert (
            abs(camera.c_x - (camera.width - 1) / 2) > 0.5
            and abs(camera.c_y - (camera.height - 1) / 2) > 0.5
        )
        image = golden.render(camera, case.inputs["t"], EXACT)
        assert np.array_equal(frames(**case.inputs)["image"], image)


def test_the_model_moves_hides_and_is_small():
    golden, frames = pipeline.golden_model(), BY_KEY["frames"]
    assert pipeline.MODEL.stat().st_size <= 30_000 and golden.design.effects == MODEL_EFFECTS
    assert 0.5 < golden.anchors.mask.mean() < 1  # some children are masked for good
    images = {case.name: frames(**case.inputs)["image"] for case in frames.cases()}
    for a, b in (
        ("front_000", "front_035"),
        ("front_035", "front_100"),
        ("side_000", "side_100"),
        ("front_035", "side_035"),
    ):
        assert np.abs(images[a] - images[b]).max() > 0.1
    off = np.abs(images["paper_settings"] - images["front_035"]).max()
    assert 1e-4 < off < 0.05  # another rule, not another picture
    without = next(case for case in frames.cases() if case.name == "front_035").inputs
    effects = tuple(effect for effect in MODEL_EFFECTS if effect != "occlusion")
    through = frames(**{**without, "effects": effects})["image"]
    assert np.abs(through - images["front_035"]).max() > 0.2


# --- size ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("level, most", [("L0", 100_000), ("L2", 500_000), ("L4", 1_200_000)])
def test_levels_are_small(level, most):
    """Inputs; outputs and gradients with their cotangents and scales (half as wide)."""

    def size(values):
        arrays = [a for a in values.values() if isinstance(a, (list, np.ndarray))]
        return sum(b.nbytes for a in arrays for b in leaves(a))

    total = 0
    for subject in LEVELS[level]:
        for case in subject.cases():
            outputs, gradients = answers(subject, case, 3)
            total += size(case.inputs) + 2.5 * size(outputs) + 1.5 * size(gradients)
    assert 0.02 * most < total < most
