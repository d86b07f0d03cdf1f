"""Every constant of training by name: the two presets of the paper and three small ones.

A preset is a column: `Preset` holds that of `paper_synthetic` with the source of every value, and
the others say what differs. `p4dgs-ref presets tiny` prints them side by side.
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
ENDS = (
    "four rising iterations",
    lambda ends: len(ends) == 4 and sorted((0, *ends)) == [0, *ends] and 1 <= ends[-1] <= MAX_VALUE,
)
GROWING = ("scaffold, reseed or off", lambda value: value in ("scaffold", "reseed", "off"))

# Sources, with the number of the choice in tutorials/reference.md.
AS_PARENTS = "off, as the parents (Q28)"
SCAFFOLD_Q15, SCAFFOLD_Q16 = "Scaffold-GS (Q15, Q16)", "Scaffold-GS (Q16)"
LAST_SCAFFOLD, LAST_HAC = "paper; last: Scaffold-GS (Q17)", "paper; last: HAC (Q17)"

# The paper gives no hash grid; these are the resolutions of HAC.
HAC_3D = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)
HAC_2D = (130, 258, 514, 1026)


def row(paper, source="paper", requirement=NOT_NEGATIVE) -> Any:
    """A field: its value in `paper_synthetic`, where that comes from, and what values it may have.

    A requirement is a text and a test.
    """
    return field(default=paper, metadata={"source": source, "requirement": requirement})


@dataclass(frozen=True)
class Preset:
    """All fields with their values in `paper_synthetic`.

    A file stores those that `model.Design` has, too.
    """

    name: str = "paper_synthetic"
    # architecture
    anchors: int = row(10_000, "Scaffold-GS (Q28)", POSITIVE)  # random points at the start
    extent: float = row(1.3, "Scaffold-GS (Q28)", POSITIVE)  # they are in [-extent, extent]^3
    voxel: float = row(0.001, requirement=POSITIVE)  # epsilon: points merge on this lattice
    d: int = row(16, requirement=between(1, MAX_OF["d"]))  # width of a feature
    k: int = row(10, requirement=between(1, MAX_OF["k"]))  # children of an anchor
    hidden: tuple = row((32, 32), requirement=layers(MAX_LAYERS))  # of anchor networks: 2 of 2d
    deformation: tuple = row((192, 192), "paper (Q1)", layers(MAX_LAYERS))  # hidden widths of psi_d
    L_x: int = row(10, "D3DGS (Q2)", between(1, MAX_OF["L_x"]))  # frequencies of x
    L_t: int = row(6, "D3DGS (Q2)", between(1, MAX_OF["L_t"]))  # frequencies of t
    context: tuple = row((32, 32), requirement=layers(MAX_LAYERS))  # of psi_p and psi_q: 2 of 2d
    grid_3d: tuple = row(HAC_3D, "HAC (Q11)", layers(16))  # resolutions
    grid_2d: tuple = row(HAC_2D, "HAC (Q11)", layers(16))  # resolutions in each plane
    table_3d: int = row(2**13, "HAC (Q11)", between(1, MAX_ENTRIES))  # most nodes of a 3D level
    table_2d: int = row(2**15, "HAC (Q11)", between(1, MAX_ENTRIES))  # most nodes of a 2D level
    F: int = row(4, "HAC (Q11)", between(1, MAX_OF["F"]))  # bits of a node
    tau_alpha: float = row(0.0, "Scaffold-GS (Q4)", between(0, 1))  # least opacity drawn
    feature_std: float = row(0.0, "Scaffold-GS (Q28)")  # of the initial features
    opacity_bias: float = row(0.0, AS_PARENTS)  # added to psi_alpha's last bias
    upright: bool = row(False, AS_PARENTS)  # whether psi_r's last bias is (1, 0, 0, 0) at first
    deformation_gain: float = row(1.0, AS_PARENTS)  # of psi_d's heads at first
    # quantisation and rate
    Q_f: float = row(1.0, requirement=STEP)  # base step of f
    Q_s: float = row(0.001, requirement=STEP)  # base step of s
    Q_l: float = row(0.001, requirement=STEP)  # base step of l
    Q_O: float = row(0.2, requirement=STEP)  # base step of O
    lambda_rate: float = row(1e-3, "HAC (Q12)")  # weight of the rate
    # stages and loss
    stage_ends: tuple = row((3000, 5000, 10_000, 40_000), requirement=ENDS)  # of stages 1 to 4
    lambda_ssim: float = row(0.2, "3DGS (Q13)", between(0, 1))  # weight of D-SSIM
    # learning rates: first and last, geometric over all iterations from `decay_from` on
    decay_from: int = row(0, "ours (Q17)")
    lr_x: tuple = row((0.0, 0.0), "Scaffold-GS (Q14)", RATE)  # positions
    lr_f: tuple = row((0.0075, 0.0075), LAST_SCAFFOLD, RATE)
    lr_s: tuple = row((0.007, 0.007), LAST_SCAFFOLD, RATE)  # of log s
    lr_l: tuple = row((0.007, 0.007), LAST_SCAFFOLD, RATE)  # of log l
    lr_O: tuple = row((0.01, 1e-4), LAST_SCAFFOLD, RATE)
    lr_alpha: tuple = row((0.002, 2e-5), LAST_SCAFFOLD, RATE)  # of psi_alpha
    lr_c: tuple = row((0.008, 5e-5), LAST_SCAFFOLD, RATE)
    lr_r: tuple = row((0.004, 0.004), LAST_SCAFFOLD, RATE)
    lr_psi_s: tuple = row((0.004, 0.004), LAST_SCAFFOLD, RATE)
    lr_d: tuple = row((1.6e-4, 1.6e-6), "paper; last: D3DGS (Q17)", RATE)
    lr_grid: tuple = row((0.0016, 1e-5), LAST_HAC, RATE)
    lr_p: tuple = row((0.005, 1e-5), LAST_HAC, RATE)
    lr_q: tuple = row((0.005, 1e-5), LAST_HAC, RATE)
    # growing, pruning and masking
    grow: str = row("scaffold", SCAFFOLD_Q16, GROWING)
    grow_from: int = row(1500, SCAFFOLD_Q16)  # the last iteration without growing
    grow_every: int = row(100, SCAFFOLD_Q16, POSITIVE)  # iterations of a window
    grow_until: int = row(15_000, SCAFFOLD_Q16)  # the first iteration without growing
    collect_from: int = row(500, SCAFFOLD_Q16)  # the first iteration in the statistics
    gradient_threshold: float = row(2e-4, SCAFFOLD_Q16)  # of projected centres, to grow
    grow_init: int = row(16, requirement=POSITIVE)  # coarsest voxel for growing, in epsilon
    grow_hierarchy: int = row(4, SCAFFOLD_Q16, POSITIVE)  # ratio of the voxels of two levels
    grow_depth: int = row(3, SCAFFOLD_Q16, between(0, 16))  # levels of growing
    success: float = row(0.8, SCAFFOLD_Q15)  # share of a window that it takes to be judged
    min_opacity: float = row(0.005, SCAFFOLD_Q15)  # below it an anchor is dead
    mask_from: int = row(5000, "ours (Q15)")  # the first iteration with masking

    @property
    def iterations(self) -> int:
        """The length of the training."""
        return self.stage_ends[-1]

    def stage(self, iteration: int) -> int:
        """The stage, 1 to 4, of an iteration counted from 0."""
        return 1 + sum(iteration >= end for end in self.stage_ends[:3])


def rows_of(preset):
    """The rows {name: field} of a preset or of its class; `metadata` has a field's source."""
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
TINY = Preset(
    name="tiny",
    anchors=200,
    extent=1.0,
    k=4,
    deformation=(64, 64),
    L_x=4,
    L_t=4,
    context=(16, 16),
    grid_3d=(8,),
    grid_2d=(16,),
    F=2,
    feature_std=0.1,
    opacity_bias=0.3,
    upright=True,
    deformation_gain=0.01,
    Q_f=0.25,
    Q_s=0.01,
    Q_l=0.01,
    Q_O=0.1,
    lambda_rate=5e-4,
    stage_ends=(200, 300, 1800, 3800),
    decay_from=1800,
    lr_x=(0.002, 2e-4),
    lr_f=(0.015, 1.5e-3),
    lr_s=(0.014, 1.4e-3),
    lr_l=(0.014, 1.4e-3),
    lr_O=(0.02, 1e-3),
    lr_alpha=(0.001, 4e-5),
    lr_c=(0.008, 1.6e-4),
    lr_r=(0.008, 3.2e-4),
    lr_psi_s=(0.008, 3.2e-4),
    lr_d=(0.002, 4e-5),
    lr_grid=(0.01, 1e-3),
    lr_p=(0.005, 2e-4),
    lr_q=(0.005, 2e-4),
    grow="reseed",
    grow_from=100,
    grow_until=1500,
    collect_from=0,
    min_opacity=0.03,
    mask_from=1800,
)
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
    changed = replace(preset, **read_changes(preset, changes))
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


def read_changes(preset, changes):
    """The values {field: value} of changes to a preset, with the types of its values.

    Raises ValueError for an unknown field, and for a value of another type.
    """
    values = {}
    for key, value in (changes or {}).items():
        if key == "name" or key not in vars(preset):
            raise ValueError(
                f"field {key!r} of preset {preset.name}: no such field; `p4dgs-ref presets` lists "
                "them"
            )
        like = getattr(preset, key)
        try:
            values[key] = read_value(value, like)
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"field {key!r}: expected a value like {like!r}, got {value!r}"
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
