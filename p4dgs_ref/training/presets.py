"""Every constant of training by name: the paper's two settings and the two small ones, each change visible.

A field's value in `paper_synthetic` comes from the paper or, where it is silent, from its parents (README, Choices).
`differences(preset)` lists what a small preset changes, with the paper's value beside it.
"""

from typing import NamedTuple

HAC_3D = (
    18,
    24,
    33,
    44,
    59,
    80,
    108,
    148,
    201,
    275,
    376,
    514,
)  # the paper gives no hash grid: HAC's
HAC_2D = (130, 258, 514, 1026)


class Preset(NamedTuple):
    """Field by field: architecture, quantisation, schedule, learning rates (first, last), density."""

    name: str = "paper_synthetic"
    # architecture
    anchors: int = 10_000  # random points at the start
    extent: float = 1.3  # they are uniform in [-extent, extent]^3
    voxel: float = (
        0.001  # epsilon: points are merged on this lattice, growing works in its multiples
    )
    d: int = 16
    k: int = 10
    hidden: tuple = (32, 32)  # 2d, two layers
    deformation: tuple = (192, 192)
    L_x: int = 10
    L_t: int = 6
    context: tuple = (32, 32)  # 2d, two layers
    grid_3d: tuple = HAC_3D
    grid_2d: tuple = HAC_2D
    table_3d: int = 2**13
    table_2d: int = 2**15
    F: int = 4
    tau_alpha: float = 0.0
    feature_std: float = 0.0  # of the initial features
    opacity_bias: float = 0.0  # added to psi_alpha's last bias, so that anchors start visible
    upright: bool = False  # psi_r's last bias starts at (1, 0, 0, 0)
    deformation_gain: float = 1.0  # the heads of psi_d start this much smaller
    # quantisation and rate
    Q_f: float = 1.0
    Q_s: float = 0.001
    Q_l: float = 0.001
    Q_O: float = 0.2
    lambda_rate: float = 1e-3
    # stages and loss
    stage_ends: tuple = (3000, 5000, 10_000, 40_000)
    lambda_ssim: float = 0.2
    lambda_volume: float = 0.0  # Scaffold-GS's 0.01; not in the paper (Q25)
    # learning rates: first, last; geometric over all iterations from `decay_from` on
    decay_from: int = 0
    lr_x: tuple = (0.0, 0.0)
    lr_f: tuple = (0.0075, 0.0075)
    lr_s: tuple = (0.007, 0.007)
    lr_l: tuple = (0.007, 0.007)
    lr_O: tuple = (0.01, 1e-4)
    lr_alpha: tuple = (0.002, 2e-5)
    lr_c: tuple = (0.008, 5e-5)
    lr_r: tuple = (0.004, 0.004)
    lr_psi_s: tuple = (0.004, 0.004)
    lr_d: tuple = (1.6e-4, 1.6e-6)
    lr_grid: tuple = (0.0016, 1e-5)
    lr_p: tuple = (0.005, 1e-5)
    lr_q: tuple = (0.005, 1e-5)
    # growing, pruning, masking (iterations; thresholds)
    grow: str = "scaffold"  # "scaffold", "reseed" or "off"
    grow_from: int = 1500
    grow_every: int = 100
    grow_until: int = 15_000
    collect_from: int = 500
    gradient_threshold: float = 2e-4
    grow_init: int = 16  # coarsest growing voxel, in multiples of epsilon
    grow_hierarchy: int = 4
    grow_depth: int = 3
    success: float = 0.8  # an anchor must be seen in this share of a window, a child in half of it
    min_opacity: float = 0.005
    mask_from: int = 5000  # children may be masked for good from here on

    @property
    def iterations(self):
        return self.stage_ends[-1]

    def stage(self, iteration):
        """1 to 4 for an iteration counted from 0."""
        return 1 + sum(iteration >= end for end in self.stage_ends[:3])


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
    stage_ends=(200, 300, 1800, 3800),
    decay_from=300,
    lr_x=(0.002, 2e-4),
    lr_f=(0.015, 1.5e-3),
    lr_s=(0.014, 1.4e-3),
    lr_l=(0.014, 1.4e-3),
    lr_O=(0.02, 1e-3),
    lr_alpha=(0.001, 1e-4),
    lr_c=(0.008, 4e-4),
    lr_r=(0.008, 8e-4),
    lr_psi_s=(0.008, 8e-4),
    lr_d=(0.002, 1e-4),
    lr_grid=(0.01, 1e-3),
    lr_p=(0.005, 5e-4),
    lr_q=(0.005, 5e-4),
    min_opacity=0.03,
    grow="reseed",
    grow_from=100,
    grow_every=100,
    grow_until=1400,
    collect_from=0,
    mask_from=1800,
)
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
    stage_ends=(10, 15, 30, 45),
    decay_from=15,
    grow="off",
    mask_from=45,
)

PRESETS = {preset.name: preset for preset in (PAPER_SYNTHETIC, PAPER_REAL, TINY, SMOKE)}


def differences(preset, against=PAPER_SYNTHETIC):
    """[(field, paper's value, this preset's value)] for everything that differs."""
    return [
        (field, getattr(against, field), value)
        for field, value in preset._asdict().items()
        if field != "name" and getattr(against, field) != value
    ]


def choose(preset, changes=None):
    """A preset, or the preset of that name, with some fields changed; a change may be text, as the command line's are.

    Raises     ValueError naming the preset or the field and what was expected
    """
    if isinstance(preset, str) and preset not in PRESETS:
        raise ValueError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}")
    preset, values = PRESETS[preset] if isinstance(preset, str) else preset, {}
    for field, value in (changes or {}).items():
        if field == "name" or field not in Preset._fields:
            raise ValueError(
                f"field {field!r} of preset {preset.name}: no such field; `p4dgs-ref presets` lists them"
            )
        values[field] = _parse(field, value, getattr(PAPER_SYNTHETIC, field))
    return _checked(preset._replace(**values))


def _parse(field, value, like):
    """A value of the kind that `like` is, or the text of one; tuples are written with commas.

    Raises     ValueError naming the field
    """
    kind = type(like[0]) if isinstance(like, tuple) else type(like)
    try:
        if isinstance(like, tuple):
            parts = (
                [part for part in value.split(",") if part.strip()]
                if isinstance(value, str)
                else value
            )
            return tuple(_number(part, kind) for part in parts)
        if kind is bool and isinstance(value, str):
            return {"true": True, "false": False, "1": True, "0": False}[value.lower()]
        return _number(value, kind)
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"field {field!r}: expected a value like {like!r}, got {value!r}"
        ) from None


def _number(value, kind):
    """One element: text is read; a bool is no number, and a number with a fraction no whole one."""
    if isinstance(value, str):
        return value if kind is str else kind(value)
    if isinstance(value, bool) is not (kind is bool) or kind is str or kind(value) != value:
        raise TypeError
    return kind(value)


def _checked(preset):
    ends = preset.stage_ends
    if len(ends) != 4 or any(b < a for a, b in zip((0, *ends[:-1]), ends)) or ends[-1] < 1:
        raise ValueError(f"field 'stage_ends': expected four rising iterations, got {ends}")
    for field in (
        "anchors",
        "d",
        "k",
        "F",
        "voxel",
        "extent",
        "Q_f",
        "Q_s",
        "Q_l",
        "Q_O",
        "table_3d",
        "table_2d",
        "grow_every",
        "grow_init",
        "grow_hierarchy",
        "L_x",
        "L_t",
    ):
        value = getattr(preset, field)
        if not (value > 0 and value < float("inf")):
            raise ValueError(f"field {field!r}: expected a positive number, got {value!r}")
    for field, most in (
        ("hidden", 8),
        ("deformation", 8),
        ("context", 8),
        ("grid_3d", 16),
        ("grid_2d", 16),
    ):
        value = getattr(preset, field)  # within what a file can hold, see codec/header.py
        if any(not 1 <= n <= 2**14 for n in value) or len(value) > most:
            raise ValueError(
                f"field {field!r}: expected at most {most} numbers from 1 to 16384, got {value}"
            )
    for field, least, most in (
        ("Q_f", 2.0**-40, 2.0**40),
        ("Q_s", 2.0**-40, 2.0**40),
        ("Q_l", 2.0**-40, 2.0**40),
        ("Q_O", 2.0**-40, 2.0**40),
        ("table_3d", 1, 2**24),
        ("table_2d", 1, 2**24),
    ):
        if not least <= getattr(preset, field) <= most:
            raise ValueError(
                f"field {field!r}: expected a number from {least:g} to {most:g}, got {getattr(preset, field)}"
            )
    for field, most in (
        ("d", 4096),
        ("k", 256),
        ("F", 64),
        ("L_x", 64),
        ("L_t", 64),
        ("lambda_ssim", 1),
    ):
        if getattr(preset, field) > most:
            raise ValueError(
                f"field {field!r}: expected at most {most}, got {getattr(preset, field)}"
            )
    for field, value in preset._asdict().items():
        if (
            field != "tau_alpha"
            and isinstance(value, (int, float))
            and not 0 <= value < float("inf")
        ):
            raise ValueError(
                f"field {field!r}: expected a finite number of at least 0, got {value!r}"
            )
        if field.startswith("lr_") and not (
            len(value) == 2 and all(0 < v < float("inf") for v in value) or tuple(value) == (0, 0)
        ):
            raise ValueError(
                f"field {field!r}: expected first,last, two positive rates or 0,0, got {value!r}"
            )
    if not -1 <= preset.tau_alpha <= 1:
        raise ValueError(
            f"field 'tau_alpha': expected an opacity threshold from -1 to 1, got {preset.tau_alpha!r}"
        )
    if not preset.grid_3d + preset.grid_2d:
        raise ValueError(
            "field 'grid_3d': expected a level here or in grid_2d, the context has nothing else to read"
        )
    if preset.grow not in ("scaffold", "reseed", "off"):
        raise ValueError(f"field 'grow': expected scaffold, reseed or off, got {preset.grow!r}")
    return preset
