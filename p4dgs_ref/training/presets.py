"""Every constant of training by name: the two settings of the paper and three small ones.

`Preset` is a table with one row a field. From it follow what `choose` accepts, the values of
`tiny`, and what `initial.design_of` puts into a file. `differences(preset)` lists what a preset
changes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from ..limits import MAX_ENTRIES, MAX_LAYERS, MAX_NUMBERS, MAX_OF, MAX_WIDTH
from ..model import declared_numbers
from ..scenes.scene import MODEL_EFFECTS
from .initial import design_of

MAX_VALUE = 1e18  # of a field: an integer of a hundred digits could not become a float


def between(least, most):
    """The requirement that a number is from `least` to `most`."""
    return f"a number from {least:g} to {most:g}", lambda value: least <= value <= most


def layers(most):
    """The requirement on the widths of a network or the resolutions of a grid."""
    return (
        f"at most {most} numbers from 1 to {MAX_WIDTH}",
        lambda value: len(value) <= most and all(1 <= n <= MAX_WIDTH for n in value),
    )


POSITIVE = (f"a positive number up to {MAX_VALUE:g}", lambda value: 0 < value <= MAX_VALUE)
NOT_NEGATIVE = between(0, MAX_VALUE)
RATE = (
    "first,last, two positive rates or 0,0",
    lambda ends: (
        len(ends) == 2 and (all(0 < rate < float("inf") for rate in ends) or not any(ends))
    ),
)
STEP = between(2.0**-40, 2.0**40)
FLAG = ("true or false", lambda value: True)
ENDS = (
    "four rising iterations",
    lambda ends: len(ends) == 4 and sorted((0, *ends)) == [0, *ends] and 1 <= ends[-1] <= MAX_VALUE,
)
GROWING = ("scaffold, reseed or off", lambda value: value in ("scaffold", "reseed", "off"))

# Where values of the paper's presets come from, with the number of the choice in
# tutorials/reference.md. A rate has two values, the first and the last.
AS_PARENTS = "off, as the parents (Q28)"
SCAFFOLD_Q15, SCAFFOLD_Q16 = "Scaffold-GS (Q15, Q16)", "Scaffold-GS (Q16)"
LAST_SCAFFOLD, LAST_HAC = "paper; last: Scaffold-GS (Q17)", "paper; last: HAC (Q17)"

# The paper gives no hash grid; these are the resolutions of HAC.
HAC_3D = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)
HAC_2D = (130, 258, 514, 1026)


def row(paper, tiny, requirement, source, meaning) -> Any:
    """A field of the table whose value in `paper_synthetic` is the default."""
    columns = {"tiny": tiny, "requirement": requirement, "source": source, "meaning": meaning}
    return field(default=paper, metadata=columns)


@dataclass(frozen=True)
class Preset:
    """The table of all fields. A file stores those that `model.Design` has, too.

    name: type = row(in paper_synthetic, in tiny, requirement, source of the former, meaning)

    A requirement is a text and a test.
    """

    name: str = "paper_synthetic"
    # architecture
    anchors: int = row(10_000, 200, POSITIVE, "Scaffold-GS (Q28)", "random points at the start")
    extent: float = row(1.3, 1.0, POSITIVE, "Scaffold-GS (Q28)", "in [-extent, extent]^3")
    voxel: float = row(0.001, 0.001, POSITIVE, "paper", "epsilon: points merge on this lattice")
    d: int = row(16, 16, between(1, MAX_OF["d"]), "paper", "width of a feature")
    k: int = row(10, 4, between(1, MAX_OF["k"]), "paper", "children of an anchor")
    hidden: tuple = row(
        (32, 32), (32, 32), layers(MAX_LAYERS), "paper", "of anchor networks: 2 layers of 2d"
    )
    deformation: tuple = row(
        (192, 192), (64, 64), layers(MAX_LAYERS), "paper (Q1)", "hidden widths of psi_d"
    )
    L_x: int = row(10, 4, between(1, MAX_OF["L_x"]), "D3DGS (Q2)", "frequencies of x")
    L_t: int = row(6, 4, between(1, MAX_OF["L_t"]), "D3DGS (Q2)", "frequencies of t")
    context: tuple = row(
        (32, 32), (16, 16), layers(MAX_LAYERS), "paper", "psi_p and psi_q: two layers of 2d"
    )
    grid_3d: tuple = row(HAC_3D, (8,), layers(16), "HAC (Q11)", "resolutions")
    grid_2d: tuple = row(HAC_2D, (16,), layers(16), "HAC (Q11)", "resolutions in each plane")
    table_3d: int = row(
        2**13, 2**13, between(1, MAX_ENTRIES), "HAC (Q11)", "most nodes of a 3D level"
    )
    table_2d: int = row(
        2**15, 2**15, between(1, MAX_ENTRIES), "HAC (Q11)", "most nodes of a 2D level"
    )
    F: int = row(4, 2, between(1, MAX_OF["F"]), "HAC (Q11)", "bits of a node")
    tau_alpha: float = row(0.0, 0.0, between(0, 1), "Scaffold-GS (Q4)", "least opacity drawn")
    feature_std: float = row(0.0, 0.1, NOT_NEGATIVE, "Scaffold-GS (Q28)", "of the initial features")
    opacity_bias: float = row(0.0, 0.3, NOT_NEGATIVE, AS_PARENTS, "added to psi_alpha's last bias")
    upright: bool = row(False, True, FLAG, AS_PARENTS, "psi_r's last bias is (1, 0, 0, 0) at first")
    deformation_gain: float = row(1.0, 0.01, NOT_NEGATIVE, AS_PARENTS, "of psi_d's heads at first")
    # quantisation and rate
    Q_f: float = row(1.0, 0.25, STEP, "paper", "base step of f")
    Q_s: float = row(0.001, 0.01, STEP, "paper", "base step of s")
    Q_l: float = row(0.001, 0.01, STEP, "paper", "base step of l")
    Q_O: float = row(0.2, 0.1, STEP, "paper", "base step of O")
    lambda_rate: float = row(1e-3, 5e-4, NOT_NEGATIVE, "HAC (Q12)", "weight of the rate")
    # stages and loss
    stage_ends: tuple = row(
        (3000, 5000, 10_000, 40_000),
        (200, 300, 1800, 3800),
        ENDS,
        "paper",
        "iterations at which stages 1 to 4 end",
    )
    lambda_ssim: float = row(0.2, 0.2, between(0, 1), "3DGS (Q13)", "weight of D-SSIM")
    # learning rates: first and last, geometric over all iterations from `decay_from` on
    decay_from: int = row(0, 1800, NOT_NEGATIVE, "ours (Q17)", "first iteration of the decay")
    lr_x: tuple = row((0.0, 0.0), (0.002, 2e-4), RATE, "Scaffold-GS (Q14)", "positions")
    lr_f: tuple = row((0.0075, 0.0075), (0.015, 1.5e-3), RATE, LAST_SCAFFOLD, "features")
    lr_s: tuple = row((0.007, 0.007), (0.014, 1.4e-3), RATE, LAST_SCAFFOLD, "log s")
    lr_l: tuple = row((0.007, 0.007), (0.014, 1.4e-3), RATE, LAST_SCAFFOLD, "log l")
    lr_O: tuple = row((0.01, 1e-4), (0.02, 1e-3), RATE, LAST_SCAFFOLD, "offsets")
    lr_alpha: tuple = row((0.002, 2e-5), (0.001, 4e-5), RATE, LAST_SCAFFOLD, "psi_alpha")
    lr_c: tuple = row((0.008, 5e-5), (0.008, 1.6e-4), RATE, LAST_SCAFFOLD, "psi_c")
    lr_r: tuple = row((0.004, 0.004), (0.008, 3.2e-4), RATE, LAST_SCAFFOLD, "psi_r")
    lr_psi_s: tuple = row((0.004, 0.004), (0.008, 3.2e-4), RATE, LAST_SCAFFOLD, "psi_s")
    lr_d: tuple = row((1.6e-4, 1.6e-6), (0.002, 4e-5), RATE, "paper; last: D3DGS (Q17)", "psi_d")
    lr_grid: tuple = row((0.0016, 1e-5), (0.01, 1e-3), RATE, LAST_HAC, "hash grid")
    lr_p: tuple = row((0.005, 1e-5), (0.005, 2e-4), RATE, LAST_HAC, "psi_p")
    lr_q: tuple = row((0.005, 1e-5), (0.005, 2e-4), RATE, LAST_HAC, "psi_q")
    # growing, pruning and masking
    grow: str = row("scaffold", "reseed", GROWING, SCAFFOLD_Q16, "how anchors grow")
    grow_from: int = row(1500, 100, NOT_NEGATIVE, SCAFFOLD_Q16, "last iteration without growing")
    grow_every: int = row(100, 100, POSITIVE, SCAFFOLD_Q16, "iterations of a window")
    grow_until: int = row(15_000, 1500, NOT_NEGATIVE, SCAFFOLD_Q16, "first without growing")
    collect_from: int = row(500, 0, NOT_NEGATIVE, SCAFFOLD_Q16, "first iteration in the statistics")
    gradient_threshold: float = row(
        2e-4, 2e-4, NOT_NEGATIVE, SCAFFOLD_Q16, "of projected centres, to grow"
    )
    grow_init: int = row(16, 16, POSITIVE, "paper", "coarsest voxel for growing, in epsilon")
    grow_hierarchy: int = row(4, 4, POSITIVE, SCAFFOLD_Q16, "ratio of voxels of two levels")
    grow_depth: int = row(3, 3, between(0, 16), SCAFFOLD_Q16, "levels of growing")
    success: float = row(0.8, 0.8, NOT_NEGATIVE, SCAFFOLD_Q15, "share of a window to be judged")
    min_opacity: float = row(0.005, 0.03, NOT_NEGATIVE, SCAFFOLD_Q15, "below it an anchor is dead")
    mask_from: int = row(5000, 1800, NOT_NEGATIVE, "ours (Q15)", "first iteration with masking")

    @property
    def iterations(self) -> int:
        """The length of the training."""
        return self.stage_ends[-1]

    def stage(self, iteration: int) -> int:
        """The stage, 1 to 4, of an iteration counted from 0."""
        return 1 + sum(iteration >= end for end in self.stage_ends[:3])


def rows_of(preset):
    """The rows {name: field} of a preset or of its class; `metadata` has the columns of a row."""
    return {row.name: row for row in fields(preset) if row.metadata}


PAPER_SYNTHETIC = Preset()
PAPER_REAL = Preset(
    name="paper_real",
    voxel=0.01,
    d=32,
    hidden=(64, 64),
    context=(64, 64),
    L_t=10,
    stage_ends=(3000, 4000, 10_000, 20_000),
    mask_from=4000,
)
TINY = Preset(name="tiny", **{name: row.metadata["tiny"] for name, row in rows_of(Preset).items()})
# The points of a real scene know its depth, which few cameras cannot measure: anchors keep it.
TINY_REAL = replace(TINY, name="tiny_real", lr_x=PAPER_REAL.lr_x)
# For tests; published files were made with its learning rates.
SMOKE = replace(
    TINY,
    name="smoke",
    anchors=20,
    d=4,
    k=2,
    hidden=(8, 8),
    deformation=(16, 16),
    L_x=2,
    L_t=2,
    context=(8, 8),
    grid_3d=(4,),
    grid_2d=(8,),
    F=1,
    lambda_rate=1e-3,
    stage_ends=(10, 15, 30, 45),
    decay_from=15,
    lr_alpha=(0.001, 1e-4),
    lr_c=(0.008, 4e-4),
    lr_r=(0.008, 8e-4),
    lr_psi_s=(0.008, 8e-4),
    lr_d=(0.002, 1e-4),
    lr_p=(0.005, 5e-4),
    lr_q=(0.005, 5e-4),
    grow="off",
    mask_from=45,
)

PRESETS: dict[str, Preset] = {
    preset.name: preset for preset in (PAPER_SYNTHETIC, PAPER_REAL, TINY, TINY_REAL, SMOKE)
}


def differences(preset, against=PAPER_SYNTHETIC):
    """Every difference as (field, value of the other, value of the preset)."""
    return [
        (name, getattr(against, name), getattr(preset, name))
        for name in rows_of(preset)
        if getattr(against, name) != getattr(preset, name)
    ]


def choose(preset: str | Preset, changes: Mapping[str, Any] | None = None) -> Preset:
    """A preset, or the one of that name, with some fields changed.

    A change may also be a text, as on the command line. Raises ValueError with the name of the
    preset or field and what was expected.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise ValueError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    defaults = {name: row.default for name, row in rows_of(preset).items()}
    changed = replace(preset, **read_changes(preset.name, defaults, changes))
    for name, row in rows_of(preset).items():
        (expected, is_met), value = row.metadata["requirement"], getattr(changed, name)
        if not is_met(value):
            raise ValueError(f"field {name!r}: expected {expected}, got {value!r}")
    if not changed.grid_3d + changed.grid_2d:
        raise ValueError(
            "field 'grid_3d': expected a level here or in grid_2d; the context has no other input"
        )
    parts = declared_numbers(design_of(changed, MODEL_EFFECTS), changed.anchors)
    if sum(parts.values()) > MAX_NUMBERS:
        raise ValueError(
            f"fields 'anchors', 'grid_3d', 'hidden' and others: expected at most {MAX_NUMBERS} "
            f"numbers in a model, as many as a file may hold, got {parts}"
        )
    return changed


def read_changes(name, defaults, changes):
    """The values {field: value} of changes to the preset of that name.

    `defaults` has a value of every field.

    Raises ValueError for an unknown field, and for a value of another type.
    """
    values = {}
    for key, value in (changes or {}).items():
        if key == "name" or key not in defaults:
            raise ValueError(
                f"field {key!r} of preset {name}: no such field; `p4dgs-ref presets` lists them"
            )
        try:
            values[key] = read_value(value, defaults[key])
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"field {key!r}: expected a value like {defaults[key]!r}, got {value!r}"
            ) from None
    return values


def read_value(value, like):
    """The value as the type of `like`; a text is parsed, tuples are written with commas."""
    if isinstance(like, tuple):
        if isinstance(value, str):
            value = [part for part in value.split(",") if part.strip()]
        return tuple(read_value(part, like[0] if like else 0) for part in value)
    kind = type(like)
    if isinstance(value, str):
        return {"true": True, "false": False}[value.lower()] if kind is bool else kind(value)
    # True is not a number here, and a number with a fraction is not an integer
    if isinstance(value, bool) is not (kind is bool) or kind is str or kind(value) != value:
        raise TypeError
    return kind(value)
