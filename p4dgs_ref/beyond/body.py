"""B3, ours: until the middle of stage 3, pixels of what moves count more in L1 than others.

L1 leads every pixel to its median over time. Where a thin body moves, this is what stands behind
it: opacities fall, or psi_c saturates, and the body is lost for good. The body therefore counts as
much as the whole picture until it has learned to move. In stages 1 and 2 it is what disagrees with
the picture's median colour. Stage 3 keeps of it what the model, which is still at rest, draws
wrong. A weight until the end of stage 3 cost 0.4 dB where bodies are not thin.
"""

import numpy as np

from ..training.fit import disagreements

MIN_SHARE = 0.01  # of all pixels; a smaller body counts no more than one of this size


def body(image):
    """The pixels [H, W] of an image [H, W, 3] that disagree with its median colour."""
    return disagreements(image, np.median(image, axis=(0, 1)))
