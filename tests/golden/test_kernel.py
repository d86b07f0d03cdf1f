"""The vectors of the published kernel's rule: met by renderers that share no code with them."""

import numpy as np
import pytest

from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle.compare import compare, expected
from p4dgs_ref.oracle.precision import cast
from p4dgs_ref.splatting import fast, loop
from p4dgs_ref.splatting.settings import PAPER
from p4dgs_ref.splatting.tiles import bin_splats
from tests.core import adjoint
from tests.golden import kernel
from tests.golden.mistakes.kernel import ruled
from tests.golden.subjects import subjects
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
    return *(i[name] for name in names), i["height"], i["width"]


# --- the package's renderers, under the setting `paper` -----------------------------------------
@pytest.mark.parametrize("case", SPLATS, ids=lambda case: case.id)
@pytest.mark.parametrize("renderer", [loop, fast], ids=["loop", "fast"])
def test_the_renderers_of_the_package_give_these_numbers(case, renderer):
    inputs, bars = wide(case)
    settings = PAPER._replace(dtype="float64")
    (image, T), saved = renderer.forward(*arguments(inputs), settings)
    got = named({"image": image, "transmittance": T}, renderer.backward(saved, bars["image_bar"]))
    assert verdict(case, got, np.float64) == []


@pytest.mark.parametrize("case", SPLATS, ids=lambda case: case.id)
def test_the_fast_renderer_gives_them_in_float32(case):
    inputs, bars = wide(case)
    (image, T), saved = fast.forward(*arguments(inputs), PAPER)
    got = named({"image": image, "transmittance": T}, fast.backward(saved, bars["image_bar"]))
    assert verdict(case, got, np.float32) == []


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
        PAPER,
    )
    assert np.array_equal(mine.tile, theirs.tile) and np.array_equal(mine.row, theirs.row)


# --- the published kernel's own way -------------------------------------------------------------
def as_published(i, image_bar, dtype):
    """The kernel as it is published: T is divided back, colours accumulate from behind."""
    i, dtype = cast(i, dtype), np.dtype(dtype).type
    found = kernel.lists(**{name: i[name] for name in kernel.LISTED})
    shape = i["height"], i["width"]
    columns = -(-shape[1] // kernel.TILE)
    out = {"image": np.zeros((*shape, 3), dtype), "transmittance": np.ones(shape, dtype)}
    out["last"] = np.zeros(shape, np.int32)
    bars = {name: np.zeros_like(i[name]) for name in (*kernel.SPLATS, "background")}
    for number, (start, end) in enumerate(found.ranges):
        y, x = divmod(number, columns)
        for v in range(y * 16, min(y * 16 + 16, shape[0])):
            for u in range(x * 16, min(x * 16 + 16, shape[1])):
                pixel(i, found.row[start:end], u, v, image_bar[v, u].astype(dtype), out, bars)
    return named(out, bars)


def pixel(i, rows, u, v, g, out, bars):
    """One thread of the kernel: forward from front to back, then backward from back to front."""
    dtype = i["alpha"].dtype.type
    T, color, last = dtype(1), np.zeros(3, dtype), 0
    drawn = []
    for place, row in enumerate(rows, 1):
        x, y = i["mean2d"][row] - np.array([u, v], dtype)
        a, b, c = i["conic"][row]
        power = dtype(-0.5) * (a * x * x + c * y * y) - b * x * y
        G = np.exp(power)
        A = min(dtype(0.99), i["alpha"][row] * G)
        if power > 0 or A < dtype(1 / 255):
            continue
        if T * (1 - A) < dtype(1e-4):
            break
        color += i["color"][row] * A * T
        T *= 1 - A
        last = place
        drawn.append((row, A, G, x, y))
    out["image"][v, u], out["last"][v, u] = color + T * i["background"], last
    out["transmittance"][v, u] = final = T
    bars["background"] += final * g
    behind, next_alpha, next_color = np.zeros(3, dtype), dtype(0), np.zeros(3, dtype)
    for row, A, G, x, y in reversed(drawn):
        T = T / (1 - A)
        behind = next_alpha * next_color + (1 - next_alpha) * behind
        next_alpha, next_color = A, i["color"][row]
        bars["color"][row] += A * T * g
        A_bar = (next_color - behind) @ g * T - final / (1 - A) * (i["background"] @ g)
        bars["alpha"][row] += G * A_bar
        G_bar = i["alpha"][row] * A_bar * G
        a, b, c = i["conic"][row]
        bars["mean2d"][row] -= G_bar * np.array([a * x + b * y, b * x + c * y])
        bars["conic"][row] -= G_bar * np.array([x * x / 2, x * y, y * y / 2])


# kernel_many takes a minute this way.
@pytest.mark.parametrize("case", published.cases("kernel"), ids=lambda case: case.id)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_published_loop_passes(case, dtype):
    inputs, bars = wide(case)
    got = as_published(inputs, bars["image_bar"], dtype)
    assert verdict(case, got, dtype) == [] and set(got) == set(expected(case.tensors))


# --- gradients, ties, digits --------------------------------------------------------------------
@pytest.mark.parametrize("key", few(["kernel", "kernel_stage"], 1))
def test_gradients_are_those_of_finite_differences(key):
    """With the lists, masks and stops of the case, and a clamp that passes the gradient."""
    subject = subjects()[key]
    for case in subject.cases():
        adjoint.check_adjoint(subject, case, subject.surrogate(**case.inputs))


def test_the_cases_are_hard_enough():
    """Depths tie, lists are long, pixels stop, opacities are clamped, masked and cut."""
    for case in CASES:
        if case.subject == "kernel_stage":
            continue
        i, _ = wide(case)
        found = kernel.lists(**{name: i[name] for name in kernel.LISTED})
        ties = np.diff(found.key) == 0
        assert ties.any() == (case.name in ("equal_depths", "sorting")), case.id
        assert (np.diff(found.key) >= 0).all() and (np.diff(found.row)[ties] > 0).all()
        assert (found.radius == 0).any() or case.name == "opaque"
    many = published.cases("kernel_many")[0]
    assert len(many.tensors["in.depth"]) >= 2000 and many.tensors["out.last"].max() > 255
    opaque = published.cases("kernel")[2].tensors["out.transmittance"]
    assert 1e-4 <= opaque.min() and (opaque < 3e-4).mean() > 0.1
    tiles = kernel.composite(**wide(published.cases("kernel")[2])[0])[1]
    assert sum((tile.raw > kernel.ALPHA_MAX).sum() for tile in tiles) >= 10


def test_every_decision_is_clear():
    """Nothing lies within a margin of a threshold, so that float32 decides as float64."""
    for case in CASES:
        i, _ = wide(case)
        if case.subject == "kernel_stage":
            i = kernel.of_kernel(**i)
        if case.subject != "tile_lists":
            assert not len(kernel.unsettled(i)), case.id


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

    class Port:
        def run(self, case):
            vjp = vjps["stage_vjp" if case.subject == "kernel_stage" else "kernel_vjp"]
            outputs, pullback = vjp(**case.inputs())
            return named(outputs, pullback(**case.cotangents()))

    keys = ("kernel", "kernel_many", "kernel_stage")
    results = checker.check_port(Port(), ("L2",), set(keys)).results
    failed = [r for r in results if r.verdict == "fail"]
    assert {r.equation for r in failed} == {"compositing"} and len(failed) >= 1
    assert all(f"[{id}]" in r.explanation for r in failed), [r.explanation for r in failed]
