"""The optimisation trace of level L4: the losses of its first step, computed independently."""

import numpy as np

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.published import flatten
from tests.golden import pipeline


def test_the_arrays_of_every_step_have_the_published_checksums():
    """Those of a network are one vector here, and W and b of each layer by themselves there."""
    steps, trace = (published.cases(key)[0].tensors for key in ("trace_steps", "trace"))
    inputs = flatten(published.cases("trace")[0].inputs())
    names = next(pipeline.trace_cases()).inputs["arrays"]
    for stem in pipeline.ARRAYS:
        parts_of = [n for n in names if pipeline.parameter_name(n).split(".")[0] == stem]
        parts_of.sort(key=lambda name: pipeline.parameter_name(name)[::-1])  # W0, b0, W1, b1
        ends, at = np.cumsum([inputs[n].size for n in parts_of]), [names.index(n) for n in parts_of]
        for step in range(pipeline.STEPS):
            parts = np.split(steps[f"out.{stem}.{step}"].ravel(), ends[:-1])
            sums = [[part.sum(), pipeline.ramp(part)] for part in parts]
            want = np.stack([trace["out.total"][step, at], trace["out.ramp"][step, at]], axis=1)
            assert np.allclose(sums, want, rtol=1e-11, atol=1e-11), f"{stem} after step {step + 1}"
