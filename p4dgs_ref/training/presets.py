"""Every constant of training by name: the two settings of the paper and four small ones.

A value of `paper_synthetic` and `paper_real` comes from the paper or, where the paper gives none,
from the methods that it builds on or from us: `SOURCES` says from which. `differences(preset)`
lists what a preset changes.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from ..model import MOST_NUMBERS, declared_numbers
from ..scenes.scene import MODEL_EFFECTS
from .initial import design_of

# The paper gives no hash grid; these are the resolutions of HAC.
HAC_3D = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)
HAC_2D = (130, 258, 514, 1026)


class Preset(NamedTuple):
    """Architecture, quantisation, schedule, learning rates (first, last) and density control."""

    name: str = "paper_synthetic"
    # architecture
    anchors: int = 10_000  # random points at the start
    extent: float = 1.3  # they are uniform in [-extent, extent]^3
    voxel: float = 0.001  # epsilon: points are merged on this lattice; growing uses multiples of it
    d: int = 16
    k: int = 10
    hidden: tuple[int, ...] = (32, 32)  # two layers of 2d
    deformation: tuple[int, ...] = (192, 192)
    time_net: tuple[int, ...] = ()  # D3DGS has 256,30 (Q1)
    skip: bool = False  # the inputs of psi_d once more after its middle layer, as in D3DGS (Q1)
    L_x: int = 10
    L_t: int = 6
    context: tuple[int, ...] = (32, 32)  # two layers of 2d
    grid_3d: tuple[int, ...] = HAC_3D
    grid_2d: tuple[int, ...] = HAC_2D
    table_3d: int = 2**13
    table_2d: int = 2**15
    F: int = 4
    tau_alpha: float = 0.0
    feature_std: float = 0.0  # of the initial features
    opacity_bias: float = 0.0  # added to the last bias of psi_alpha: anchors start visible
    upright: bool = False  # the last bias of psi_r starts at (1, 0, 0, 0)
    deformation_gain: float = 1.0  # the heads of psi_d start smaller by this factor
    # quantisation and rate
    Q_f: float = 1.0
    Q_s: float = 0.001
    Q_l: float = 0.001
    Q_O: float = 0.2
    lambda_rate: float = 1e-3
    coded: bool = False  # the coded design, in a file of version 2; it goes beyond the paper
    position_bits: int = 16  # of an anchor's position, per axis; fewer only in the coded design
    network_ramp: int = 0  # iterations of stage 4 in which bits of coded networks reach full price
    # stages and loss
    stage_ends: tuple[int, ...] = (3000, 5000, 10_000, 40_000)
    lambda_ssim: float = 0.2
    sparse_share: float = 0.0  # of pixels unlike the background; a scene with less is sparse (Q13)
    sparse_ssim: float = 0.2  # lambda_ssim of a sparse scene in stages 1 and 2
    sparse_lr_c: float = 1.0  # factor of lr_c there
    lambda_volume: float = 0.0  # 0.01 in Scaffold-GS; not in the paper (Q25)
    # learning rates: first and last, geometric over all iterations from `decay_from` on
    decay_from: int = 0
    lr_x: tuple[float, ...] = (0.0, 0.0)
    lr_f: tuple[float, ...] = (0.0075, 0.0075)
    lr_s: tuple[float, ...] = (0.007, 0.007)
    lr_l: tuple[float, ...] = (0.007, 0.007)
    lr_O: tuple[float, ...] = (0.01, 1e-4)
    lr_alpha: tuple[float, ...] = (0.002, 2e-5)
    lr_c: tuple[float, ...] = (0.008, 5e-5)
    lr_r: tuple[float, ...] = (0.004, 0.004)
    lr_psi_s: tuple[float, ...] = (0.004, 0.004)
    lr_d: tuple[float, ...] = (1.6e-4, 1.6e-6)
    lr_grid: tuple[float, ...] = (0.0016, 1e-5)
    lr_p: tuple[float, ...] = (0.005, 1e-5)
    lr_q: tuple[float, ...] = (0.005, 1e-5)
    lr_step: tuple[float, ...] = (0.0, 0.0)  # of the logarithms of coded networks' steps
    # growing, pruning and masking
    grow: str = "scaffold"  # "scaffold", "reseed" or "off"
    grow_from: int = 1500
    grow_every: int = 100  # iterations of a window
    grow_until: int = 15_000  # the first iteration without growing
    collect_from: int = 500  # first iteration that counts in the statistics of density control
    gradient_threshold: float = 2e-4
    grow_init: int = 16  # the coarsest voxel for growing, in multiples of epsilon
    grow_hierarchy: int = 4
    grow_depth: int = 3
    success: float = 0.8  # share of a window in which an anchor must be seen; a child half of it
    min_opacity: float = 0.005
    mask_from: int = 5000  # from here on children may be masked for good

    @property
    def iterations(self) -> int:
        """The length of the training."""
        return self.stage_ends[-1]

    def stage(self, iteration: int) -> int:
        """The stage, 1 to 4, of an iteration counted from 0."""
        return 1 + sum(iteration >= end for end in self.stage_ends[:3])


# Where the values of the two paper presets come from, with the number of the choice in
# tutorials/reference.md. A rate has two values, the first and the last.
SOURCES = {
    **dict.fromkeys(("anchors", "extent"), "Scaffold-GS (Q28)"),
    **dict.fromkeys(("voxel", "d", "k", "hidden", "context", "grow_init", "stage_ends"), "paper"),
    **dict.fromkeys(("Q_f", "Q_s", "Q_l", "Q_O"), "paper"),
    **dict.fromkeys(("deformation", "time_net", "skip"), "paper (Q1)"),
    **dict.fromkeys(("L_x", "L_t"), "D3DGS (Q2)"),
    **dict.fromkeys(("grid_3d", "grid_2d", "table_3d", "table_2d", "F"), "HAC (Q11)"),
    "tau_alpha": "Scaffold-GS (Q4)",
    "feature_std": "Scaffold-GS (Q28)",
    **dict.fromkeys(("opacity_bias", "upright", "deformation_gain"), "off, as the parents (Q28)"),
    "lambda_rate": "HAC (Q12)",
    **dict.fromkeys(("coded", "network_ramp", "lr_step"), "off, as the paper"),
    "position_bits": "ours (Q14)",
    "lambda_ssim": "3DGS (Q13)",
    **dict.fromkeys(("sparse_share", "sparse_ssim", "sparse_lr_c"), "off, as the paper (Q13)"),
    "lambda_volume": "off, as the paper (Q25)",
    "decay_from": "ours (Q17)",
    "lr_x": "Scaffold-GS (Q14)",
    **dict.fromkeys(("lr_f", "lr_s", "lr_l", "lr_O"), "paper; last: Scaffold-GS (Q17)"),
    **dict.fromkeys(("lr_alpha", "lr_c"), "paper; last: Scaffold-GS (Q17)"),
    **dict.fromkeys(("lr_r", "lr_psi_s"), "paper; last: Scaffold-GS (Q17)"),
    "lr_d": "paper; last: D3DGS (Q17)",
    **dict.fromkeys(("lr_grid", "lr_p", "lr_q"), "paper; last: HAC (Q17)"),
    **dict.fromkeys(("grow", "grow_from", "grow_every", "grow_until"), "Scaffold-GS (Q16)"),
    **dict.fromkeys(("collect_from", "gradient_threshold"), "Scaffold-GS (Q16)"),
    **dict.fromkeys(("grow_hierarchy", "grow_depth"), "Scaffold-GS (Q16)"),
    **dict.fromkeys(("success", "min_opacity"), "Scaffold-GS (Q15, Q16)"),
    "mask_from": "ours (Q15)",
}

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
    voxel=0.001,
    k=4,
    hidden=(32, 32),
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
    sparse_share=0.1,
    sparse_ssim=0.6,
    sparse_lr_c=0.5,
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
    min_opacity=0.03,
    grow="reseed",
    grow_from=100,
    grow_every=100,
    grow_until=1500,
    collect_from=0,
    mask_from=1800,
)
# The fields that a preset beyond the paper changes.
BEYOND_THE_PAPER = ("coded", "position_bits", "network_ramp", "lr_step")
# Its networks pay for their bits (B1), and its positions have fewer of them (B2).
TINY_CODED = TINY._replace(
    name="tiny_coded",
    coded=True,
    position_bits=10,
    network_ramp=1000,
    lr_step=(0.02, 0.002),
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
    for preset in (PAPER_SYNTHETIC, PAPER_REAL, TINY, TINY_CODED, TINY_REAL, SMOKE)
}


INFINITY = float("inf")
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


def is_rate(value):
    """Whether a learning rate is two positive numbers, or off."""
    positive = len(value) == 2 and all(0 < rate < INFINITY for rate in value)
    return positive or tuple(value) == (0, 0)


def is_rising(ends):
    """Whether there are four ends of stages, in order and not all zero."""
    return len(ends) == 4 and sorted((0, *ends)) == [0, *ends] and 1 <= ends[-1] <= LARGEST


POSITIVE = (f"a positive number up to {LARGEST:g}", lambda value: 0 < value <= LARGEST)
NOT_NEGATIVE = between(0, LARGEST)
RATE = ("first,last, two positive rates or 0,0", is_rate)
STEP = between(2.0**-40, 2.0**40)
# What each field must be, in words and as a test; NOT_NEGATIVE where nothing else is said. Most
# limits are those of a file (codec/header.py).
REQUIREMENTS = {
    **dict.fromkeys(Preset._fields, NOT_NEGATIVE),
    **{field: RATE for field in Preset._fields if field.startswith("lr_")},
    "name": ("a name", lambda value: True),
    "anchors": POSITIVE,
    "extent": POSITIVE,
    "voxel": POSITIVE,
    "d": between(1, 4096),
    "k": between(1, 256),
    "F": between(1, 64),
    "L_x": between(1, 64),
    "L_t": between(1, 64),
    "hidden": layers(8),
    "deformation": layers(8),
    "time_net": layers(8),
    "skip": ("true or false", lambda value: True),
    "context": layers(8),
    "grid_3d": layers(16),
    "grid_2d": layers(16),
    "table_3d": between(1, 2**24),
    "table_2d": between(1, 2**24),
    "Q_f": STEP,
    "Q_s": STEP,
    "Q_l": STEP,
    "Q_O": STEP,
    "coded": ("true or false", lambda value: True),
    "position_bits": between(1, 16),
    "tau_alpha": between(0, 1),  # a file may hold less, but negative opacities are not rendered
    "lambda_ssim": between(0, 1),
    "sparse_ssim": between(0, 1),
    "stage_ends": ("four rising iterations", is_rising),
    "grow": ("scaffold, reseed or off", lambda value: value in ("scaffold", "reseed", "off")),
    "grow_every": POSITIVE,
    "grow_init": POSITIVE,
    "grow_hierarchy": POSITIVE,
    "grow_depth": between(0, 16),  # the threshold of a level is a power of the hierarchy
}


def differences(preset, against=PAPER_SYNTHETIC):
    """Every difference as (field, value of the paper, value of the preset)."""
    return [
        (field, getattr(against, field), value)
        for field, value in preset._asdict().items()
        if field != "name" and getattr(against, field) != value
    ]


def paper_design(preset):
    """The preset without what goes beyond the paper (B1, B2), under the same name."""
    return preset._replace(**{field: getattr(PAPER_SYNTHETIC, field) for field in BEYOND_THE_PAPER})


def choose(preset: str | Preset, changes: Mapping[str, Any] | None = None) -> Preset:
    """A preset, or the preset of that name, with some fields changed.

    A change may also be a text, as on the command line. Raises ValueError with the name of the
    preset or field and what was expected.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise ValueError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    values = read_changes(preset.name, PAPER_SYNTHETIC._asdict(), changes)
    chosen = preset._replace(**values)
    for field, (expected, is_met) in REQUIREMENTS.items():
        value = getattr(chosen, field)
        if not is_met(value):
            raise ValueError(f"field {field!r}: expected {expected}, got {value!r}")
    if not chosen.grid_3d + chosen.grid_2d:
        raise ValueError(
            "field 'grid_3d': expected a level here or in grid_2d; the context has no other input"
        )
    if chosen.skip and len(chosen.deformation) < 3:
        raise ValueError("field 'skip': expected at least three layers in the field deformation")
    if chosen.position_bits != 16 and not chosen.coded:
        raise ValueError("field 'position_bits': expected 16 where the field coded is false")
    parts = declared_numbers(design_of(chosen, MODEL_EFFECTS), chosen.anchors)
    if sum(parts.values()) > MOST_NUMBERS:
        raise ValueError(
            f"fields 'anchors', 'grid_3d', 'hidden' and others: expected at most {MOST_NUMBERS} "
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
        like = fields[field]
        try:
            values[field] = read_value(value, like)
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"field {field!r}: expected a value like {like!r}, got {value!r}"
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
        words = {"true": True, "false": False, "1": True, "0": False}
        return words[value.lower()] if kind is bool else kind(value)
    # True is not a number here, and a number with a fraction is not an integer
    if isinstance(value, bool) is not (kind is bool) or kind is str or kind(value) != value:
        raise TypeError
    return kind(value)
