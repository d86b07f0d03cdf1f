"""The vectors of the published kernel's rule: met by renderers that share no code with them."""

import numpy as np
import pytest

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.compare import cast, compare
from p4dgs_ref.splatting import fast, loop
from p4dgs_ref.splatting.settings import KERNEL
from p4dgs_ref.splatting.tiles import bin_splats
from tests.workshop import kernel

CASES = [case for key in ("kernel", "kernel_many") for case in published.cases(key)]
NAMES = ("mean2d", "cov2d", "conic", "alpha", "color", "depth", "visible", "background")
CASE = pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)


@CASE
@pytest.mark.parametrize(
    "renderer, dtype", [(loop, "float64"), (fast, "float64"), (fast, "float32")]
)
def test_the_renderers_of_the_package_give_these_numbers(case, renderer, dtype):
    i, bars = cast(case.inputs(), np.float64), cast(case.cotangents(), np.float64)
    given = [kernel.definite(i)[name] for name in NAMES]
    settings = KERNEL._replace(dtype=dtype)
    (image, T), saved = renderer.forward(*given, i["height"], i["width"], settings)
    outputs = {"out.image": image, "out.transmittance": T}
    gradients = renderer.backward(saved, bars["image_bar"])
    got = cast({**outputs, **{f"in_bar.{n}": a for n, a in gradients.items()}}, np.dtype(dtype))
    unasked = {name for name in case.tensors if name.startswith(("out.", "in_bar."))} - set(got)
    tensors = {name: a for name, a in case.tensors.items() if name not in unasked}
    assert unasked == {"out.last"} and compare(tensors, got, case.tolerance(dtype)) == []


@CASE
def test_the_lists_are_those_of_the_package(case):
    i = cast(case.inputs(), np.float64)
    mine = kernel.lists(**{name: i[name] for name in kernel.LISTED})
    names = ("mean2d", "cov2d", "conic", "alpha", "depth", "visible", "width", "height")
    theirs = bin_splats(*(i[name] for name in names), KERNEL)
    assert np.array_equal(mine.tile, theirs.tile) and np.array_equal(mine.row, theirs.splat)
