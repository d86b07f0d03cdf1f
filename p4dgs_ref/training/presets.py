"""Every constant of training by name: the two settings of the paper and five small ones.

`Preset` is a table with one row a field. From it follow SOURCES, what `choose` accepts, the values
of `tiny`, and what `initial.design_of` puts into a file. `differences(preset)` lists what a preset
changes.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from ..model import MAX_NUMBERS, declared_numbers
from ..scenes.scene import MODEL_EFFECTS
from .initial import design_of

LARGEST = 1e18  # of a field: an integer of a hundred digits could not become a float


def between(least, most):
    """The requirement that a number is from `least` to `most`."""
    return f"a number from {least:g} to {most:g}", lambda value: least <= value <= most


def layers(most):
    """The requirement on the widths of a network or the resolutions of a grid."""
    return (
        f"at most {most} numbers from 1 to 16384",
        lambda value: len(value) <= most and all(1 <= n <= 2**14 for n in value),
    )


POSITIVE = (f"a positive number up to {LARGEST:g}", lambda value: 0 < value <= LARGEST)
NOT_NEGATIVE = between(0, LARGEST)
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
    lambda ends: len(ends) == 4 and sorted((0, *ends)) == [0, *ends] and 1 <= ends[-1] <= LARGEST,
)
GROWING = ("scaffold, reseed or off", lambda value: value in ("scaffold", "reseed", "off"))

# Where values of the paper's presets come from, with the number of the choice in
# tutorials/reference.md. A rate has two values, the first and the last.
AS_PARENTS = "off, as the parents (Q28)"
OFF = "off, as the paper"
SCAFFOLD_Q15, SCAFFOLD_Q16 = "Scaffold-GS (Q15, Q16)", "Scaffold-GS (Q16)"
LAST_SCAFFOLD, LAST_HAC = "paper; last: Scaffold-GS (Q17)", "paper; last: HAC (Q17)"

# The paper gives no hash grid; these are the resolutions of HAC.
HAC_3D = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)
HAC_2D = (130, 258, 514, 1026)

_rows = []  # of all fields but the name


def row(paper, tiny, requirement, source, meaning) -> Any:
    """Note what the table says of its next field; returns the value in `paper_synthetic`."""
    _rows.append((tiny, requirement, source, meaning))
    return paper


class Preset(NamedTuple):
    """The table of all fields. A file stores those that `model.Design` has, too.

    name: type = row(in paper_synthetic, in tiny, requirement, source of the former, meaning)

    A requirement is a text and a test.
    """

    name: str = "paper_synthetic"
    # architecture
    anchors: int = row(10_000, 200, POSITIVE, "Scaffold-GS (Q28)", "random points at the start")
    extent: float = row(1.3, 1.0, POSITIVE, "Scaffold-GS (Q28)", "in [-extent, extent]^3")
    voxel: float = row(0.001, 0.001, POSITIVE, "paper", "epsilon: points merge on this lattice")
    d: int = row(16, 16, between(1, 4096), "paper", "width of a feature")
    k: int = row(10, 4, between(1, 256), "paper", "children of an anchor")
    hidden: tuple = row(
        (32, 32), (32, 32), layers(8), "paper", "of anchor networks: 2 layers of 2d"
    )
    deformation: tuple = row(
        (192, 192), (64, 64), layers(8), "paper (Q1)", "hidden widths of psi_d"
    )
    L_x: int = row(10, 4, between(1, 64), "D3DGS (Q2)", "frequencies of x")
    L_t: int = row(6, 4, between(1, 64), "D3DGS (Q2)", "frequencies of t")
    context: tuple = row(
        (32, 32), (16, 16), layers(8), "paper", "psi_p and psi_q: two layers of 2d"
    )
    grid_3d: tuple = row(HAC_3D, (8,), layers(16), "HAC (Q11)", "resolutions")
    grid_2d: tuple = row(HAC_2D, (16,), layers(16), "HAC (Q11)", "resolutions in each plane")
    table_3d: int = row(2**13, 2**13, between(1, 2**24), "HAC (Q11)", "most nodes of a 3D level")
    table_2d: int = row(2**15, 2**15, between(1, 2**24), "HAC (Q11)", "most nodes of a 2D level")
    F: int = row(4, 2, between(1, 64), "HAC (Q11)", "bits of a node")
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
    coded: bool = row(False, False, FLAG, OFF, "networks that pay for their bits (B1)")
    position_bits: int = row(
        16, 16, between(1, 16), "ours (Q14)", "positions of few bits per axis, sorted (B2)"
    )
    network_ramp: int = row(0, 0, NOT_NEGATIVE, OFF, "iterations until coded networks pay fully")
    # stages and loss
    stage_ends: tuple = row(
        (3000, 5000, 10_000, 40_000),
        (200, 300, 1800, 3800),
        ENDS,
        "paper",
        "iterations at which stages 1 to 4 end",
    )
    lambda_ssim: float = row(0.2, 0.2, between(0, 1), "3DGS (Q13)", "weight of D-SSIM")
    body: bool = row(False, False, FLAG, OFF, "more weight in L1 for what moves (B3)")
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
    lr_step: tuple = row((0.0, 0.0), (0.0, 0.0), RATE, OFF, "logarithms of coded networks' steps")
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


ROWS = dict(zip(Preset._fields[1:], _rows, strict=True))
SOURCES = {field: source for field, (_, _, source, _) in ROWS.items()}

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
TINY = Preset("tiny", *(tiny for tiny, *_ in _rows))
# Its networks pay for their bits (B1), its positions have fewer of them (B2), and what moves counts
# more until it has learned to move (B3).
TINY_CODED = TINY._replace(
    name="tiny_coded",
    coded=True,
    position_bits=10,
    network_ramp=1000,
    body=True,
    lr_step=(0.02, 0.002),
)
# For quality, in at most three times the time. Anchors of four children fitted the training views
# of `figure` nearly as well as those of one, but new views showed a hole in a leg. A single child
# needs only shallow networks and, because it has an offset of its own, few bits of a position.
SMALL_CODED = TINY_CODED._replace(
    name="small_coded",
    anchors=1000,
    k=1,
    hidden=(32,),
    position_bits=8,
    opacity_bias=0.6,  # single children share one bias: from 0.3, all faded out with one seed of 16
    deformation=(128, 128),
    Q_f=0.125,
    Q_s=0.005,
    Q_l=0.005,
    Q_O=0.05,
    lambda_rate=3e-4,
    stage_ends=(200, 300, 3000, 6500),
    decay_from=3000,
    lr_d=(0.0015, 4e-5),
    grow_until=2500,
    mask_from=3000,
)
# The points of a real scene know its depth, which few cameras cannot measure: anchors keep it.
TINY_REAL = TINY._replace(name="tiny_real", lr_x=PAPER_REAL.lr_x)
# For tests; published files were made with its learning rates.
SMOKE = TINY._replace(
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
    preset.name: preset
    for preset in (PAPER_SYNTHETIC, PAPER_REAL, TINY, TINY_CODED, SMALL_CODED, TINY_REAL, SMOKE)
}


def differences(preset, against=PAPER_SYNTHETIC):
    """Every difference as (field, value of the paper, value of the preset)."""
    return [
        (field, getattr(against, field), value)
        for field, value in preset._asdict().items()
        if field != "name" and getattr(against, field) != value
    ]


def beyond(preset):
    """What goes beyond the paper in a preset, a sentence each."""
    fields = [field for field, _, _ in differences(preset, paper_design(preset))]
    return [ROWS[field][3] for field in fields if "(B" in ROWS[field][3]]


def paper_design(preset):
    """The preset without what goes beyond the paper (B1 to B3), under the same name."""
    beyond = [field for field, _, _ in differences(TINY_CODED, TINY)]
    return preset._replace(**{field: getattr(PAPER_SYNTHETIC, field) for field in beyond})


def choose(preset: str | Preset, changes: Mapping[str, Any] | None = None) -> Preset:
    """A preset, or the preset of that name, with some fields changed.

    A change may also be a text, as on the command line. Raises ValueError with the name of the
    preset or field and what was expected.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise ValueError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    chosen = preset._replace(**read_changes(preset.name, PAPER_SYNTHETIC._asdict(), changes))
    for field, (_, (expected, is_met), _, _) in ROWS.items():
        value = getattr(chosen, field)
        if not is_met(value):
            raise ValueError(f"field {field!r}: expected {expected}, got {value!r}")
    if not chosen.grid_3d + chosen.grid_2d:
        raise ValueError(
            "field 'grid_3d': expected a level here or in grid_2d; the context has no other input"
        )
    if chosen.position_bits != 16 and not chosen.coded:
        raise ValueError("field 'position_bits': expected 16 where the field coded is false")
    parts = declared_numbers(design_of(chosen, MODEL_EFFECTS), chosen.anchors)
    if sum(parts.values()) > MAX_NUMBERS:
        raise ValueError(
            f"fields 'anchors', 'grid_3d', 'hidden' and others: expected at most {MAX_NUMBERS} "
            f"numbers in a model, as many as a file may hold, got {parts}"
        )
    return chosen


def read_changes(name, fields, changes):
    """The values {field: value} of changes to the preset of that name; `fields` has a value each.

    Raises ValueError for an unknown field, and for a value of another type.
    """
    values = {}
    for field, value in (changes or {}).items():
        if field == "name" or field not in fields:
            raise ValueError(
                f"field {field!r} of preset {name}: no such field; `p4dgs-ref presets` lists them"
            )
        try:
            values[field] = read_value(value, fields[field])
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"field {field!r}: expected a value like {fields[field]!r}, got {value!r}"
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
