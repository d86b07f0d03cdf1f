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
from scipy.special import expit, logit

from ..model import Gaussians
from ..scenes.files import reading
from ..scenes.output import write_atomically
from ..scenes.ply import LONGEST, read_vertices
from ..scenes.scene import require

C_0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the spherical harmonic of degree 0
CLOSEST = 2.0**-24  # of alpha to 0 and 1
THINNEST = 1e-10  # scene units
# The properties of every attribute of Gaussians, in the order of the file.
GROUPS = {
    "x": ("x", "y", "z"),
    "normal": ("nx", "ny", "nz"),
    "color": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "alpha": ("opacity",),
    "s": ("scale_0", "scale_1", "scale_2"),
    "r": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
PROPERTIES = [name for names in GROUPS.values() for name in names]


def write_gaussians(path: str | Path, gaussians: Gaussians, comments: Iterable[str] = ()) -> None:
    """Write Gaussians as 3DGS does; `comments` go to the header.

    Raises SceneError where a number is NaN or infinite as float32.
    """
    x, s, r, alpha, color, _ = (np.asarray(a, float) for a in gaussians)
    columns = {
        "x": x,
        "normal": np.zeros_like(x),
        "color": (color - 0.5) / C_0,
        "alpha": logit(np.clip(alpha, CLOSEST, 1 - CLOSEST))[:, None],
        "s": np.log(np.maximum(np.abs(s), THINNEST)),
        "r": r,
    }
    with np.errstate(over="ignore"):  # infinities are found below
        rows = np.concatenate([columns[name] for name in GROUPS], axis=1).astype("<f4")
    bad = np.count_nonzero(~np.isfinite(rows).all(axis=1))
    require(not bad, path, f"{bad} Gaussians are NaN or infinite; expected finite numbers")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *map(comment, comments),
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in PROPERTIES),
        "end_header\n",
    ]
    text = "\n".join(header).encode("ascii")
    write_atomically(path, lambda file: file.write(text + rows.tobytes()))


def comment(text):
    """A line of a header with as much of a text as fits, in printable ASCII."""
    words = " ".join(["comment", *text.split()])[: LONGEST // 2]
    return "".join(c if " " <= c <= "~" else "?" for c in words)


def read_gaussians(path: str | Path) -> Gaussians:
    """The Gaussians of a PLY file of 3DGS, as float64; their spherical harmonics have degree 0."""
    path = Path(path)
    with reading(path, "Gaussians as 3DGS stores them"):
        vertices = read_vertices(path, PROPERTIES)
    degree = any(name.startswith("f_rest") for name in vertices)
    require(not degree, path, "has f_rest_0 or more; expected spherical harmonics of degree 0")
    x, _, f_dc, opacity, log_s, r = (
        np.stack([vertices[name] for name in names], axis=1).astype(float)
        for names in GROUPS.values()
    )
    return Gaussians(x, np.exp(log_s), r, expit(opacity[:, 0]), 0.5 + C_0 * f_dc, np.arange(len(x)))
