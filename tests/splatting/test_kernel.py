"""The vectors of the published kernel's rule: met by renderers that share no code with them."""

import numpy as np
import pytest

from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle.compare import cast, compare
from p4dgs_ref.splatting import fast, loop
from p4dgs_ref.splatting.settings import KERNEL
from p4dgs_ref.splatting.tiles import bin_splats
from tests.equations import adjoint
from tests.golden import kernel
from tests.golden.mistakes.kernel import ruled
from tests.golden.mutate import rewritten
from tests.golden.subjects import subjects
from tests.oracle.answers import Port
from tests.sampling import few

KEYS = ("tile_lists", "kernel", "kernel_many", "kernel_stage")
CASES = [case for key in KEYS for case in published.cases(key)]
SPLATS = [case for case in CASES if case.subject in ("kernel", "kernel_many")]


def wide(case):
    """The inputs and cotangents of a case in float64."""
    return cast(case.inputs(), np.float64), cast(case.cotangents(), np.float64)


def verdict(case, got, dtype):
    """What the checker finds in outputs and gradients; tensors that are left out are not judged."""
    tensors = {
        name: a
        for name, a in case.tensors.items()
        if not name.startswith(("out.", "in_bar.")) or name in got
    }
    got = {n: a.astype(dtype) if a.dtype.kind == "f" else a for n, a in got.items()}
    return compare(tensors, got, case.tolerance(np.dtype(dtype).name))


def named(outputs, bars):
    """Outputs and gradients by the names of the vectors."""
    return {f"out.{n}": a for n, a in outputs.items()} | {f"in_bar.{n}": a for n, a in bars.items()}


def arguments(i):
    """The inputs of a case as `loop` and `fast` take them."""
    names = ("mean2d", "cov2d", "conic", "alpha", "color", "depth", "visible", "background")
    return *(kernel.definite(i)[name] for name in names), i["height"], i["width"]


# --- the package's renderers, under the setting `kernel` ----------------------------------------
@pytest.mark.parametrize("case", SPLATS, ids=lambda case: case.id)
@pytest.mark.parametrize(
    "renderer, dtype", [(loop, "float64"), (fast, "float64"), (fast, "float32")]
)
def test_the_renderers_of_the_package_give_these_numbers(case, renderer, dtype):
    inputs, bars = wide(case)
    (image, T), saved = renderer.forward(*arguments(inputs), KERNEL._replace(dtype=dtype))
    got = named({"image": image, "transmittance": T}, renderer.backward(saved, bars["image_bar"]))
    assert verdict(case, got, dtype) == []


@pytest.mark.parametrize("case", SPLATS, ids=lambda case: case.id)
def test_the_lists_are_those_of_the_package(case):
    i, _ = wide(case)
    mine = kernel.lists(**{name: i[name] for name in kernel.LISTED})
    theirs = bin_splats(
        i["mean2d"],
        i["cov2d"],
        i["conic"],
        i["alpha"],
        i["depth"],
        i["visible"],
        i["width"],
        i["height"],
        KERNEL,
    )
    assert np.array_equal(mine.tile, theirs.tile) and np.array_equal(mine.row, theirs.row)


@pytest.mark.parametrize("case", SPLATS, ids=lambda case: case.id)
def test_a_port_may_skip_a_splat_of_positive_exponent(case):
    """As the published kernel does, instead of taking 0 for the exponent."""
    change = {"np.exp(np.minimum(": "np.exp(skipped("}
    skipped = {"skipped": lambda power, _: np.where(power > 0, -np.inf, power)}
    inputs, bars = wide(case)
    outputs, pullback = rewritten("tests.golden.kernel", change, **skipped)["kernel_vjp"](**inputs)
    assert verdict(case, named(outputs, pullback(**bars)), np.float64) == []


# --- within a pixel -----------------------------------------------------------------------------
@pytest.mark.parametrize("case", published.cases("kernel_pixels"), ids=lambda case: case.id)
def test_what_is_within_a_pixel_adds_up(case):
    """To the gradient of alpha of the package's loop, and to what is seen behind each splat."""
    (i, _), out = wide(case), {n: case.tensors[f"out.{n}"] for n in ("A", "T", "A_bar", "T_bar")}
    g, (x, y) = i["image_bar"][i["pixels"][:, 1], i["pixels"][:, 0]], i["pixels"].T
    alone = np.zeros_like(i["image_bar"])
    alone[y, x] = g
    (_, T), saved = loop.forward(*arguments(i), KERNEL._replace(dtype="float64"))
    want = loop.backward(saved, alone)["alpha"]
    a, b, c = i["conic"].T[:, :, None]
    e_x, e_y = x - i["mean2d"][:, :1], y - i["mean2d"][:, 1:]
    falloff = np.exp(-0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y)
    assert np.allclose((out["A_bar"] * falloff).sum(axis=1), want, rtol=1e-10, atol=1e-12)
    order = np.argsort(i["depth"], kind="stable")
    shown = (out["T"] * out["A"] * (i["color"] @ g.T))[order]
    behind = np.cumsum(shown[::-1], axis=0)[::-1] + T[y, x] * (g @ i["background"])
    behind *= out["A"][order] > 0
    assert np.allclose((out["T"] * out["T_bar"])[order], behind, rtol=1e-10, atol=1e-12)


# --- gradients, ties, digits --------------------------------------------------------------------
@pytest.mark.parametrize("key", few(["kernel", "kernel_stage"], 1))
def test_gradients_are_those_of_finite_differences(key):
    """With the lists, masks and stops of the case, and a clamp that passes the gradient."""
    subject = subjects()[key]
    for case in subject.cases():
        adjoint.check_adjoint(subject, case, subject.surrogate(**case.inputs))


# --- mistakes -----------------------------------------------------------------------------------
OTHER_RULES = (
    "kernel-stop-after-splat",
    "kernel-clamp-blocks-gradient",
    "kernel-ties-reversed",
    "kernel-exact-ellipse",
    "kernel-not-masked",
)


@pytest.mark.parametrize("id", few(OTHER_RULES, 2))
def test_a_port_with_another_rule_is_noticed_and_explained_wherever_it_shows(id):
    """The doctor has answers to `kernel`; what fails in the other subjects refers to it."""
    vjps = ruled(id)

    def other(case, dtype):
        vjp = vjps["stage_vjp" if case.subject == "kernel_stage" else "kernel_vjp"]
        outputs, pullback = vjp(**case.inputs())
        return named(outputs, pullback(**case.cotangents()))

    keys = ("kernel", "kernel_many", "kernel_stage")
    results = checker.check_port(Port(other), ("L2",), set(keys)).results
    failed = [r for r in results if r.verdict == "fail"]
    assert {r.equation for r in failed} == {"compositing"} and len(failed) >= 1
    assert all(f"[{id}]" in r.explanation for r in failed), [r.explanation for r in failed]
