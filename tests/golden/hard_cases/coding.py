"""Hard cases of the codec that `tests/codec` does not have: positions, float16, long messages.

The codec codes symbols, the integers that Eq. (10) makes of attributes. The precision of a case is
therefore that of the attributes. Errors are counts, or sizes of the decoded numbers.
"""

from dataclasses import replace

import numpy as np

from p4dgs_ref.codec.file import encode
from p4dgs_ref.codec.gaussian_table import (
    MU_BITS,
    SIGMA_BITS,
    SIGMA_MIN,
)
from p4dgs_ref.codec.quantise import EncodeError, quantise
from p4dgs_ref.codec.streams import decode_gaussian, encode_gaussian, ideal_bits_gaussian
from p4dgs_ref.equations import rounding
from p4dgs_ref.model import LATTICE, snap
from tests.golden.sample_model import sample_model

from .procedures import exact, refuses


def positions(dtype):
    """Positions come back within half a step, points of the lattice exactly."""
    worst, literal = 0.0, 0.0
    cloud = np.random.default_rng(3).uniform(-1, 1, size=(40, 3))
    flat, one, same = cloud * [1, 0, 1] + [0, 0.3, 0], cloud[:1], np.repeat(cloud[:1], 9, axis=0)
    for x_a in (flat, one, same, cloud * 1e-20, cloud * 1e8):
        x_a = x_a.astype(dtype)
        lo, hi = x_a.min(axis=0).astype(np.float32), x_a.max(axis=0).astype(np.float32)
        inside = np.clip(x_a.astype(float), lo, hi)
        symbols, back = snap(inside, lo, hi)
        half = (hi.astype(float) - lo) / LATTICE / 2
        allowed = half * (1 + 1e-9) + 4e-16 * np.abs(inside)
        beyond = (np.abs(back - inside) - allowed).max()
        worst = max(worst, float(beyond), float(np.abs(snap(back, lo, hi)[0] - symbols).max()))
        with np.errstate(all="ignore"):
            literal = np.nan if np.isnan((x_a - lo) / (hi - lo)).any() else literal
    return exact(str(literal), worst, 0.0, worst)


def half_weights(dtype):
    """Weights are stored as float16: too large ones are refused, underflows are counted."""
    model, refused, lost = sample_model(5, 24), 0, 0
    name = next(iter(model.networks))
    for value in (7e4, np.nan, np.inf, 1e-8):
        weights, biases = model.networks[name]
        weights = [np.array(W, dtype) for W in weights]
        weights[0][0, 0] = value
        changed = replace(model, networks={**model.networks, name: (weights, biases)})
        if refuses(lambda: encode(changed), EncodeError, name):
            refused += 1
        else:
            lost += quantise(changed).model.networks[name][0][0][0, 0] == 0
    error = abs(3 - refused) + abs(1 - lost)
    # Literal is 7e4 as float16.
    return exact("inf", f"{refused} refused, {lost} lost", "3 refused, 1 lost", error)


# --- the entropy coder ---------------------------------------------------------------------------


def long_messages(dtype):
    """A million symbols take at most 0.1 % and 8 bytes more than their entropy."""
    wrong, n, sizes = 0, 10**6, []
    for values, mu, sigma in (
        (np.full(n, 3.5), 7 << MU_BITS, SIGMA_MIN),
        (0.5 * (np.arange(n) % 2), 512, SIGMA_MIN),
        (np.full(n, -0.5), 5 << MU_BITS, 2 << SIGMA_BITS),
    ):
        (symbols, _), _ = rounding.forward(values[None].astype(dtype), np.full((1, 1), 0.5, dtype))
        coded = symbols[0], np.full(n, mu), np.full(n, sigma)
        data, bits = encode_gaussian(*coded), ideal_bits_gaussian(*coded).sum()
        sizes.append((float(len(data)), float(bits / 8)))
        wrong += np.count_nonzero(decode_gaussian(data, *coded[1:]) != symbols)
        wrong += len(data) > 1.001 * bits / 8 + 8
    return exact(n / 8, *sizes[0], wrong)


CODING = {
    "H-Q5.positions": positions,
    "H-Q6.float16": half_weights,
    "H-E5.long": long_messages,
}
