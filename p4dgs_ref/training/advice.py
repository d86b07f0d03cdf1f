"""Warnings about a training that cannot learn its scene or did not, one line each."""

import warnings

import numpy as np

from .progress import psnr

FEW_VIEWS = 24  # on `bouncing`, 24 views lose 1.2 dB against 48, 16 far more (reference.md, Limits)
LEAST_GAIN = 1.0  # dB above the best picture of one colour


def warn_of_few_views(scene):
    """Warn where a scene has too few training views to show how it looks from elsewhere."""
    count = len(scene.train)
    if count < FEW_VIEWS:
        warnings.warn(
            f"scene {scene.name}: {count} training views; views that were not trained on will be "
            f"poor with fewer than {FEW_VIEWS}; 48 are enough for the packaged scenes",
            stacklevel=4,
        )


def warn_of_failure(trainer):
    """Warn where the pictures of a trained model are hardly better than one colour.

    Both are compared with all training views. The mean of their colours has the smallest squared
    error of all colours.
    """
    model, views = trainer.model(), trainer.scene.train
    color = np.mean([view.image.mean(axis=(0, 1)) for view in views], axis=0)
    flat = np.mean([psnr(np.broadcast_to(color, v.image.shape), v.image) for v in views])
    learnt = np.mean(
        [psnr(model.render(v.camera, v.time, trainer.settings), v.image) for v in views]
    )
    if learnt < flat + LEAST_GAIN < np.inf:  # infinite where the scene itself has one colour
        warnings.warn(
            f"scene {trainer.scene.name}: the result has {learnt:.2f} dB on the training views, a "
            f"picture of one colour {flat:.2f} dB; try sparse_share=1, more iterations "
            "(stage_ends), another seed, or pictures in which the object is larger",
            stacklevel=4,
        )
