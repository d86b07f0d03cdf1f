"""The program that made `tables.json`: `python -m tests.workshop.make_tables` prints it again.

The file is part of the format: a decoder reads the tables and never computes them. The entry
nearest to a rounding tie is 4.8e-6 away from it (measured), so a normal distribution function that
is right to 13 digits gives the same integers.
"""

import json

import numpy as np
from scipy.special import expit, ndtr

PHI_REACH, PHI_STEPS, PRECISION, EXP2_STEPS, EXP2_BITS = 6, 64, 24, 16, 16


def make_tables():
    """The four tables as lists of integers.

    phi      round(2^24 Phi(z)) at z = -6, -6 + 1/64, ... 6: 769 entries
    exp2     round(2^16 2^(-i/16)) for i = 0, 1, ... 15
    sigmoid  round(2^24 sigmoid(2 u)) at u = -4, -4 + 1/64, ... 6: 641 entries
    log2     round(2^16 log2(1 + i/256)) for i = 0, 1, ... 256
    """
    u = np.arange(-4 * 64, 6 * 64 + 1) / 64
    z = np.arange(-PHI_REACH * PHI_STEPS, PHI_REACH * PHI_STEPS + 1) / PHI_STEPS
    tables = {
        "phi": 2.0**PRECISION * ndtr(z),
        "exp2": 2.0 ** (EXP2_BITS - np.arange(EXP2_STEPS) / EXP2_STEPS),
        "sigmoid": 2.0**24 * expit(2 * u),
        "log2": 2.0**16 * np.log2(1 + np.arange(257) / 256),
    }
    return {name: np.rint(values).astype(int).tolist() for name, values in tables.items()}


if __name__ == "__main__":
    print(json.dumps(make_tables()))
