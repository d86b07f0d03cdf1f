"""Every constant of training by name: the two presets of the paper and three small ones.

A preset is a column: `Preset` itself is that of `paper_synthetic`, and the others say what differs.
`p4dgs-ref presets tiny` prints them side by side.
"""

import re
from dataclasses import dataclass, replace

from ..limits import MAX_ENTRIES, MAX_LAYERS, MAX_OF, MAX_WIDTH
from ..model import over_file
from ..scenes.scene import MODEL_EFFECTS
from .initial import design_of


@dataclass(frozen=True)
class Preset:
    """All fields with their values in `paper_synthetic`; SOURCES says where these come from.

    A file stores the fields that `model.Design` has, too.
    """

    name: str = "paper_synthetic"
    # architecture
    anchors: int = 10_000  # random points at the start,
    extent: float = 1.3  # in [-extent, extent]^3
    voxel: float = 0.001  # epsilon: points merge on this lattice
    d: int = 16  # width of a feature
    k: int = 10  # children of an anchor
    hidden: tuple = (32, 32)  # hidden widths of anchor networks: two layers of 2d
    deformation: tuple = (192, 192)  # hidden widths of psi_d
    L_x: int = 10  # frequencies of x
    L_t: int = 6  # frequencies of t
    context: tuple = (32, 32)  # hidden widths of psi_p and psi_q: two layers of 2d
    # resolutions of the 3D levels of the hash grid, and of the levels in each plane; the paper
    # gives none
    grid_3d: tuple = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)
    grid_2d: tuple = (130, 258, 514, 1026)
    table_3d: int = 2**13  # most nodes of a 3D level
    table_2d: int = 2**15  # most nodes of a 2D level
    F: int = 4  # entries of a node, one bit each
    tau_alpha: float = 0.0  # least opacity drawn
    feature_std: float = 0.0  # of the initial features
    opacity_bias: float = 0.0  # added to psi_alpha's last bias
    upright: bool = False  # whether (1, 0, 0, 0) is added to psi_r's last bias
    deformation_gain: float = 1.0  # factor of psi_d's heads at the start
    # quantisation and rate
    Q_f: float = 1.0  # base steps of f, s, l and O
    Q_s: float = 0.001
    Q_l: float = 0.001
    Q_O: float = 0.2
    lambda_rate: float = 1e-3  # weight of the rate
    # stages and loss
    stage_ends: tuple = (3000, 5000, 10_000, 40_000)  # iterations
    lambda_ssim: float = 0.2  # weight of D-SSIM
    # learning rates: first and last, geometric over all iterations from `decay_from` on
    decay_from: int = 0
    lr_x: tuple = (0.0, 0.0)  # positions
    lr_f: tuple = (0.0075, 0.0075)
    lr_s: tuple = (0.007, 0.007)  # log s
    lr_l: tuple = (0.007, 0.007)  # log l
    lr_O: tuple = (0.01, 1e-4)
    lr_alpha: tuple = (0.002, 2e-5)  # psi_alpha
    lr_c: tuple = (0.008, 5e-5)  # psi_c
    lr_r: tuple = (0.004, 0.004)  # psi_r
    lr_psi_s: tuple = (0.004, 0.004)
    lr_d: tuple = (1.6e-4, 1.6e-6)  # psi_d
    lr_grid: tuple = (0.0016, 1e-5)  # hash grid
    lr_p: tuple = (0.005, 1e-5)  # psi_p
    lr_q: tuple = (0.005, 1e-5)  # psi_q
    # growing, pruning and masking
    grow: str = "scaffold"  # how anchors grow
    grow_from: int = 1500  # last iteration without growing
    grow_every: int = 100  # iterations of a window
    grow_until: int = 15_000  # first iteration without growing
    collect_from: int = 500  # first iteration in the statistics
    gradient_threshold: float = 2e-4  # of projected centres, to grow
    grow_init: int = 16  # coarsest voxel for growing, in epsilon
    grow_hierarchy: int = 4  # ratio of voxels of two levels
    grow_depth: int = 3  # levels of growing
    success: float = 0.8  # share of a window's views that a judgement needs
    min_opacity: float = 0.005  # below it an anchor is dead
    mask_from: int = 5000  # first iteration with masking

    @property
    def iterations(self):
        """The length of the training."""
        return self.stage_ends[-1]

    def stage(self, iteration):
        """Return the stage, 1 to 4, of an iteration counted from 0."""
        return 1 + sum(iteration >= end for end in self.stage_ends[:3])


FIELDS = tuple(Preset.__annotations__)[1:]  # without the name


def by_field(table):
    """Return {field: value} of a table {names of fields: value}."""
    return {name: value for names, value in table.items() for name in names.split()}


# Where the values of the paper's presets come from; a Q is a choice in tutorials/reference.md.
SOURCES = by_field(
    {
        "voxel d k hidden context Q_f Q_s Q_l Q_O stage_ends grow_init": "paper",
        "anchors extent feature_std": "Scaffold-GS (Q28)",
        "deformation": "paper (Q1)",
        "L_x L_t": "D3DGS (Q2)",
        "grid_3d grid_2d table_3d table_2d F": "HAC (Q11)",
        "tau_alpha": "Scaffold-GS (Q4)",
        "opacity_bias upright deformation_gain": "off, as in the parents (Q28)",
        "lambda_rate": "HAC (Q12)",
        "lambda_ssim": "3DGS (Q13)",
        "decay_from": "chosen here (Q17)",
        "lr_x": "Scaffold-GS (Q14)",
        "lr_f lr_s lr_l lr_O lr_alpha lr_c lr_r lr_psi_s": "paper; last: Scaffold-GS (Q17)",
        "lr_d": "paper; last: D3DGS (Q17)",
        "lr_grid lr_p lr_q": "paper; last: HAC (Q17)",
        "grow grow_from grow_every grow_until collect_from": "Scaffold-GS (Q16)",
        "gradient_threshold grow_hierarchy grow_depth": "Scaffold-GS (Q16)",
        "success min_opacity": "Scaffold-GS (Q15, Q16)",
        "mask_from": "chosen here (Q15)",
    }
)

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
# The points of a real scene have depths that its few cameras cannot measure: anchors stay there.
TINY_REAL = replace(TINY, name="tiny_real", lr_x=PAPER_REAL.lr_x)
# For tests.
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
    grow="off",
    mask_from=45,
)

PRESETS = {preset.name: preset for preset in (PAPER_SYNTHETIC, PAPER_REAL, TINY, TINY_REAL, SMOKE)}


MAX_VALUE = 1e18  # of a field: an integer of a hundred digits could not become a float


def number_from(least, most):
    """Return the requirement that a number is from `least` to `most`."""
    return f"a number from {least:g} to {most:g}", lambda value: least <= value <= most


def widths(most):
    """Return the requirement on the hidden widths of a network or the resolutions of a grid."""
    return (
        f"at most {most} numbers from 1 to {MAX_WIDTH}",
        lambda value: len(value) <= most and all(1 <= n <= MAX_WIDTH for n in value),
    )


# What a field must be, in words and as a test; a field that is not listed must be a number that is
# not negative. With larger rates, lengths and first parameters, or with smaller steps Q, a training
# ends with weights beyond float16 or |f / q| beyond 2^31, which no file can contain.
REQUIREMENTS = {name: number_from(1, most) for name, most in MAX_OF.items()} | by_field(
    {
        "anchors grow_every grow_init grow_hierarchy": number_from(1, MAX_VALUE),
        "extent voxel": number_from(1e-9, 1e4),
        "feature_std opacity_bias deformation_gain": number_from(0, 1e3),
        "hidden deformation context": widths(MAX_LAYERS),
        "grid_3d grid_2d": widths(16),
        "table_3d table_2d": number_from(1, MAX_ENTRIES),
        "tau_alpha lambda_ssim": number_from(0, 1),
        "Q_f Q_s Q_l Q_O": number_from(1e-5, 1e5),
        "lr_x lr_f lr_s lr_l lr_O lr_alpha lr_c lr_r lr_psi_s lr_d lr_grid lr_p lr_q": (
            "first,last, two positive learning rates up to 1 or 0,0",
            lambda ends: (
                len(ends) == 2 and all(0 <= n <= 1 for n in ends) and all(ends) == any(ends)
            ),
        ),
        "stage_ends": (
            "four increasing iterations",
            lambda ends: (
                len(ends) == 4 and sorted((0, *ends)) == [0, *ends] and 1 <= ends[-1] <= MAX_VALUE
            ),
        ),
        "grow": ("scaffold, reseed or off", lambda value: value in ("scaffold", "reseed", "off")),
        "grow_depth": number_from(0, 16),
    }
)


def differences(preset, against=PAPER_SYNTHETIC):
    """Return every difference as (field, value of the other, value of the preset)."""
    return [
        (name, getattr(against, name), getattr(preset, name))
        for name in FIELDS
        if getattr(against, name) != getattr(preset, name)
    ]


def choose(preset, changes=None):
    """Return a preset, or the one of that name, with some fields changed.

    A change may also be a text, as on the command line. Raises ValueError with the name of the
    preset or field and what was expected.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise ValueError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    values = {}
    for name, value in (changes or {}).items():
        if name not in FIELDS:
            raise ValueError(
                f"field {name!r} of preset {preset.name}: no such field; `p4dgs-ref presets` lists "
                "them"
            )
        like = getattr(preset, name)
        try:
            values[name] = read_value(value, like)
        except (ValueError, KeyError, TypeError, OverflowError):
            raise ValueError(
                f"field {name!r}: expected a value like {like!r}, got {value!r}"
            ) from None
    changed = replace(preset, **values)
    for name in FIELDS:
        value = getattr(changed, name)
        expected, is_met = REQUIREMENTS.get(name, number_from(0, MAX_VALUE))
        if not is_met(value):
            raise ValueError(f"field {name!r}: expected {expected}, got {value!r}")
    if not changed.grid_3d + changed.grid_2d:
        raise ValueError(
            "field 'grid_3d': expected a level here or in grid_2d; the context has no other input"
        )
    if changed.grow_from > changed.grow_until:
        raise ValueError(f"field 'grow_until': expected at least grow_from, {changed.grow_from}")
    if excess := over_file(design_of(changed, MODEL_EFFECTS), changed.anchors):
        raise ValueError(f"fields 'anchors', 'grid_3d', 'hidden' and others: {excess}")
    return changed


def read_value(value, like):
    """Return the value in the type of `like`; a text is parsed, commas separate tuple items."""
    if isinstance(like, tuple):
        if isinstance(value, str):
            value = value.replace(",", " ").split()
        return tuple(read_value(part, like[0] if like else 0) for part in value)
    kind = type(like)
    if isinstance(value, str):
        if re.search("[^!-~]|_", value):  # Python reads "1_0" as 10, and "4 " as 4
            raise ValueError
        return {"true": True, "false": False}[value.lower()] if kind is bool else kind(value)
    # True is not a number here, and a number with a fraction is not an integer
    if isinstance(value, bool) is not (kind is bool) or kind is str or kind(value) != value:
        raise TypeError
    return kind(value)
