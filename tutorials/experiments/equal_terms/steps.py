"""From the file of D3DGS to that of the paper's design in four steps, every file at one PSNR.

The bytes at a PSNR are those of a method's curve, interpolated between its best points. They are
taken over the whole range of PSNRs that all five curves of a scene reach, so that a step is a band
and not a point.
"""

import numpy as np

from ..tables.methods import PAPERS
from ..tables.writer import bytes_at
from .curve import ALIKE, HALF, SCENES, STORED, chosen, curve_of, markdown

STEPS = {  # the method and the storage of each file
    "D3DGS, its authors' network, float32": ("d3dgs", STORED),
    "a network of two layers": ("d3dgs_small", STORED),
    "float16": ("d3dgs_small", HALF),
    "quantised and coded after training": ("d3dgs_small", ALIKE),
    "the paper's design, coded alike": (PAPERS, ALIKE),
}
LEVELS = 25  # PSNRs of a band
COLUMNS = {
    "scene": "{scene}, {low:.2f} to {high:.2f} dB",
    "file": "{step}",
    "bytes": "{least:,.0f} to {most:,.0f}",
    "times smaller": "{worst:.2f} to {best:.2f}",
}


def bands(rows):
    """The bytes of every file over the common range of PSNR of its scene, and what a step saves."""
    found = []
    for scene in SCENES:
        own = chosen(rows, scene=scene)
        curves = {
            step: curve_of(chosen(own, method=method, storage=storage))
            for step, (method, storage) in STEPS.items()
        }
        reached = [[psnr for _, psnr in curve] for curve in curves.values()]
        low, high = max(map(min, reached)), min(map(max, reached))
        before = None
        for step, curve in curves.items() if low <= high else ():
            sizes = np.array([bytes_at(curve, psnr) for psnr in np.linspace(low, high, LEVELS)])
            row = {"scene": scene, "step": step, "low": low, "high": high}
            row |= {"least": sizes.min(), "most": sizes.max()}
            if before is not None:
                row |= {"worst": (before / sizes).min(), "best": (before / sizes).max()}
            found.append(row)
            before = sizes
    return found


def tell(rows):
    """Print the steps."""
    print("\nfrom D3DGS's file to the paper's design, over the PSNRs that all five files reach")
    print(markdown(COLUMNS, bands(rows)))
