"""PSNR: the peak signal-to-noise ratio of two images, by which the paper's tables compare methods.

PSNR = -10 log10(mean (image - truth)**2)        in dB, for intensities from 0 to 1
"""

import numpy as np


def psnr(image, truth):
    """Return the PSNR of an image, which is clipped to [0, 1] first; infinite if they are equal."""
    error = np.mean((np.clip(image, 0, 1).astype(float) - truth) ** 2)
    return float(-10 * np.log10(error)) if error else np.inf
