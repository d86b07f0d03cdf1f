"""The presets that go beyond the paper: `tiny_coded` and `small_coded`."""

from dataclasses import dataclass, fields, replace

from ..training import presets as paper
from ..training.initial import design_of as paper_design_of
from ..training.presets import (
    FLAG,
    NOT_NEGATIVE,
    RATE,
    TINY,
    between,
    differences,
    row,
    rows_of,
)
from .model import Design

OFF = "off, as the paper"


@dataclass(frozen=True)
class Preset(paper.Preset):
    """The paper's table of fields, and below it what is ours."""

    is_coded: bool = row(False, True, FLAG, OFF, "networks that pay for their bits (B1)")
    position_bits: int = row(
        16, 10, between(1, 16), "paper", "positions of few bits per axis, sorted (B2)"
    )
    network_ramp: int = row(0, 1000, NOT_NEGATIVE, OFF, "iterations until coded networks pay fully")
    lr_step: tuple = row(
        (0.0, 0.0), (0.02, 0.002), RATE, OFF, "logarithms of coded networks' steps"
    )
    body: bool = row(False, True, FLAG, OFF, "more weight in L1 for what moves (B3)")


OURS = {
    name: column for name, column in rows_of(Preset).items() if name not in rows_of(paper.Preset)
}

# Its networks pay for their bits (B1), its positions have fewer of them (B2), and what moves counts
# more until it has learned to move (B3).
TINY_CODED = Preset(
    **{**vars(TINY), "name": "tiny_coded"},
    **{name: row.metadata["tiny"] for name, row in OURS.items()},
)
# For quality, in at most three times the time. Anchors of four children fitted the training views
# of `figure` nearly as well as those of one, but new views showed a hole in a leg. A single child
# needs only shallow networks and, because it has an offset of its own, few bits of a position.
SMALL_CODED = replace(
    TINY_CODED,
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
PRESETS = {preset.name: preset for preset in (TINY_CODED, SMALL_CODED)}


def choose(preset, changes, presets):
    """Like the paper's `choose`; the result is the paper's Preset where nothing of it is ours."""
    preset = presets.get(preset, preset) if isinstance(preset, str) else preset
    if isinstance(preset, paper.Preset) and not isinstance(preset, Preset):
        if OURS.keys() & (changes or {}).keys():
            preset = Preset(**vars(preset))
    changed = paper.choose(preset, changes, presets)
    if not isinstance(changed, Preset):
        return changed
    if changed.position_bits != 16 and not changed.is_coded:
        raise ValueError("field 'position_bits': expected 16 where the field is_coded is false")
    return changed if changed.is_coded or changed.body else paper_preset(changed)


def paper_preset(preset):
    """The same preset without what goes beyond the paper (B1 to B3), under the same name."""
    return paper.Preset(**{row.name: getattr(preset, row.name) for row in fields(paper.Preset)})


def what_is_ours(preset):
    """What goes beyond the paper in a preset, a sentence each."""
    names = [name for name, _, _ in differences(preset) if name in OURS]
    meanings = [OURS[name].metadata["meaning"] for name in names]
    return [meaning for meaning in meanings if "(B" in meaning]


def design_of(preset, effects):
    """The Design that a preset and the effects of a scene ask for."""
    design = paper_design_of(preset, effects)
    if not preset.is_coded:
        return design
    return Design(**vars(design), position_bits=preset.position_bits)
