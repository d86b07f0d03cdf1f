"""What the tests of tables share."""

import csv

from p4dgs_ref.lab import baselines
from p4dgs_ref.lab.tables import curve
from p4dgs_ref.lab.tables.methods import ALIKE, CODED, HALF, OURS

# The large network takes as long as all others together.
OTHERS = [name for name in baselines.METHODS if name != "d3dgs"]


# Sizes and storages of a small curve.
FEW = {
    **{name: curve.SIZES[name][:2] for name in (OURS, CODED)},
    "d3dgs_small": ({"gaussians": 20, "sh_degree": 0}, {"gaussians": 30, "sh_degree": 1}),
}
STORAGES = {
    OURS: [(ALIKE, 0.002)],
    "d3dgs_small": [(ALIKE, 0.001), (ALIKE, 0.01), (HALF, None)],
}
CURVE = {"names": ["d3dgs_small"], "seeds": 2, "iterations": 4}
FIRST = ["method", "scene", "seed", "psnr_db", "bytes"]


def table(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
