"""The methods: gradients of their loss, and files."""

from dataclasses import replace

import numpy as np
import pytest

from p4dgs_ref.splatting.settings import EXACT

from .small import MODULES, SMALL, random_parameters


@pytest.mark.parametrize(
    "method, iteration", [("d3dgs", 20), ("hexplane", 5), ("hexplane", 20), ("gaussian4d", 59)]
)
def test_gradients_of_the_loss(scene, method, iteration):
    """One view from parameters to the loss, in float64 and with the exact renderer."""
    strong = {"lambda_planes": (0.3, 0.2, 0.1)} if method == "hexplane" else {}
    trainer = MODULES[method].Trainer(scene, replace(SMALL[method], **strong), settings=EXACT)
    trainer.parameters = random_parameters(method, 4)
    trainer.iteration, p, view = iteration, trainer.parameters, scene.train[3]
    p["log_s"][...] = -1.5
    losses, _, gradients, _ = trainer.gradients_of(view)
    assert (losses.L_total > losses.L_render) == (method == "hexplane" and iteration >= 10)
    rng = np.random.default_rng(6)
    skipped = ("psi_d.W0", "psi_d.W2", "box")  # psi_d reads E(x) there, see `random_parameters`
    for name in set(p.arrays) - set(skipped):
        d, h, start, values = rng.normal(size=p[name].shape), 1e-6, p[name].copy(), []
        for step in (h, -h):
            p[name][...] = start + step * d
            values.append(trainer.gradients_of(view)[0].L_total)
        p[name][...] = start
        wanted = (values[0] - values[1]) / (2 * h)
        assert (gradients[name] * d).sum() == pytest.approx(wanted, rel=2e-5, abs=1e-9), name
