"""The methods that the paper compares itself with, trained by the same loop and renderer as ours.

    from p4dgs_ref.lab import baselines
    model = baselines.train(scene, "d3dgs", seed=0)
    sizes = model.save("bouncing.ply")
    model = baselines.load("bouncing.ply")

The module of a method has Preset, PRESETS and Trainer, whose `kind` of model is a subclass of
`explicit.Explicit`. BASELINE_EQUATIONS is the table of the equations: D belongs to D3DGS, H to
4DHexPlane, G to 4DGS. What a method takes from the paper or from another method has no second row.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from p4dgs_ref import designs
from p4dgs_ref.scenes.fields import require
from p4dgs_ref.scenes.files import reading
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.table import EQUATIONS, Equation
from p4dgs_ref.training.presets import read_changes
from .. import entry
from . import coded, d3dgs, explicit, gaussian4d, half, hexplane

# The names in comparisons, each with its module and its preset for the tiny scenes.
METHODS = {
    "d3dgs": (d3dgs, "tiny"),
    "d3dgs_small": (d3dgs, "tiny_small"),
    "hexplane": (hexplane, "tiny"),
    "gaussian4d": (gaussian4d, "tiny"),
}

DECODERS = {".half": half.decode, ".coded": coded.decode}  # of files other than PLY


def module_of(method):
    """The module of a method, and the name of its preset for the tiny scenes."""
    return entry(METHODS, "method", method)


def choose(method, preset=None, changes=None):
    """The preset of that name of a method, with some fields changed; a change may be a text.

    Raises ValueError with the name of the method, preset or field and what was expected.
    """
    module, tiny = module_of(method)
    base = entry(module.PRESETS, "preset", preset or tiny)
    return replace(base, **read_changes(base, changes))


def train(scene, method="d3dgs", preset=None, seed=0, settings=FAST, report=None, **changes):
    """Fit a scene by a method and return the model, ready to be rendered or saved.

    Without a preset it is that for the tiny scenes; `report` is called after each step, for example
    a `training.loop.Progress`; the other arguments are those of our `train`. Raises ValueError
    for an unknown method, preset, field or value, and NotFinite.
    """
    (module, _), constants = module_of(method), choose(method, preset, changes)
    with np.errstate(all="ignore"):  # non-finite values are found and named
        return module.Trainer(scene, constants, seed, settings).run(report)


def load(path):
    """The model in a file of any method and storage. Raises ValueError for another file."""
    path = Path(path)
    with reading(path, "the file of a baseline"), np.errstate(all="ignore"):
        decode = DECODERS.get(path.suffix)
        p, values = decode(path.read_bytes()) if decode else explicit.read_file(path)
        module, _ = module_of(values["method"])
        require(np.isfinite(p.vector).all(), path, "expected finite numbers")
        preset, background = module.Preset(**values["form"]), np.array(values["background"], float)
        model = module.Trainer.kind(p, preset, background.reshape(3), values["occlusion"])
        model.predict(0.0, model.box[0])  # fails where an array is missing or of another shape
    return model


# Rows as in `p4dgs_ref.table`.
_ROWS = (
    Equation(
        "activations",
        "D1",
        "s = exp(log_s), r = raw_r / |raw_r|, alpha = sigmoid(logit_alpha)",
        "p4dgs_ref.lab.baselines.activations",
        ("s", "r", "alpha"),
        ("log_s", "raw_r", "logit_alpha"),
    ),
    Equation(
        "sh_color",
        "D2",
        "color = max(0, 1/2 + sum_k sh_k Y_k(d))",
        "p4dgs_ref.lab.baselines.sh_color",
        ("color",),
        ("d", "sh"),
    ),
    Equation(
        "deformation_d3dgs",
        "D3",
        "(delta_x, delta_s, delta_r) = psi_d(concat(E(x), psi_t(E(t))))",
        "p4dgs_ref.lab.baselines.deformation_d3dgs",
        ("delta_x", "delta_s", "delta_r"),
        ("x", "weights", "biases", "time_weights", "time_biases"),
    ),
    Equation(
        "plane_features",
        "H1",
        "features = concat over levels (prod over planes (plane[u_i, u_j]))",
        "p4dgs_ref.lab.baselines.plane_features",
        ("features",),
        ("x", "planes"),
    ),
    Equation(
        "plane_decoder",
        "H2",
        "delta_x, delta_log_s, delta_raw_r = phi_x(h), phi_s(h), phi_r(h), h = relu(phi(features))",
        "p4dgs_ref.lab.baselines.plane_decoder",
        ("delta_x", "delta_log_s", "delta_raw_r"),
        ("features", "weights", "biases"),
    ),
    Equation(
        "plane_losses",
        "H3",
        "L_space = mean (diff P)^2, L_time = mean (diff diff P)^2, L_one = mean |P - 1|",
        "p4dgs_ref.lab.baselines.plane_losses",
        ("L_space", "L_time", "L_one"),
        ("planes",),
    ),
    Equation(
        "rotation_4d",
        "G1",
        "R v = l v conj(r), l = raw_l / |raw_l|, r = raw_r / |raw_r|",
        "p4dgs_ref.lab.baselines.rotation_4d",
        ("R",),
        ("raw_l", "raw_r"),
    ),
    Equation(
        "conditional",
        "G2",
        "x_t = x + b (t - mu_t) / var_t, Sigma_t = A - b b^T / var_t",
        "p4dgs_ref.lab.baselines.conditional",
        ("x_t", "Sigma_t", "var_t"),
        ("x", "mu_t", "s", "R"),
    ),
    Equation(
        "marginal",
        "G3",
        "alpha_t = alpha exp(-(t - mu_t)**2 / (2 var_t))",
        "p4dgs_ref.lab.baselines.marginal",
        ("alpha_t", "weight"),
        ("alpha", "mu_t", "var_t"),
    ),
    Equation(
        "spherindrical",
        "G4",
        "sh_t = sum_n cos(2 pi n (t - mu_t)) sh_n",
        "p4dgs_ref.lab.baselines.spherindrical",
        ("sh_t",),
        ("sh", "mu_t"),
    ),
)

BASELINE_EQUATIONS: dict[str, Equation] = {row.key: row for row in _ROWS}
ALL_EQUATIONS = {**EQUATIONS, **BASELINE_EQUATIONS, **designs.EQUATIONS}
