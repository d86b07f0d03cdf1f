"""The paper, one module per equation; `EQUATIONS` lists them in the order in which it prints them."""

from . import (
    anchor_rate,
    color,
    deformation,
    deformed,
    hash_grid,
    hash_rate,
    likelihood,
    masking,
    mlp,
    noise,
    offsets,
    opacity,
    positional_encoding,
    prior,
    rate_loss,
    render_loss,
    rotation,
    rounding,
    scale,
    ssim,
    step,
    total_loss,
    view,
)
from .equation import EQUATIONS, FLAGS, Case, Equation, declare

# Modules import each other, so they were declared in another order.  This is the order of the paper, then support.
ORDER = (
    "offsets",
    "view",
    "opacity",
    "masking",
    "color",
    "rotation",
    "scale",
    "positional_encoding",
    "deformation",
    "deformed",
    "noise",
    "step",
    "hash_grid",
    "rounding",
    "likelihood",
    "prior",
    "anchor_rate",
    "hash_rate",
    "total_loss",
    "render_loss",
    "rate_loss",
    "mlp",
    "ssim",
)
EQUATIONS.update({key: EQUATIONS.pop(key) for key in ORDER if key in EQUATIONS})

# The names of equations mean their modules, `view.forward(...)`; the declared objects are values of EQUATIONS.
__all__ = ["EQUATIONS", "FLAGS", "Case", "Equation", "declare", *ORDER]
