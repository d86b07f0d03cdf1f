"""Eq. (13): the bits of all anchors.

    R_anchor = sum over anchors of bits(f_a) + bits(s_a) + bits(l_a) + bits(O_a)

P-4DGS, section 3.3 (context entropy coding); the terms are those of Eq. (11). The anchors'
positions are not part of this sum, although the file contains them (Q14).
"""

import numpy as np


def forward(
    bits_f,  # [A, d]  bits of the feature
    bits_s,  # [A, 3]  bits of the scale
    bits_l,  # [A, 3]  bits of the offset scaling l_a
    bits_O,  # [A, k, 3]  bits of the offsets
    mask,  # [A, k]  bool: children whose offsets are coded; the others cost nothing (Q15)
):
    """Return R_anchor [] in bits and what `backward` needs.

    Masked offsets are left out even if their bits are infinite.
    """
    kept = np.where(mask[:, :, None], bits_O, 0)
    # Summed in float64: 1e8 float32 terms would lose the last ones.
    total = sum(bits.sum(dtype=np.float64) for bits in (bits_f, bits_s, bits_l, kept))
    return np.asarray(total, bits_f.dtype), (mask, bits_f.shape[1], bits_f.dtype)


def backward(saved, R_anchor_bar):
    """Return the gradients of bits_f, bits_s, bits_l and bits_O; zero for masked offsets."""
    mask, d, dtype = saved
    A, k = mask.shape
    bits_O_bar = np.full((A, k, 3), R_anchor_bar, dtype)
    bits_O_bar[~mask] = 0
    return {
        "bits_f": np.full((A, d), R_anchor_bar, dtype),
        "bits_s": np.full((A, 3), R_anchor_bar, dtype),
        "bits_l": np.full((A, 3), R_anchor_bar, dtype),
        "bits_O": bits_O_bar,
    }
