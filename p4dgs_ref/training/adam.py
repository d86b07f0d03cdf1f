"""Adam over one flat vector, and the learning-rate schedule of 3DGS and its successors."""

from math import sqrt

import numpy as np

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15  # as in all methods that P-4DGS builds on


class Adam:
    """Adam (Kingma and Ba 2015); each array counts its steps from the first one it takes part in.

    `first` and `second` hold the moments as Parameters with the layout of the optimised parameters,
    so that rows can be added and removed together.
    """

    def __init__(self, parameters):
        self.first, self.second = parameters.zeros(), parameters.zeros()
        self.steps = dict.fromkeys(parameters.arrays, 0)

    def step(self, parameters, gradients, rate_of):
        """Move `parameters` in place.

        `rate_of(name)` is the learning rate of an array, 0 for one that does not take part. A
        gradient whose square would overflow (above 9e18 in float32, 6e153 in float64) counts as the
        largest whose square does not.
        """
        rates = {name: rate_of(name) for name in self.steps}
        for name, rate in rates.items():
            self.steps[name] += rate > 0

        def corrected(name):
            # Both moments start at zero; dividing by the sum of their weights corrects for that.
            n = self.steps[name]
            return rates[name] * sqrt(1 - BETA_2**n) / (1 - BETA_1**n) if n else 0.0

        m, v = self.first.vector, self.second.vector
        # Beyond this the square of a gradient would overflow, and v would become inf - inf.
        largest = np.sqrt(np.finfo(v.dtype).max) / 2
        g = np.clip(gradients.vector, -largest, largest)
        m += (1 - BETA_1) * (g - m)
        v += (1 - BETA_2) * (g * g - v)
        change = np.sqrt(v)
        change += EPSILON
        np.divide(m, change, out=change)
        change *= parameters.per_element(corrected)
        parameters.vector -= change


def exponential(step, first, last, until, start=0):
    """The learning rate at `step`: geometric between `first` at `start` and `last` at `until`.

    This is the schedule of Kerbl et al. 2023 without its warm-up, which no successor uses.
    """
    if first == last or first == 0:
        return first
    share = min(max((step - start) / max(until - start, 1), 0.0), 1.0)
    return float(np.exp((1 - share) * np.log(first) + share * np.log(last)))
