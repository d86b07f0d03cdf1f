"""Eq. (17): the rate of the whole scene, in bits and in bits per coded value.

    bits   = R_anchor + R_hash
    L_rate = bits / n_parameters

P-4DGS, section 3.3 (training objective). The paper's L_rate is `bits`; like HAC, training divides
it by the number of values, so that lambda_rate means the same in small and large scenes (Q12).
"""

from .numerics import in_precision_of


def forward(
    R_anchor,  # []  bits of the anchors, Eq. (13)
    R_hash,  # []  bits of the hash grid, Eq. (14)
    n_parameters,  # []  A * (d + 6 + 3k): all anchors, masked offsets included
):
    """Return bits and L_rate [] and what `backward` needs; L_rate is 0 without parameters."""
    bits = R_anchor + R_hash
    count = in_precision_of(bits, n_parameters)
    L_rate = bits / count if count else count * bits
    return (bits, L_rate), (n_parameters,)


def backward(saved, bits_bar=0.0, L_rate_bar=0.0):
    """Return the gradients of R_anchor and R_hash; n_parameters is data."""
    (n_parameters,) = saved
    count = in_precision_of(L_rate_bar, n_parameters)
    bar = bits_bar + L_rate_bar / count if count else bits_bar
    return {"R_anchor": bar, "R_hash": bar}
