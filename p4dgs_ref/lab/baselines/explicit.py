"""What the models of the baselines share: explicit Gaussians, their first values, their file.

A file is one PLY: Gaussians as its vertices, every network in a second element.

    ply
    format binary_little_endian 1.0
    comment {"method": "d3dgs", ...}     what a reader must know besides the numbers, as JSON
    element vertex N                     a row for each Gaussian, the properties of 3DGS's PLY
    property float x
    ...
    element network M                    all weights one after another; the comment has their shapes
    property float value
    end_header

All numbers are float32, as in the files of the authors; D3DGS keeps its network in a file of its
own. The text is the overhead, about 2 KB.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from ...equations import view
from ...model import pull
from ...scenes.fields import require
from ...scenes.files import read_ply, reading, write_ply
from ...splatting import render
from ...splatting.settings import FAST
from ...training.initial import neighbour_distance, starting_points
from ...training.parameters import Parameters
from . import sh_color

START_ALPHA = 0.1  # the opacity of every Gaussian before training, as in 3DGS
# The arrays of a Gaussian in the order of 3DGS's PLY, with the names of their properties.
PLY_OF_3DGS = {
    "x": "x y z",
    "normals": "nx ny nz",  # unused: zeros
    "sh_dc": "f_dc_*",
    "sh_rest": "f_rest_*",
    "logit_alpha": "opacity",
    "log_s": "scale_*",
    "raw_r": "rot_*",
}


@dataclass(frozen=True)
class Preset:
    """The constants that the baselines share, with the values of 3DGS's code.

    Rates are first and last, geometric over all iterations.
    """

    name: str = "paper_synthetic"
    iterations: int = 30_000
    gaussians: int = 10_000  # at random points at the start
    extent: float = 1.3  # they are uniform in [-extent, extent]^3
    sh_degree: int = 3
    sh_every: int = 1000  # iterations from one active degree of the harmonics to the next
    lambda_ssim: float = 0.2
    lr_x: tuple[float, ...] = (1.6e-4, 1.6e-6)
    lr_sh_dc: tuple[float, ...] = (0.0025, 0.0025)
    lr_sh_rest: tuple[float, ...] = (0.000125, 0.000125)
    lr_alpha: tuple[float, ...] = (0.05, 0.05)
    lr_s: tuple[float, ...] = (0.005, 0.005)
    lr_r: tuple[float, ...] = (0.001, 0.001)
    collect_from: int = 0
    grow_from: int = 500
    grow_every: int = 100
    grow_until: int = 15_000
    gradient_threshold: float = 2e-4  # of the projected centre, in NDC units per view
    percent_dense: float = 0.01  # of the extent: smaller Gaussians are cloned, larger ones split
    min_opacity: float = 0.005
    reset_every: int = 3000
    most: int = 10**9  # Gaussians; density control adds none beyond


# What the presets for the tiny scenes change alike.
TINY = {
    "name": "tiny",
    "iterations": 3800,
    "gaussians": 800,
    "most": 800,  # as many as our preset `tiny` has: 200 anchors of 4 children
    "extent": 1.0,
    "sh_every": 500,
    "lr_sh_dc": (0.01, 0.001),
    "lr_sh_rest": (0.0005, 5e-5),
    "lr_alpha": (0.05, 0.005),
    "lr_s": (0.01, 0.001),
    "lr_r": (0.005, 5e-4),
    "grow_from": 300,
    "grow_until": 2000,
    "gradient_threshold": 5e-4,
    "percent_dense": 0.02,
}


@dataclass(frozen=True, eq=False)
class Explicit:
    """A model of explicit Gaussians. Each baseline is a subclass, which also has

    initial(preset, rng, points)     the first arrays by name (a static method)
    predict(t, x_c, iteration=None)  the Gaussians at time t as the camera at x_c sees them, and
                                     back(x_bar, s_bar, r_bar, alpha_bar, color_bar), which returns
                                     the gradients of arrays {name: gradient} and of networks
                                     {name: {"weights": ..., "biases": ...}}; without an iteration
                                     of training, the Gaussians are those of the finished model
    """

    parameters: Parameters
    preset: Preset
    background: np.ndarray  # [3]
    occlusion: bool = True

    METHOD: ClassVar[str]
    FORM: ClassVar[tuple]  # the fields of a preset that a file tells its reader
    PROPERTIES: ClassVar[dict] = PLY_OF_3DGS

    @property
    def rows(self):
        """The names of the arrays that have one row for each Gaussian."""
        return [name for name in self.PROPERTIES if name in self.parameters.arrays]

    @property
    def primitives(self):
        """The number of stored Gaussians."""
        return len(self.parameters["x"])

    def gaussians(self, t, camera):
        """The Gaussians at time t in [0, 1] for this camera."""
        return self.predict(t, camera.center)[0]

    def render(self, camera, t, settings=FAST):
        """The image [H, W, 3] at time t in [0, 1]. Clip it to [0, 1] before saving it."""
        (image, *_), _ = self.draw(self.gaussians(t, camera), camera, settings, keep=False)
        return image

    def draw(self, g, camera, settings, keep=True):
        """What `splatting.render.forward` returns for some Gaussians, and its backward."""
        looks = camera, self.background, settings, self.occlusion, keep
        return pull(render, g.x, g.s, g.r, g.alpha, g.color, *looks)

    def regularise(self, gradients, iteration):
        """Return the further terms of the loss and add their gradients; here there are none."""
        return 0.0

    def save(self, path):
        """Write the file; returns its bytes as {"gaussians": ..., "network": ..., "other": ...}."""
        arrays, N = dict(self.parameters.arrays), self.primitives
        if "normals" in self.PROPERTIES:
            arrays["normals"] = np.zeros((N, 3))
        rows = {name: arrays.pop(name) for name in self.PROPERTIES}
        columns = {name: array.reshape(N, array[:1].size) for name, array in rows.items()}
        properties = [
            text.replace("*", str(i)) if "*" in text else text.split()[i]
            for name, text in self.PROPERTIES.items()
            for i in range(columns[name].shape[1])
        ]
        numbers = np.concatenate([np.zeros(0), *(array.ravel() for array in arrays.values())])
        elements = {
            "vertex": (properties, np.concatenate([*columns.values()], axis=1)),
            "network": (["value"], numbers[:, None]),
        }
        values = {
            "method": self.METHOD,
            "form": {field: getattr(self.preset, field) for field in self.FORM},
            "background": [float(c) for c in self.background],
            "occlusion": self.occlusion,
            "rows": {name: array.shape[1:] for name, array in rows.items()},
            "shapes": {name: array.shape for name, array in arrays.items()},
        }
        other, gaussians, network = write_ply(path, elements, [json.dumps(values)])
        return {"gaussians": gaussians, "network": network, "other": other}


def start(preset, rng, points=None):
    """The first Gaussians of 3DGS, on random or given points: grey, faint, as wide as the gaps."""
    x = starting_points(points, preset.gaussians, preset.extent, rng)
    N, K = len(x), (preset.sh_degree + 1) ** 2
    return {
        "x": x,
        "sh_dc": rng.random((N, 3, 1)) / 255,
        "sh_rest": np.zeros((N, 3, K - 1)),
        "logit_alpha": np.full(N, np.log(START_ALPHA / (1 - START_ALPHA))),
        "log_s": np.repeat(np.log(neighbour_distance(x))[:, None], 3, axis=1),
        "raw_r": np.tile([1.0, 0, 0, 0], (N, 1)),
    }


def colors(p, x, x_c, degree):
    """D2 for Gaussians at x [N, 3] as the camera at x_c sees them, up to a degree.

    Returns the colors and back(color_bar), the gradients of x, sh_dc and sh_rest. The direction is
    that of the moved Gaussian, as in the kernel of 3DGS.
    """
    (_, d), back_view = pull(view, x, x_c)
    used = (degree + 1) ** 2 - 1
    sh = np.concatenate([p["sh_dc"], p["sh_rest"][:, :, :used]], axis=2)
    color, back_color = pull(sh_color, d, sh)

    def back(color_bar):
        bars = back_color(color_bar)
        sh_rest_bar = np.zeros_like(p["sh_rest"])
        sh_rest_bar[:, :, :used] = bars["sh"][:, :, 1:]
        x_bar = back_view(np.zeros_like(d[:, :1]), bars["d"])["x_a"]
        return {"x": x_bar, "sh_dc": bars["sh"][:, :, :1], "sh_rest": sh_rest_bar}

    return color, back


def degree_at(preset, iteration):
    """The active degree of the harmonics: it starts at 0 and grows by 1 every `sh_every`."""
    if iteration is None:
        return preset.sh_degree
    return min(iteration // preset.sh_every, preset.sh_degree)


def read_file(path):
    """Return the arrays {name: array} and the JSON values of a file.

    Raises ValueError with one line for a file that no model has saved.
    """
    with reading(Path(path), "the file of a baseline"):
        elements, comments, rest = read_ply(path, ("vertex", "network"))
        vertices, flat = (
            rows.view("<f4").reshape(len(rows), len(rows.dtype)) for rows in elements.values()
        )
        values = json.loads(comments[0])
        sizes = [math.prod(shape) for shape in values["shapes"].values()]
        require(not rest and sum(sizes) == len(flat), path, "expected a whole file of a baseline")
    arrays = {**split(vertices, values["rows"]), **split(flat[:, 0], values["shapes"])}
    arrays.pop("normals", None)
    return arrays, values


def split(numbers, shapes):
    """The arrays {name: array} of some shapes that lie one after another along the last axis."""
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    parts = zip(shapes.items(), np.split(numbers, ends[:-1].astype(int), axis=-1))
    return {name: part.reshape(*numbers.shape[:-1], *shape) for (name, shape), part in parts}
