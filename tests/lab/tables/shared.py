"""What the tests of tables share."""

import csv

from p4dgs_ref.lab import baselines

# The large network takes as long as all others together.
OTHERS = [name for name in baselines.METHODS if name != "d3dgs"]


SWEEP = {
    "lambdas": (0.0, 300.0),
    "seeds": 2,
    "iterations": 12,
    "names": ["d3dgs_small", "p4dgs_coded"],
}


def table(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
