"""Stored numbers of a Gaussian, and the bits of each: in the paper's T-Rex and on the tiny scenes.

The paper prints bytes, not numbers of Gaussians. These follow from its Tables 3 and 4, if a number
of D3DGS and of its network is a float32, if D3DGS has harmonics of degree 3 and three normals (62
numbers a Gaussian), and if an anchor has 16 features, 10 children and 16 bits a coordinate.
"""

import numpy as np

from ..tables.methods import PAPERS
from .curve import chosen, markdown

MB = 1e6
D3DGS, PREDICTED = 56.7 * MB, 7.27 * MB  # Table 3
POSITIONS, ATTRIBUTES = 0.118 * MB, (0.191 + 0.099 + 0.188) * MB  # Table 4, high rate
NETWORK = 4 * 522_280  # bytes of D3DGS's network for synthetic scenes
EXPLICIT = 62  # numbers of a Gaussian: 59, and three normals that are zero
ANCHOR, CHILDREN = 3 + 16 + 3 + 3 + 3 * 10, 10  # numbers of an anchor
ANCHOR_HERE, CHILDREN_HERE = 3 + 16 + 3 + 3 + 3 * 4, 4
COLUMNS = {
    "": "{what}",
    "Gaussians": "{gaussians:,.0f}",
    "numbers of each": "{numbers:.1f}",
    "bits of a number": "{bits:.1f}",
    "bytes of each": "{each:.1f}",
}


def row(what, gaussians, numbers, total):
    """A row of the table; `total` are the bytes of all Gaussians or anchors."""
    each = total / gaussians
    return dict(what=what, gaussians=gaussians, numbers=numbers, bits=8 * each / numbers, each=each)


def inferred():
    """The rows of T-Rex."""
    explicit = (D3DGS - NETWORK) / (4 * EXPLICIT)
    predicted = (PREDICTED - NETWORK) / (4 * ANCHOR) * CHILDREN
    coded = POSITIONS / 6 * CHILDREN
    return [
        row("T-Rex, D3DGS", explicit, EXPLICIT, D3DGS - NETWORK),
        row("T-Rex, anchors", predicted, ANCHOR / CHILDREN, PREDICTED - NETWORK),
        row("T-Rex, anchors coded", coded, ANCHOR / CHILDREN, POSITIONS + ATTRIBUTES),
    ]


def measured(rows):
    """The rows of the tiny scenes, means over them and their seeds."""
    found = []
    for degree, numbers in ((3, 59), (0, 14)):
        label = f"d3dgs_small gaussians=800 sh_degree={degree}"
        found += [mean(rows, label, numbers + 3), mean(rows, f"{label} loss=0.0005", numbers)]
    return [*found, mean(rows, PAPERS, ANCHOR_HERE / CHILDREN_HERE)]


def mean(rows, label, numbers):
    """The row of a label; the children of an anchor count whether they are kept or not."""
    own = chosen(rows, label=label)
    children = CHILDREN_HERE * np.mean([one["anchors"] for one in own])
    gaussians = children if label == PAPERS else np.mean([one["gaussians"] for one in own])
    return row(
        f"here, {label}", gaussians, numbers, np.mean([one["gaussians_bytes"] for one in own])
    )


def tell(rows):
    """Print the table."""
    print("\nstored numbers of a Gaussian without networks")
    print(markdown(COLUMNS, inferred() + measured(rows)))
