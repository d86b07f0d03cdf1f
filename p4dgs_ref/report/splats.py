"""Gaussians of one time and view as a PLY file of 3DGS, which splat viewers open.

The file is binary, little endian, with one vertex of float32 for each Gaussian:

    x y z              centre
    nx ny nz           0; nobody reads them, but every file of 3DGS has them
    f_dc_0 .. f_dc_2   (color - 1/2) / C_0, the spherical harmonics of degree 0
    opacity            log(alpha / (1 - alpha))
    scale_0 .. scale_2 log |s|, because only s^2 is rendered and s_t can be negative (Eq. 6)
    rot_0 .. rot_3     unit quaternion w, x, y, z

The logarithms stay finite: an alpha of 0 or 1 is moved by CLOSEST, a smaller |s| becomes THINNEST.
Neither is visible, since renderers clamp alpha at 0.99 and widen every splat by part of a pixel.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.special import logit

from ..model import Gaussians
from ..output import write_atomically
from ..scenes.fields import require

C_0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the spherical harmonic of degree 0
CLOSEST = 2.0**-24  # of alpha to 0 and 1
THINNEST = 1e-10  # scene units
PROPERTIES = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
).split()


def write_gaussians(path: str | Path, gaussians: Gaussians, comments: Iterable[str] = ()) -> None:
    """Write Gaussians as 3DGS does; `comments` go to the header, in ASCII.

    Raises SceneError where a number is NaN or beyond float32.
    """
    x, s, r, alpha, color, _ = (np.asarray(a, float) for a in gaussians)
    columns = [
        x,
        np.zeros_like(x),
        (color - 0.5) / C_0,
        logit(np.clip(alpha, CLOSEST, 1 - CLOSEST))[:, None],
        np.log(np.maximum(np.abs(s), THINNEST)),
        r,
    ]
    with np.errstate(over="ignore"):  # infinities are found below
        rows = np.concatenate(columns, axis=1).astype("<f4")
    bad = np.count_nonzero(~np.isfinite(rows).all(axis=1))
    require(not bad, path, f"{bad} Gaussians are NaN or beyond float32; expected finite numbers")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {ascii(text)[1:-1]}" for text in comments),
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in PROPERTIES),
        "end_header\n",
    ]
    header = "\n".join(lines).encode("ascii")
    write_atomically(Path(path), lambda file: file.write(header + rows.tobytes()))
