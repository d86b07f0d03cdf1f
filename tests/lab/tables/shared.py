"""What the tests of tables share."""

import csv

from p4dgs_ref.lab import baselines

# The large network takes as long as all others together.
OTHERS = [name for name in baselines.METHODS if name != "d3dgs"]


CURVE = {"names": ["d3dgs_small"], "seeds": 2, "iterations": 4}
FIRST = ["method", "scene", "seed", "psnr_db", "bytes"]


def table(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
