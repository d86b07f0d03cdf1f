"""A model of a scene, and the two pipelines of the paper's figures, forward and, below, backward.

Fig. 1, rendering:  anchors -> canonical Gaussians -> Gaussians at time t -> image    (`predict`, `splatting.render`)
Fig. 2, coding:     anchor positions -> hash grid -> steps q, means mu, deviations sigma    (`context`)
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from . import effects as fx
from .equations import (
    color,
    deformation,
    deformed,
    hash_grid,
    masking,
    mlp,
    offsets,
    opacity,
    prior,
    rotation,
    scale,
    step,
    view,
)
from .splatting import render
from .splatting.settings import FAST

ANCHOR_NETWORKS = ("psi_alpha", "psi_c", "psi_r", "psi_s")
CONTEXT_NETWORKS = ("psi_p", "psi_q")
LATTICE = 2**16 - 1  # positions have 16 bits per axis over the bounding box (Q14)
GROUPS = ("f", "s", "l", "O")  # attribute groups in coding order, one step q each (Q6)


class Design(NamedTuple):
    """What a decoder must know of a model besides its arrays; plain numbers and names, so it fits a JSON line."""

    d: int  # width of an anchor's feature
    k: int  # children of an anchor
    hidden: tuple  # hidden widths of the anchor networks
    deformation: tuple  # hidden widths of psi_d
    L_x: int  # frequencies of the positional encoding of x
    L_t: int  # and of t
    context: tuple  # hidden widths of psi_p and psi_q
    grid: tuple  # resolutions: (("xyz", 8), ("xy", 16), ...), order of Q11
    table: tuple  # most entries of a level: (of a 3D grid, of a 2D grid)
    F: int  # features per grid node
    Q_0: tuple  # base steps of f, s, l, O
    tau_alpha: float
    effects: tuple

    @property
    def widths(self):
        """Coded numbers per anchor in each group: f, s, l, O."""
        return self.d, 3, 3, 3 * self.k

    def levels(self):
        """Entries (T, F) of every level of the hash grid."""
        return [
            (min(res ** len(axes), self.table[len(axes) == 2]), self.F) for axes, res in self.grid
        ]

    def layers(self):
        """Rows and columns of every layer of every network; psi_d ends with its three heads, see `fx.heads`."""
        geometry, seen = (
            self.d + fx.view_width(self.effects, which) for which in ("view_geometry", "view_color")
        )
        h = len(self.grid) * self.F
        widths = {
            "psi_alpha": (geometry, *self.hidden, self.k),
            "psi_c": (seen, *self.hidden, 3 * self.k),
            "psi_r": (geometry, *self.hidden, 4 * self.k),
            "psi_s": (geometry, *self.hidden, 3 * self.k),
            "psi_p": (h, *self.context, 2 * sum(self.widths)),
            "psi_q": (h, *self.context, len(GROUPS)),
        }
        layers = {name: list(zip(w[:-1], w[1:])) for name, w in widths.items()}
        if fx.moves(self.effects):
            trunk = (3 * (1 + 2 * self.L_x) + 1 + 2 * self.L_t, *self.deformation)
            layers["psi_d"] = [
                *zip(trunk[:-1], trunk[1:]),
                *((trunk[-1], head) for head in fx.heads(self.effects)),
            ]
        return layers


class Anchors(NamedTuple):
    """The five attributes of every anchor, linear values (Q5), and which children are kept (Q15)."""

    x_a: np.ndarray  # (A, 3)
    f_a: np.ndarray  # (A, d)
    s_a: np.ndarray  # (A, 3)
    l_a: np.ndarray  # (A, 3)
    O_a: np.ndarray  # (A, k, 3)
    mask: np.ndarray  # (A, k) bool


class Gaussians(NamedTuple):
    """What is rendered: N Gaussians at one time, seen from one camera."""

    x: np.ndarray  # (N, 3)
    s: np.ndarray  # (N, 3)
    r: np.ndarray  # (N, 4) unit quaternion (w, x, y, z)
    alpha: np.ndarray  # (N,)
    color: np.ndarray  # (N, 3)
    index: np.ndarray  # (N,) a k + j of the anchor and child each came from


class SavedPrediction(NamedTuple):
    """What `predict_backward` needs: what every equation saved, and the opacities for training."""

    alpha: np.ndarray  # (A, k) opacities before masking, which density control watches
    view: tuple | None  # None where the scene has no view effects
    opacity: tuple
    color: tuple
    rotation: tuple
    scale: tuple
    offsets: tuple
    masking: tuple
    deformation: tuple | None = None  # None where nothing moves or time has not started
    deformed: tuple | None = None


def beside(f, s, l, O):
    """f (A, d), s, l (A, 3), O (A, k, 3) side by side, in the order of GROUPS: (A, d + 3 + 3 + 3k)."""
    return np.concatenate([f, s, l, O.reshape(len(O), -1)], axis=1)


def join(anchors):
    """The coded attributes of every anchor side by side."""
    return beside(anchors.f_a, anchors.s_a, anchors.l_a, anchors.O_a)


def groups(values, design):
    """The columns of each group, as views: [(A, d), (A, 3), (A, 3), (A, 3k)]."""
    return np.split(values, np.cumsum(design.widths[:3]), axis=1)


def split(values, design):
    """The inverse of `beside`: f, s, l and O (A, k, 3), as views."""
    f, s, l, O = groups(values, design)
    return f, s, l, O.reshape(len(O), design.k, 3)


def predict(design, networks, anchors, x_c, t=None):
    """Spatial, then temporal prediction (P-4DGS Fig. 1, Eqs. 1 to 6).

    Return the Gaussians at time t as the camera at x_c (3,) sees them, and what `predict_backward`
    needs. `networks` is {name: (weights, biases)}. Without t, as in stages 1 and 2 of training, the
    Gaussians are the canonical ones.
    """
    f_a, effects = anchors.f_a, design.effects
    unseen = f_a[:, :0], f_a[:, :0]
    seen, saved_view = unseen, None
    if "view_color" in effects or "view_geometry" in effects:
        seen, saved_view = view.forward(anchors.x_a, x_c)
    for_color = seen if "view_color" in effects else unseen
    for_geometry = seen if "view_geometry" in effects else unseen

    alpha, saved_opacity = opacity.forward(f_a, *for_geometry, *networks["psi_alpha"])
    c, saved_color = color.forward(f_a, *for_color, *networks["psi_c"])
    r, saved_rotation = rotation.forward(f_a, *for_geometry, *networks["psi_r"])
    s, saved_scale = scale.forward(anchors.s_a, f_a, *for_geometry, *networks["psi_s"])
    x, saved_offsets = offsets.forward(anchors.x_a, anchors.O_a, anchors.l_a)
    kept, saved_masking = masking.forward(alpha, anchors.mask, design.tau_alpha, x, c, s, r)
    alpha_kept, x, c, s, r, index = kept
    saved = SavedPrediction(
        alpha,
        saved_view,
        saved_opacity,
        saved_color,
        saved_rotation,
        saved_scale,
        saved_offsets,
        saved_masking,
    )
    if t is not None and "psi_d" in networks:
        deltas, saved_deformation = deformation.forward(
            x, t, *networks["psi_d"], design.L_x, design.L_t
        )
        (x, s, r), saved_deformed = deformed.forward(x, s, r, *deltas)
        saved = saved._replace(deformation=saved_deformation, deformed=saved_deformed)
    return Gaussians(x, s, r, alpha_kept, c, index), saved


def predict_backward(saved, x_bar, s_bar, r_bar, alpha_bar, color_bar):
    """Gradients of the anchors' attributes {name: gradient} and of the networks {name: gradients}.

    The cotangents are those of the Gaussians at time t. No gradient flows from E(x) back into x
    (Q10).
    """
    networks = {}
    if saved.deformed is not None:
        at_t = deformed.backward(saved.deformed, x_bar, s_bar, r_bar)
        x_bar, s_bar, r_bar = at_t["x"], at_t["s"], at_t["r"]
        networks["psi_d"] = deformation.backward(
            saved.deformation, at_t["delta_x"], at_t["delta_s"], at_t["delta_r"], needs_x=False
        )
    children = masking.backward(saved.masking, alpha_bar, x_bar, color_bar, s_bar, r_bar)
    placed = offsets.backward(saved.offsets, children["x"])
    networks["psi_s"] = scale.backward(saved.scale, children["s"])
    networks["psi_r"] = rotation.backward(saved.rotation, children["r"])
    networks["psi_c"] = color.backward(saved.color, children["color"])
    networks["psi_alpha"] = opacity.backward(saved.opacity, children["alpha"])
    anchors = {
        "x_a": placed["x_a"],
        "O_a": placed["O_a"],
        "l_a": placed["l_a"],
        "s_a": networks["psi_s"]["s_a"],
        "f_a": sum(networks[name]["f_a"] for name in ANCHOR_NETWORKS),
    }
    if saved.view is not None:  # every network that sees the view sends its gradient back
        seeing = [networks[name] for name in ANCHOR_NETWORKS if networks[name]["d_vc"].shape[1]]
        delta_vc_bar = sum(gradients["delta_vc"] for gradients in seeing)
        d_vc_bar = sum(gradients["d_vc"] for gradients in seeing)
        anchors["x_a"] = anchors["x_a"] + view.backward(saved.view, delta_vc_bar, d_vc_bar)["x_a"]
    return anchors, networks


def bounding_box(x_a):
    """The corners (lo, hi) of the anchors' box as float32, the precision in which a file carries them."""
    return x_a.min(axis=0).astype(np.float32), x_a.max(axis=0).astype(np.float32)


def snap(x_a, lo, hi):
    """Positions on the 16-bit lattice of the box, round to nearest (Q14): (symbols int64, positions float64)."""
    lo, extent = lo.astype(float), hi.astype(float) - lo
    symbols = np.rint(
        (np.clip(x_a, lo, hi) - lo) / np.where(extent > 0, extent, 1) * LATTICE
    ).astype(np.int64)
    return symbols, unsnap(symbols, lo, hi)


def unsnap(symbols, lo, hi):
    """Positions of lattice symbols: (A, 3) integers in 0 ... 65535 -> float64."""
    return lo.astype(float) + symbols * ((hi.astype(float) - lo) / LATTICE)


class Context(NamedTuple):
    """How the attributes of every anchor are quantised and coded; columns as in `join`."""

    q: np.ndarray  # (A, 4) steps of f, s, l, O
    mu: np.ndarray  # (A, d + 3 + 3 + 3k)
    sigma: np.ndarray  # (A, d + 3 + 3 + 3k)


def context(design, networks, grids, located):
    """Hash grid, adaptive steps and prior (P-4DGS Fig. 2, Eqs. 8, 9 and 12).

    Return the Context and what `context_backward` needs. `located` is what `hash_grid.locate` returns
    for the positions.
    """
    h, saved_grid = hash_grid.query(located, grids)
    q, saved_step = step.forward(h, *networks["psi_q"], np.array(design.Q_0, h.dtype))
    (mu, sigma), saved_prior = prior.forward(h, *networks["psi_p"], design.widths)
    return Context(q, mu, sigma), (saved_grid, saved_step, saved_prior)


def context_backward(saved, q_bar, mu_bar, sigma_bar):
    """Gradients of the grids [level, ...] and of the networks {"psi_q": gradients, "psi_p": gradients}."""
    saved_grid, saved_step, saved_prior = saved
    steps = step.backward(saved_step, q_bar)
    priors = prior.backward(saved_prior, mu_bar, sigma_bar)
    grids = hash_grid.backward(saved_grid, steps["h"] + priors["h"])["grids"]
    return grids, {"psi_q": steps, "psi_p": priors}


@dataclass(frozen=True, eq=False)
class Model:
    """A model that is ready to render or to be coded; what `decode` returns and `train` ends with."""

    design: Design
    anchors: Anchors
    networks: dict  # name -> (weights, biases)
    grids: list  # levels (T, F); the sign of an entry is all that counts
    box: tuple  # (lo, hi), each (3,): the bounding box in which positions have 16 bits
    background: np.ndarray  # (3,)

    def gaussians(self, t, camera):
        """The Gaussians at time t in [0, 1] as that camera sees them."""
        return predict(
            self.design,
            self.networks,
            self.anchors,
            np.asarray(camera.center, self.anchors.x_a.dtype),
            t,
        )[0]

    def render(self, camera, t, settings=FAST):
        """An image (H, W, 3), values usually but not necessarily in [0, 1]; clip before you save it."""
        g = self.gaussians(t, camera)
        (image, *_), _ = render.forward(
            g.x,
            g.s,
            g.r,
            g.alpha,
            g.color,
            camera,
            self.background,
            settings,
            "occlusion" in self.design.effects,
        )
        return image


def without_silent_units(model):
    """The same model without hidden units of psi_alpha ... psi_r that no anchor ever wakes.

    Without a view effect these networks read the features of the anchors and nothing else, a finite list; a ReLU that
    is 0 at every entry of it adds nothing to any picture.  The networks share their widths (`Design`), so as many units
    go from each as the one with the fewest can spare.  With a view effect nothing can be said: unchanged.

    Choice     exact where features and weights are those of the file: call it after `quantise`, not before
    """
    if {"view_color", "view_geometry"} & set(model.design.effects) or not model.design.hidden:
        return model
    woken, slim = {}, {}
    for name in ANCHOR_NETWORKS:
        _, (layer_inputs, _) = mlp.forward(model.anchors.f_a, *model.networks[name])
        woken[name] = [units.any(axis=0) for units in layer_inputs[1:]]
    widths = tuple(
        max(1, *(int(layer.sum()) for layer in layers)) for layers in zip(*woken.values())
    )
    for name, layers in woken.items():
        kept = [
            np.sort(np.argsort(~layer, kind="stable")[:width])
            for layer, width in zip(layers, widths)
        ]
        before, after = [np.arange(model.design.d), *kept], [*kept, slice(None)]
        weights, biases = model.networks[name]
        slim[name] = (
            [W[rows][:, columns] for W, rows, columns in zip(weights, before, after)],
            [b[columns] for b, columns in zip(biases, after)],
        )
    return replace(
        model, design=model.design._replace(hidden=widths), networks={**model.networks, **slim}
    )
