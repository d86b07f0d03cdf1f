"""What the baselines share: explicit Gaussians, their presets, their file and their training.

A file is one PLY with Gaussians as its vertices, in float32 as the authors store them. The numbers
of networks and planes follow the vertices, where a viewer does not look; D3DGS's authors keep them
in a file of its own. The header says in JSON what a reader must know besides: about 2 KB.

Density control is that of 3DGS (Kerbl et al. 2023, section 5.2): cloning, splitting and pruning.
Its resets of the opacity come every 3,000 iterations, later than Gaussians are added here.
"""

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from p4dgs_ref.equations import render_loss, view
from p4dgs_ref.equations.numerics import normalise, sigmoid
from p4dgs_ref.model import bounding_box, with_backward
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.covariance import rotation_matrix
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.training import trainer
from p4dgs_ref.training.density import Statistics
from p4dgs_ref.training.initial import neighbour_distance, starting_points
from p4dgs_ref.training.objective import Losses, Rendered
from p4dgs_ref.training.parameters import Adam, Parameters, learning_rate_at
from p4dgs_ref.training.watch import NotFinite, first_bad

from . import sh_color

AFTER_TRAINING = 10**9  # an iteration in which every schedule of a preset has ended
START_ALPHA = 0.1  # the opacity of every Gaussian before training, as in 3DGS
MOVING_ARRAYS = ("psi", "psi_d", "psi_t", "planes")  # they take part once the Gaussians move
SHRINK = 1.6  # children of a split are smaller by this factor
# The fields of a preset that a file tells its reader.
FORM = ("sh_degree", "L_x", "L_t", "waves")
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
    """The constants that the methods have in common, for the tiny scenes.

    Rates are the first and the last, geometric over all iterations.
    """

    iterations: int = 3800
    warm_up: int = 0  # the first iteration in which the Gaussians move
    gaussians: int = 800  # at random points at the start
    most: int = 800  # density control adds none beyond; `tiny` has 200 anchors of 4 children
    extent: float = 1.0  # the points are uniform in [-extent, extent]^3
    sh_degree: int = 3
    sh_every: int = 500  # iterations from one active degree of the harmonics to the next
    lambda_ssim: float = 0.2
    lr_x: tuple = (5e-4, 5e-5)
    lr_sh_dc: tuple = (0.01, 0.001)
    lr_sh_rest: tuple = (0.0005, 5e-5)
    lr_alpha: tuple = (0.05, 0.005)
    lr_s: tuple = (0.01, 0.001)
    lr_r: tuple = (0.005, 5e-4)
    collect_from: int = 0
    grow_from: int = 300
    grow_every: int = 100
    grow_until: int = 2000
    gradient_threshold: float = 5e-4  # of the projected centre, in NDC units per view
    percent_dense: float = 0.02  # of the extent: smaller Gaussians are cloned, larger ones split
    min_opacity: float = 0.005

    def stage(self, iteration):
        """1 before the Gaussians move, then 2; 1 for a method in which they always do."""
        return 1 + (iteration >= self.warm_up > 0)


# --- the model and its file -----------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Explicit:
    """A model of explicit Gaussians. A method is a subclass, which also has

    initial(preset, rng, points)   the first arrays by name (a static method)
    predict(t, x_c, iteration)     the Gaussians at time t as the camera at x_c sees them, and
                                   back(x_bar, s_bar, r_bar, alpha_bar, color_bar), which returns
                                   the gradients {array name: gradient}; the iteration is one of
                                   training, or AFTER_TRAINING, the default
    """

    parameters: Parameters
    preset: Any
    background: np.ndarray  # [3]
    occlusion: bool = True

    METHOD: ClassVar[str]
    PROPERTIES: ClassVar[dict] = PLY_OF_3DGS  # of the arrays with one row for each Gaussian

    @property
    def count(self):
        """The number of stored Gaussians."""
        return len(self.parameters["x"])

    @property
    def box(self):
        """The corners of the bounding box of the stored centres."""
        return bounding_box(self.parameters["x"])

    def gaussians(self, t, camera):
        """The Gaussians at time t in [0, 1] for this camera."""
        return self.predict(t, camera.center)[0]

    def render(self, camera, t, settings=FAST):
        """The image [H, W, 3] at time t in [0, 1]. Clip it to [0, 1] before saving it."""
        g = self.gaussians(t, camera)
        (image, *_), _ = self.render_gaussians(g, camera, settings, keep=False)
        return image

    def render_gaussians(self, g, camera, settings, keep=True):
        """What `splatting.render.forward` returns for some Gaussians, and its backward."""
        looks = camera, self.background, settings, self.occlusion, keep
        return with_backward(render, g.x, g.s, g.r, g.alpha, g.color, *looks)

    def regularise(self, gradients, iteration):
        """Return the further terms of the loss and add their gradients; here there are none."""
        return 0.0

    def values(self):
        """What a file says besides the numbers."""
        arrays = self.parameters.arrays
        return {
            "method": self.METHOD,
            "form": {f: getattr(self.preset, f) for f in FORM if hasattr(self.preset, f)},
            "background": [float(c) for c in self.background],
            "occlusion": self.occlusion,
            "rows": {n: arrays[n].shape[1:] if n in arrays else (3,) for n in self.PROPERTIES},
            "shapes": {n: a.shape for n, a in arrays.items() if n not in self.PROPERTIES},
        }

    def save(self, path):
        """Write the file; returns its bytes as {"gaussians": ..., "network": ..., "other": ...}."""
        arrays, normals = dict(self.parameters.arrays), np.zeros((self.count, 3))
        columns = [arrays.pop(name, normals) for name in self.PROPERTIES]
        columns = [array.reshape(len(array), -1) for array in columns]
        properties = [
            text.replace("*", str(i)) if "*" in text else text.split()[i]
            for text, numbers in zip(self.PROPERTIES.values(), columns)
            for i in range(numbers.shape[1])
        ]
        network = np.concatenate([np.zeros(0), *(array.ravel() for array in arrays.values())])
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            f"comment {json.dumps(self.values())}",
            f"comment {len(network)} float32 of networks follow the vertices",
            f"element vertex {self.count}",
            *(f"property float {name}" for name in properties),
            "end_header\n",
        ]
        vertices = np.concatenate(columns, axis=1).astype("<f4").tobytes()
        parts = "\n".join(lines).encode("ascii"), vertices, network.astype("<f4").tobytes()
        Path(path).write_bytes(b"".join(parts))
        return dict(zip(("other", "gaussians", "network"), map(len, parts)))


def read_ply(data):
    """The Parameters and the JSON values of a PLY file."""
    head, _, body = data.partition(b"end_header\n")
    values = json.loads(re.search(rb"comment ({.*})", head)[1])
    count = int(re.search(rb"element vertex (\d+)", head)[1])
    columns = sum(math.prod(shape) for shape in values["rows"].values())
    numbers = np.frombuffer(body, "<f4")
    rows, network = numbers[: count * columns].reshape(count, columns), numbers[count * columns :]
    arrays = {**split(rows, values["rows"]), **split(network, values["shapes"])}
    arrays.pop("normals", None)
    return Parameters(arrays), values


def split(numbers, shapes):
    """The arrays {name: array} of some shapes that lie one after another along the last axis."""
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    parts = zip(shapes.items(), np.split(numbers, ends[:-1].astype(int), axis=-1))
    return {name: part.reshape(*numbers.shape[:-1], *shape) for (name, shape), part in parts}


# --- what the pipelines share ---------------------------------------------------------------------
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


def colors(preset, p, x, x_c, iteration):
    """D2 for Gaussians at x [N, 3] as the camera at x_c sees them, up to the active degree.

    That is 0 at first and grows by 1 every `sh_every` iterations. Returns the colors and
    back(color_bar), the gradients of x, sh_dc and sh_rest. The direction is that of the moved
    Gaussian, as in the kernel of 3DGS.
    """
    (_, d), back_view = with_backward(view, x, x_c)
    degree = min(iteration // preset.sh_every, preset.sh_degree)
    used = (degree + 1) ** 2 - 1
    sh = np.concatenate([p["sh_dc"], p["sh_rest"][:, :, :used]], axis=2)
    color, back_color = with_backward(sh_color, d, sh)

    def back(color_bar):
        bars = back_color(color_bar)
        sh_rest_bar = np.zeros_like(p["sh_rest"])
        sh_rest_bar[:, :, :used] = bars["sh"][:, :, 1:]
        x_bar = back_view(np.zeros_like(d[:, :1]), bars["d"])["x_a"]
        return {"x": x_bar, "sh_dc": bars["sh"][:, :, :1], "sh_rest": sh_rest_bar}

    return color, back


def of_network(name, weights, biases):
    """Gradients of a network by the names of its arrays."""
    layers = zip("Wb", (weights, biases))
    return {f"{name}.{kind}{i}": a for kind, listed in layers for i, a in enumerate(listed)}


# --- training -------------------------------------------------------------------------------------
class Trainer(trainer.Trainer):
    """Fits one scene by the method `kind`, a subclass of Explicit."""

    kind: type
    # The field of the preset with the rate of an array, or of all arrays of a network; without one,
    # an array is not trained.
    RATES = {
        "x": "lr_x",
        "sh_dc": "lr_sh_dc",
        "sh_rest": "lr_sh_rest",
        "logit_alpha": "lr_alpha",
        "log_s": "lr_s",
        "raw_r": "lr_r",
    }
    PER_EXTENT = ()  # names whose rates are multiples of the extent of the cameras

    def __init__(self, scene, preset, seed=0, settings=FAST):
        self.scene, self.preset, self.settings = scene, preset, settings
        self.rng = np.random.default_rng(seed)
        self.iteration, self.order = 0, []
        self.parameters = Parameters(self.kind.initial(preset, self.rng, scene.points))
        self.adam = Adam(self.parameters)
        self.extent = extent_of(scene.train)
        self.statistics = Statistics.empty(self.count, 1)

    @property
    def count(self):
        """The number of Gaussians."""
        return len(self.parameters["x"])

    def around(self, parameters):
        """The model of some parameters, which it does not copy."""
        scene = self.scene
        return self.kind(parameters, self.preset, scene.background, "occlusion" in scene.effects)

    def model(self):
        """The model as it is now."""
        return self.around(Parameters(self.parameters.arrays))

    def learning_rate(self, name):
        """The current learning rate of an array, or of all arrays of a network."""
        waits = name in MOVING_ARRAYS and self.iteration < self.preset.warm_up
        if waits or name not in self.RATES:
            return 0.0
        now, until = self.schedule()
        rate = learning_rate_at(now, *getattr(self.preset, self.RATES[name]), until=until)
        return rate * self.extent if name in self.PER_EXTENT else rate

    def schedule(self):
        """How long the schedule of the rates has run, and after how many iterations it ends."""
        return self.iteration, self.preset.iterations

    def gradients_of(self, view):
        """The Losses of a view, what was Rendered, and the gradients of parameters and of mean2d.

        Raises NotFinite with the first array and index that is NaN or infinite.
        """
        preset, p = self.preset, self.parameters
        model, gradients = self.around(p), p.zeros()
        x_c = view.camera.center.astype(p.vector.dtype)
        g, back_predict = model.predict(view.time, x_c, self.iteration)
        (image, _, visible), back_render = model.render_gaussians(g, view.camera, self.settings)
        truth = view.image.astype(image.dtype)
        losses, back_loss = with_backward(render_loss, image, truth, preset.lambda_ssim)
        bars = back_render(back_loss(1.0)["image"])
        gaussians_bar = [bars[name].astype(p.vector.dtype) for name in g._fields[:-1]]
        for name, gradient in back_predict(*gaussians_bar).items():
            gradients[name][...] = gradient
        L_render, L1, D_SSIM = (float(loss) for loss in losses)
        L_total = L_render + model.regularise(gradients, self.iteration)
        if not np.isfinite(L_total) or not np.isfinite(gradients.vector).all():
            bad = first_bad({"L_total": L_total, **gradients.arrays})
            raise NotFinite(f"iteration {self.iteration}: loss or gradient of {bad}")
        unused = np.zeros((self.count, 1))  # opacities, which decide nothing here
        return (
            Losses(L_total, L_render, L1, D_SSIM, 0.0, 0.0),
            Rendered(unused, g.index, visible, image),
            gradients,
            bars["mean2d"],
        )

    def scatter(self, children):
        """Move copies {array name: rows} of a Gaussian to points drawn from it, and shrink them."""
        r, _ = normalise(children["raw_r"])
        drawn = self.rng.normal(size=children["x"].shape) * np.exp(children["log_s"])
        children["x"] += np.einsum("nij,nj->ni", rotation_matrix(r), drawn)
        children["log_s"] -= np.log(SHRINK)

    def adjust(self):
        """Clone, split and prune."""
        preset, now, p = self.preset, self.iteration, self.parameters
        if not preset.grow_from < now < preset.grow_until:
            return
        gradient = (self.statistics.gradient / np.maximum(self.statistics.seen, 1))[:, 0]
        rows = [name for name in self.kind.PROPERTIES if name in p.arrays]
        keep, added = densify(p, rows, gradient, self.extent, preset, self.scatter)
        if keep.any() or len(added["x"]):
            zeros = {name: np.zeros_like(a) for name, a in added.items()}
            self.parameters = p.with_rows(rows, keep, added)
            self.adam.first = self.adam.first.with_rows(rows, keep, zeros)
            self.adam.second = self.adam.second.with_rows(rows, keep, zeros)
        self.statistics = Statistics.empty(self.count, 1)


# --- density control ------------------------------------------------------------------------------
def extent_of(views):
    """The size of a scene by 3DGS: how far its cameras are from their mean, and 10 % more."""
    centers = np.array([view.camera.center for view in views])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def densify(p, rows, gradient, extent, preset, scatter):
    """The Gaussians [N] to keep, and new ones as {array name: rows}.

    Where the mean gradient [N] of the projected centre is large, a small Gaussian is cloned in
    place, and a large one is replaced by two, which `scatter` places and shrinks. Of old and new
    ones those are left out that are nearly transparent. No more are added than `most` leaves room
    for, those with the largest gradients.
    """
    room = max(preset.most - len(gradient), 0)
    wanted = np.zeros(len(gradient), bool)
    wanted[np.argsort(-gradient, kind="stable")[:room]] = True
    wanted &= gradient >= preset.gradient_threshold
    large = np.exp(p["log_s"]).max(axis=1) > preset.percent_dense * extent
    clones, parents = np.flatnonzero(wanted & ~large), np.flatnonzero(wanted & large)
    children = {name: np.repeat(p[name][parents], 2, axis=0) for name in rows}
    scatter(children)
    added = {name: np.concatenate([p[name][clones], children[name]]) for name in rows}
    keep, lasting = (sigmoid(a["logit_alpha"]) >= preset.min_opacity for a in (p, added))
    keep[parents] = False
    return keep, {name: a[lasting] for name, a in added.items()}
