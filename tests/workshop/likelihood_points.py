"""True values of Eq. (11) for the study of its formulas.

    python -m tests.workshop.likelihood_points

Some points are drawn from the plane of the stability map. Their bits and slopes are computed with
60 digits, rounded to float64 and stored beside the formulas.
"""

import json

import numpy as np

from p4dgs_ref.lab.accuracy.formulas import DIGITS
from p4dgs_ref.lab.stability import plane

from .sixty_digits import gradient, value

COUNT = 30


def rows(count):
    """[z, w, bits, slope in f_noisy, slope in q] of `count` points, for mu = 0 and sigma = 1."""
    z, w = (a.ravel() for a in np.meshgrid(*plane(), indexing="ij"))
    indices = np.random.default_rng(0).choice(len(z), count, replace=False)
    one = np.ones((1, 1))
    points = []
    for i in indices:
        inputs = dict(f_noisy=z[i] * one, mu=0 * one, sigma=one, q=w[i] * one)
        slopes = gradient("likelihood", inputs, {"bits_bar": one})
        exact = (value("likelihood", inputs)["bits"], slopes["f_noisy"], slopes["q"])
        points.append([float(z[i]), float(w[i]), *(float(a[0, 0]) for a in exact)])
    return points


if __name__ == "__main__":
    DIGITS.write_text(json.dumps(rows(COUNT), indent=1) + "\n", encoding="utf-8")
