"""Short trainings, and single steps of them: `tiny` with shorter stages."""

from ...training.presets import TINY, choose
from ...training.trainer import Trainer


def reduced(iterations, **changes):
    """`tiny` for that many iterations: everything counted in iterations shrinks alike."""
    share = iterations / TINY.iterations
    ends = tuple(round(share * end) for end in TINY.stage_ends[:3])
    shorter = dict(
        stage_ends=(*ends, iterations),
        decay_from=round(share * TINY.decay_from),
        mask_from=ends[2],
        grow_from=round(share * TINY.grow_from),
        grow_every=max(20, round(share * TINY.grow_every)),
        grow_until=round(share * TINY.grow_until),
    )
    return choose(TINY, {**shorter, **changes})


def step_at(scene, preset, stage, **options):
    """A function that does the first step of a stage again and again; `options` of the Trainer."""
    # The anchors stay as they are.
    trainer = Trainer(scene, preset._replace(grow_every=10**9), **options)

    def step():
        trainer.iteration = (0, *preset.stage_ends)[stage - 1]
        trainer.step()

    return step
