"""The table of knobs: what each changes, its values, the reference first, and how it is set.

The values of a knob of files are models: the same trained one, written otherwise.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...attributes import ATTRIBUTES
from ...beyond import model as ours
from ...beyond.networks import step_code
from ...codec.quantise import quantise
from ...equations.prior import layout
from ...model import Model, join
from ...splatting.settings import FAST, KERNEL
from ...training.presets import TINY
from .. import StudyError
from . import forms

MIN_DEVIATION = 0.05  # of a channel, in steps: a constant channel still has a finite prior


class Loss(NamedTuple):
    """What a knob loses: one quantity in one unit."""

    column: str  # of the rows
    enough: float  # a loss that does not matter, in the unit
    unit: str
    scale: float = 1.0  # the units in one of the column's


PSNR = Loss("psnr_db", 0.1, "dB")
PICTURE = Loss("error", 0.5, "grey levels", 255)
BITS = Loss("bits_error", 1, "% of the bits", 100)
SLOPES = Loss("slopes_error", 0.1, "% of the slopes", 100)


class Knob(NamedTuple):
    """A row of the table of knobs."""

    name: str
    harness: str  # "formula", "kernels", "file" or "training"
    # Of "formula" and "file" a function that returns the forms, of "kernels" the turns, of
    # "training" {value: changes}, where `changes` are fields of the preset, or another `preset`,
    # a `share` of the iterations, downscale or settings.
    values: Any
    changes: str  # what the knob is, in words
    set_by: str  # where a user of the package sets it
    losses: tuple[Loss, ...] = (PSNR,)  # a row of the page's table for each
    spent: str = "bytes"  # the column that the knob saves: "ms", "seconds" or "bytes"


def formula(name, values, changes, set_by, *losses):
    """A knob of a function that is computed in cheaper forms."""
    return Knob(name, "formula", values, changes, set_by, losses, "ms")


def field(name, label, values, base, changes, spent="seconds"):
    """A knob that is one field of the preset; `base` is its value in `tiny`."""
    choices = {f"{value:g}": {} if value == base else {name: value} for value in values}
    return Knob(label, "training", choices, changes, f"`--set {name}`", spent=spent)


def steps_times(factor):
    """The base steps of `tiny`, times a factor."""
    return {row.base_step: factor * getattr(TINY, row.base_step) for row in ATTRIBUTES}


# --- the same model written otherwise -------------------------------------------------------------
# Each function below returns {(line, value): model}, from the reference to cheaper ones.
def redesigned(model, **changes) -> Model:
    """The model with other fields of its design."""
    return replace(model, design=replace(model.design, **changes))


def weight_bits(model):
    """Weights as float16, then as entropy-coded integers of so many bits."""
    choices = {("", "16"): model}
    for bits in (10, 9, 8, 7, 6, 5, 4):
        steps = {
            name: tuple(
                step_code(np.array([2.0 * np.abs(a).max(initial=0) for a in arrays]) / 2**bits)
                for arrays in pair
            )
            for name, pair in model.networks.items()
        }
        choices["", f"{bits}"] = coded(model, steps=steps)
    return choices


def coded(model, steps=None, position_bits=16):
    """The model in the coded design."""
    design = ours.Design(**vars(model.design), position_bits=position_bits)
    return ours.Model(**{**vars(model), "design": design}, steps=steps)


def position_bits(model):
    """Bits of a position per axis, in the coded design."""
    bits = (16, 12, 11, 10, 9, 8, 7, 6)
    return {("", f"{n}"): coded(model, position_bits=n) for n in bits}


def with_base_steps(model):
    """The model with every step at Q_0: the last layer of psi_q is zero (Eq. 8)."""
    psi_q = tuple([*arrays[:-1], np.zeros_like(arrays[-1])] for arrays in model.networks["psi_q"])
    return replace(model, networks={**model.networks, "psi_q": psi_q})


def steps(model):
    """Base steps, with the learned factors and without them."""
    lines = {"steps of every anchor": model, "one step for all": with_base_steps(model)}
    return {
        (line, f"{n:g}"): redesigned(m, Q_0=tuple(n * Q for Q in m.design.Q_0))
        for line, m in lines.items()
        for n in (0.25, 0.5, 1, 2, 4, 8)
    }


def without_context(model):
    """The model with one Gaussian and one step per channel.

    The hash grid has one node, and the networks of the context have no hidden layer and zero
    weights; the last bias of psi_p holds the means and deviations.
    """
    q = quantise(with_base_steps(model))
    values = np.ma.array(join(q.model.anchors), mask=~q.kept)
    mean, variance = values.mean(axis=0).filled(0), values.var(axis=0).filled(0)
    smallest = MIN_DEVIATION * np.repeat(model.design.Q_0, model.design.widths)
    small = redesigned(model, context=(), grid=(("xyz", 1),), F=1)
    networks = {
        name: ([np.zeros(shape)], [np.zeros(shape[1])])
        for name in ("psi_p", "psi_q")
        for shape in small.design.layers()[name]
    }
    mu, raw = layout(model.design.widths)
    bias = networks["psi_p"][1][0]
    bias[mu], bias[raw] = mean, 0.5 * np.log(np.maximum(variance, smallest**2))
    grids = [np.ones(shape) for shape in small.design.levels()]
    return replace(small, networks={**model.networks, **networks}, grids=grids)


def context(model):
    """The paper's context, and one Gaussian per channel; all steps are Q_0 in both."""
    return {
        ("", "grid and ψ_p"): with_base_steps(model),
        ("", "one Gaussian"): without_context(model),
    }


# --- the table ------------------------------------------------------------------------------------
KNOBS = (
    formula(
        "renderer",
        forms.renderer,
        "Which Gaussians are evaluated at which pixels, and in which precision",
        "`settings` of `render` and `train`",
        PICTURE,
    ),
    formula(
        "cut",
        forms.cut,
        "The opacity below which a Gaussian ends",
        "`Settings.cut`",
        PICTURE,
    ),
    formula(
        "stop",
        forms.stop,
        "The transmittance below which a ray ends, behind large opaque splats",
        "`Settings.stop`",
        PICTURE,
    ),
    formula(
        "precision",
        forms.precision,
        "The floating-point type of an equation, forward and backward",
        "the inputs' dtype; `Settings.dtype`",
        Loss("error", 0.1, "% of the gradient", 100),
    ),
    formula(
        "likelihood",
        forms.likelihood_formula,
        "The formula for the bits of a symbol, Eq. (11)",
        "`equations/likelihood.py`",
        BITS,
        SLOPES,
    ),
    formula(
        "likelihood table",
        forms.likelihood_table,
        "Eq. (11) from a table of the normal distribution, entries per σ",
        "`lab/accuracy/formulas.py`",
        BITS,
        SLOPES,
    ),
    formula(
        "noise draws",
        forms.noise_draws,
        "How many draws of the quantisation noise estimate the rate of 200 anchors",
        "one draw in `training/objective.py`",
        Loss("error", 1, "% of the bits", 100),
    ),
    formula(
        "coder",
        forms.coder,
        "The lanes of the entropy coder, and zlib, for the symbols of 2,000 anchors",
        "`lanes` of `codec.streams.encode_gaussian`",
        Loss("error", 1, "% above the entropy", 100),
    ),
    Knob(
        "same bytes everywhere",
        "kernels",
        20,
        "A training step with the kernels of AVX2, and with those that the processor would choose",
        "`P4DGS_KERNELS=native`",
        (Loss("error", 0.1, "% of the numbers", 100),),
        "ms",
    ),
    Knob(
        "weight bits",
        "file",
        weight_bits,
        "Bits of a network's weight: 16 as they are, fewer entropy coded",
        "`beyond.model.Model.steps`",
    ),
    Knob(
        "position bits",
        "file",
        position_bits,
        "Bits of an anchor's position per axis, in the coded design",
        "`--set position_bits`",
    ),
    Knob(
        "steps",
        "file",
        steps,
        "The quantisation steps in multiples of `tiny`'s, of a model trained at 1",
        "`Design.Q_0`",
    ),
    Knob(
        "context",
        "file",
        context,
        "What predicts the symbols: hash grid and ψ_p, or one Gaussian per channel",
        "`Design.grid` and `context`",
    ),
    Knob(
        "iterations",
        "training",
        {f"{3800 // n:,}": {} if n == 1 else dict(share=1 / n) for n in (1, 2, 4, 8)},
        "The length of the training; all stages shrink alike",
        "`--set stage_ends` and others",
        spent="seconds",
    ),
    Knob(
        "preset",
        "training",
        {"small_coded": dict(preset="small_coded"), "tiny_coded": dict(preset="tiny_coded")}
        | {"tiny": {}},
        "The preset; those with coded networks go beyond the paper",
        "`--preset`",
        spent="seconds",
    ),
    Knob(
        "image size",
        "training",
        {"64 px": {}, "32 px": dict(downscale=2), "16 px": dict(downscale=4)},
        "The side of the training views; the test views keep 64 pixels",
        "`--downscale`",
        spent="seconds",
    ),
    Knob(
        "training renderer",
        "training",
        {"float64": dict(settings=FAST._replace(dtype="float64")), "fast": {}}
        | {"kernel": dict(settings=KERNEL)},
        "The renderer that the training uses; the test views are drawn by `fast`",
        "`settings` of `train`",
        spent="seconds",
    ),
    field("anchors", "anchors", (400, 200, 100, 50), 200, "The anchors at the start"),
    field("k", "children k", (8, 4, 2, 1), 4, "The Gaussians of an anchor"),
    field("d", "features d", (32, 16, 8, 4), 16, "The width of an anchor's feature", spent="bytes"),
    Knob(
        "deformation width",
        "training",
        {f"{n}": {} if n == 64 else dict(deformation=(n, n)) for n in (128, 64, 32, 16)},
        "The units of both hidden layers of the deformation network",
        "`--set deformation`",
        spent="bytes",
    ),
    field(
        "L_x", "L_x", (8, 4, 2, 1), 4, "Frequencies of the positional encoding of x", spent="bytes"
    ),
    field(
        "L_t", "L_t", (8, 4, 2, 1), 4, "Frequencies of the positional encoding of t", spent="bytes"
    ),
    Knob(
        "hash grid",
        "training",
        {
            "8 levels": dict(grid_3d=(8, 16), grid_2d=(16, 32)),
            "4 levels": {},
            "1 level": dict(grid_2d=()),
            "64 entries": dict(grid_2d=(), table_3d=64),
        },
        "The levels of the hash grid; last, a table smaller than its one level",
        "`--set grid_2d`, `table_3d`",
        spent="bytes",
    ),
    field(
        "lambda_rate",
        "λ_rate",
        (1e-4, 5e-4, 2e-3, 1e-2),
        5e-4,
        "The price of a bit in the loss",
        spent="bytes",
    ),
    Knob(
        "trained steps",
        "training",
        {f"{n:g}": {} if n == 1 else steps_times(n) for n in (0.5, 1, 2, 4)},
        "The quantisation steps in multiples of `tiny`'s, with which the model is trained",
        "`--set Q_f`, `Q_s`, `Q_l`, `Q_O`",
        spent="bytes",
    ),
)
HARNESSES = ("formula", "kernels", "file", "training")


def file_name(knob):
    """The knob's name on the command line and in file names."""
    return knob.name.replace(" ", "_").replace("λ", "lambda")


NAMES = (*HARNESSES, *map(file_name, KNOBS))


def select(names):
    """The knobs of these names or harnesses; None for all. Raises StudyError for another name."""
    for name in names or ():
        if name not in NAMES:
            raise StudyError(f"--only {name}: expected one of {', '.join(NAMES)}")
    return [k for k in KNOBS if not names or {file_name(k), k.harness} & set(names)]
