"""Scalars, stages and the pipeline as subjects of vectors: right, not trivial, small."""

import numpy as np
import pytest

from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.table import EQUATIONS
from tests.equations import adjoint
from tests.equations.adjoint import leaves
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
        assert len(cases) >= (1 if subject.key in ("trace", "trace_steps") else 2)
        assert len({case.name for case in cases}) == len(cases) and all(
            set(case.flags) <= set(FLAGS) for case in cases
        )


@pytest.mark.parametrize(
    "subject", [s for s in ROWS if s.gradients], ids=lambda subject: subject.key
)
def test_backward_is_the_adjoint_of_the_derivative(subject):
    for case in (case for case in subject.cases() if case.smooth):
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


# --- frames -------------------------------------------------------------------------------------
def test_frames_are_those_of_the_decoded_model():
    golden, frames = pipeline.golden_model(), BY_KEY["frames"]
    exact = [case for case in frames.cases() if case.inputs["renderer"] == "exact"]
    moments = {(case.inputs["t"], case.inputs["focal"][0]) for case in exact}
    assert len(exact) == len(moments) == 6 and len({t for t, _ in moments}) == 3
    for case in exact:
        camera = camera_of(*(case.inputs[name] for name in ("W", "T", "focal", "center", "size")))
        assert camera.f_x != camera.f_y and camera.width != camera.height
        assert (
            abs(camera.c_x - (camera.width - 1) / 2) > 0.5
            and abs(camera.c_y - (camera.height - 1) / 2) > 0.5
        )
        image = golden.render(camera, case.inputs["t"], EXACT)
        assert np.array_equal(frames(**case.inputs)["image"], image)
