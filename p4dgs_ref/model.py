"""A model of a scene, and the two pipelines of the paper's figures, forward and backward.

Fig. 1, rendering:  anchors -> canonical Gaussians -> Gaussians at time t -> image
                    `predict`, then `splatting.render`
Fig. 2, coding:     anchor positions -> hash grid -> steps q, means mu, standard deviations sigma
                    `context`
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from . import effects as fx
from .attributes import GROUPS
from .equations import color as color_equation
from .equations import (
    deformation,
    deformed,
    hash_grid,
    masking,
    offsets,
    opacity,
    prior,
    rotation,
    scale,
    step,
    view,
)
from .limits import MAX_ENTRIES, MAX_NUMBERS
from .splatting import render
from .splatting.camera import Camera
from .splatting.settings import FAST, Settings

ANCHOR_NETWORKS = ("psi_alpha", "psi_c", "psi_r", "psi_s")
CONTEXT_NETWORKS = ("psi_p", "psi_q")
LATTICE = 2**16 - 1  # positions have 16 bits per axis over the bounding box (Q14)


@dataclass(frozen=True)
class Design:
    """What a decoder must know besides the arrays: numbers and names, stored as JSON in a file."""

    d: int  # width of an anchor's feature
    k: int  # children of an anchor
    hidden: tuple  # hidden widths of the anchor networks
    deformation: tuple  # hidden widths of psi_d
    L_x: int  # frequencies of the positional encoding of x
    L_t: int  # frequencies of the positional encoding of t
    context: tuple  # hidden widths of psi_p and psi_q
    grid: tuple  # axes and resolution of each level: (("xyz", 8), ("xy", 16), ...) (Q11)
    table: tuple  # the most nodes that a 3D level and a 2D level of the grid store (Q11)
    F: int  # entries of a node: features, +1 or -1
    Q_0: tuple  # base steps of f, s, l, O
    tau_alpha: float
    effects: tuple

    @property
    def widths(self):
        """Coded numbers per anchor in each group: f, s, l, O."""
        return self.d, 3, 3, 3 * self.k

    def levels(self):
        """Return the shape (T, F) of every level of the hash grid."""
        most = {3: self.table[0], 2: self.table[1]}
        return [(min(res ** len(axes), most[len(axes)]), self.F) for axes, res in self.grid]

    def layers(self):
        """Return {network: [(rows, columns) of every layer]}; psi_d ends with its three heads."""
        geometry = self.d + fx.view_width(self.effects, "view_geometry")
        color_inputs = self.d + fx.view_width(self.effects, "view_color")
        h = len(self.grid) * self.F
        widths = {
            "psi_alpha": (geometry, *self.hidden, self.k),
            "psi_c": (color_inputs, *self.hidden, 3 * self.k),
            "psi_r": (geometry, *self.hidden, 4 * self.k),
            "psi_s": (geometry, *self.hidden, 3 * self.k),
            "psi_p": (h, *self.context, 2 * sum(self.widths)),
            "psi_q": (h, *self.context, len(GROUPS)),
        }
        layers = {name: list(zip(w[:-1], w[1:])) for name, w in widths.items()}
        if fx.moves(self.effects):
            E = 3 * (1 + 2 * self.L_x) + 1 + 2 * self.L_t
            trunk = [*zip((E, *self.deformation), self.deformation)]
            last = (E, *self.deformation)[-1]
            layers["psi_d"] = trunk + [(last, head) for head in fx.heads(self.effects)]
        return layers


def declared_numbers(design, anchors):
    """Return how many numbers a model has: {"anchors": ..., "grid": ..., "networks": ...}."""
    layers = [layer for network in design.layers().values() for layer in network]
    return {
        "anchors": anchors * (3 + sum(design.widths) + design.k),
        "grid": sum(T * F for T, F in design.levels()),
        "networks": sum((rows + 1) * columns for rows, columns in layers),
    }


def over_limits(design, anchors):
    """Return which limit of the file a model with this many anchors exceeds, in words, or "".

    An anchor has at least 14 numbers, so MAX_NUMBERS keeps its count below MAX_ANCHORS, too.
    """
    parts = declared_numbers(design, anchors)
    for what, count, most in (
        ("numbers", sum(parts.values()), MAX_NUMBERS),
        ("entries of the grid", parts["grid"], MAX_ENTRIES),
    ):
        if count > most:
            return f"expected at most {most} {what}, got {count}"
    return ""


def most_numbers(size):
    """Return how many numbers a file may declare if its sections have `size` bytes together."""
    return 2**22 + 2**4 * size


def over_file(design, anchors):
    """Return why no file can hold a model with this many anchors, in words, or "".

    A grid much larger than what its anchors read costs next to no bytes, so decoders refuse it.
    Attributes count as 8 bytes here, weights as 2, and a sign of the grid as 4, which is more than
    an encoder needs; only the signs that an anchor reads can change.
    """
    parts = declared_numbers(design, anchors)
    nodes = sum(2 ** len(axes) for axes, _ in design.grid)
    signs = min(parts["grid"], anchors * nodes * design.F)
    most = most_numbers(8 * parts["anchors"] + 2 * parts["networks"] + 4 * signs)
    count = sum(parts.values())
    excess = over_limits(design, anchors)
    if not excess and count > most:
        excess = f"expected at most {most} numbers with {anchors} anchors, or a smaller grid"
        return f"{excess}, got {count}"
    return excess


class Anchors(NamedTuple):
    """The attributes of A anchors, as linear values (Q5)."""

    x_a: np.ndarray  # [A, 3]  positions (scene units)
    f_a: np.ndarray  # [A, d]  features
    s_a: np.ndarray  # [A, 3]  scales (scene units)
    l_a: np.ndarray  # [A, 3]  offset scaling: how far the anchor reaches (scene units)
    O_a: np.ndarray  # [A, k, 3]  offsets of its children (multiples of l_a)
    mask: np.ndarray  # [A, k]  bool: which children are kept (Q15)


class Gaussians(NamedTuple):
    """The N Gaussians that are rendered at one time for one camera."""

    x: np.ndarray  # [N, 3]  centres
    s: np.ndarray  # [N, 3]  standard deviations
    r: np.ndarray  # [N, 4]  unit quaternions (w, x, y, z)
    alpha: np.ndarray  # [N]  opacities, from tau_alpha to 1
    color: np.ndarray  # [N, 3]  in [0, 1]
    index: np.ndarray  # [N]  a k + j for child j of anchor a


def with_backward(equation, *inputs):
    """Return the output of an equation's `forward`, and its `backward` with `saved` bound to it."""
    output, saved = equation.forward(*inputs)
    return output, partial(equation.backward, saved)


def concatenate_groups(f, s, l, O):
    """Return the coded numbers of every anchor side by side [A, n], n = d + 3 + 3 + 3k."""
    return np.concatenate([f, s, l, O.reshape(len(O), -1)], axis=1)


def join(anchors):
    """Return the coded attributes of every anchor side by side [A, n]."""
    return concatenate_groups(anchors.f_a, anchors.s_a, anchors.l_a, anchors.O_a)


def groups(values, design):
    """Return the columns [A, width] of each group in values [A, n], as views."""
    return np.split(values, np.cumsum(design.widths)[:-1], axis=1)


def split(values, design):
    """Invert `concatenate_groups`: return f [A, d], s, l [A, 3] and O [A, k, 3], as views."""
    f, s, l, O = groups(values, design)
    return f, s, l, O.reshape(len(O), design.k, 3)


def move(design, networks, x, s, r, t):
    """Predict in time: canonical Gaussians become those at time t (Eqs. 5 and 6).

    Return (x_t, s_t, r_t) and `back`, which gives the gradients of x, s, r and of the networks.
    No gradient flows from E(x) back into x (Q10).
    """
    deltas, back_deltas = with_backward(
        deformation, x, t, *networks["psi_d"], design.L_x, design.L_t
    )
    at_t, back_at_t = with_backward(deformed, x, s, r, *deltas)

    def back(x_t_bar, s_t_bar, r_t_bar):
        bars = back_at_t(x_t_bar, s_t_bar, r_t_bar)
        psi_d_bar = back_deltas(bars["delta_x"], bars["delta_s"], bars["delta_r"], needs_x=False)
        return bars["x"], bars["s"], bars["r"], {"psi_d": psi_d_bar}

    return at_t, back


def predict(design, networks, anchors, x_c, t=None):
    """Predict in space, then in time (P-4DGS Fig. 1, Eqs. 1 to 6).

    `networks` is {name: (weights, biases)}. Without t, as in stages 1 and 2 of training, the
    Gaussians are the canonical ones. Return

        the Gaussians at time t as the camera at x_c [3] sees them
        the opacities [A, k] of all children before masking, for density control
        back(x_bar, s_bar, r_bar, alpha_bar, color_bar), which gives the gradients of the anchors'
        attributes {name: gradient} and of the networks {name: gradients}
    """
    f_a, effects = anchors.f_a, design.effects
    seen = unseen = f_a[:, :0], f_a[:, :0]
    back_view = None
    if "view_color" in effects or "view_geometry" in effects:
        seen, back_view = with_backward(view, anchors.x_a, x_c)
    for_color = seen if "view_color" in effects else unseen
    for_geometry = seen if "view_geometry" in effects else unseen

    # All children [A, k, ...]:
    x, back_x = with_backward(offsets, anchors.x_a, anchors.O_a, anchors.l_a)
    s, back_s = with_backward(scale, anchors.s_a, f_a, *for_geometry, *networks["psi_s"])
    r, back_r = with_backward(rotation, f_a, *for_geometry, *networks["psi_r"])
    alpha, back_alpha = with_backward(opacity, f_a, *for_geometry, *networks["psi_alpha"])
    color, back_color = with_backward(color_equation, f_a, *for_color, *networks["psi_c"])
    # From here on the N kept children alone, in one list [N, ...]; `index` says which they are.
    # `masking` returns them, and takes their gradients, in the order of the published vectors.
    kept, back_kept = with_backward(masking, x, s, r, alpha, color, anchors.mask, design.tau_alpha)
    alpha_kept, x, color, s, r, index = kept
    back_move = None
    if t is not None and "psi_d" in networks:
        (x, s, r), back_move = move(design, networks, x, s, r, t)

    def back(x_bar, s_bar, r_bar, alpha_bar, color_bar):
        networks_bar = {}
        if back_move:
            x_bar, s_bar, r_bar, networks_bar = back_move(x_bar, s_bar, r_bar)
        children = back_kept(alpha_bar, x_bar, color_bar, s_bar, r_bar)  # [N, ...] -> [A, k, ...]
        placed = back_x(children["x"])
        predicted = {
            "psi_alpha": back_alpha(children["alpha"]),
            "psi_c": back_color(children["color"]),
            "psi_r": back_r(children["r"]),
            "psi_s": back_s(children["s"]),
        }
        f_a_bar = sum(psi["f_a"] for psi in predicted.values())
        x_a_bar = placed["x_a"]
        if back_view:  # every network that sees the view sends its gradient back
            seeing = [psi for psi in predicted.values() if psi["d_vc"].shape[1]]
            delta_vc_bar = sum(psi["delta_vc"] for psi in seeing)
            x_a_bar = x_a_bar + back_view(delta_vc_bar, sum(psi["d_vc"] for psi in seeing))["x_a"]
        attributes_bar = {
            "x_a": x_a_bar,
            "f_a": f_a_bar,
            "s_a": predicted["psi_s"]["s_a"],
            "l_a": placed["l_a"],
            "O_a": placed["O_a"],
        }
        return attributes_bar, {**networks_bar, **predicted}

    return Gaussians(x, s, r, alpha_kept, color, index), alpha, back


def bounding_box(x_a):
    """Return the corners lo and hi [3] of the anchors' box, in float32 as a file stores them."""
    return x_a.min(axis=0).astype(np.float32), x_a.max(axis=0).astype(np.float32)


def snap(x_a, lo, hi):
    """Round positions [A, 3] to the box's lattice (Q14).

    Return its symbols, integers from 0 to 65535, and the positions (float64) that they stand for.
    """
    symbols = np.rint(share_of(x_a, lo, hi) * LATTICE).astype(np.int64)
    return symbols, unsnap(symbols, lo, hi)


def share_of(x_a, lo, hi):
    """Return positions [A, 3] as shares of the box, from 0 at lo to 1 at hi; 0 if lo = hi."""
    lo, extent = lo.astype(float), hi.astype(float) - lo
    return (np.clip(x_a, lo, hi) - lo) / np.where(extent > 0, extent, 1)


def unsnap(symbols, lo, hi):
    """Return the positions (float64) of lattice symbols [A, 3], integers from 0 to 65535."""
    return lo.astype(float) + symbols * ((hi.astype(float) - lo) / LATTICE)


class Context(NamedTuple):
    """How the attributes of every anchor are quantised and coded; columns as in `join`."""

    q: np.ndarray  # [A, 4]  steps of f, s, l, O
    mu: np.ndarray  # [A, d + 3 + 3 + 3k]  predicted means
    sigma: np.ndarray  # [A, d + 3 + 3 + 3k]  predicted standard deviations


def context(design, networks, grids, located):
    """Predict steps, means and deviations from the hash grid (P-4DGS Fig. 2, Eqs. 9, 8 and 12).

    `located` is what `hash_grid.locate` returns for the positions. Return the Context and
    back(q_bar, mu_bar, sigma_bar), which gives the gradients of the grids, a list, and those of the
    networks "psi_q" and "psi_p".
    """
    h, saved_h = hash_grid.query(located, grids)
    q, back_q = with_backward(step, h, *networks["psi_q"], np.array(design.Q_0, h.dtype))
    (mu, sigma), back_prior = with_backward(prior, h, *networks["psi_p"], design.widths)

    def back(q_bar, mu_bar, sigma_bar):
        psi_q, psi_p = back_q(q_bar), back_prior(mu_bar, sigma_bar)
        grids_bar = hash_grid.backward(saved_h, psi_q["h"] + psi_p["h"])["grids"]  # both read h
        return grids_bar, {"psi_q": psi_q, "psi_p": psi_p}

    return Context(q, mu, sigma), back


@dataclass(frozen=True, eq=False)
class Model:
    """A model that is ready to render or to be coded: the result of `decode` and of `train`."""

    design: Design
    anchors: Anchors
    networks: dict[str, tuple[list, list]]  # name -> (weights, biases)
    grids: list[np.ndarray]  # [T, F] for each level; only the signs are used
    box: tuple[np.ndarray, np.ndarray]  # corners lo and hi [3] of the lattice of positions
    background: np.ndarray  # [3]

    @property
    def count(self) -> int:
        """The number of anchors."""
        return len(self.anchors.mask)

    def gaussians(self, t: float | None, camera: Camera) -> Gaussians:
        """Return the Gaussians at time t in [0, 1] for this camera; None gives the canonical ones.

        Raises ValueError for a time that is NaN or infinite.
        """
        if t is not None and not np.isfinite(t):
            raise ValueError(f"t: expected a number, got {t}")
        x_c = np.asarray(camera.center, self.anchors.x_a.dtype)
        return predict(self.design, self.networks, self.anchors, x_c, t)[0]

    def render(self, camera: Camera, t: float, settings: Settings = FAST) -> np.ndarray:
        """Return the image [H, W, 3] at time t in [0, 1]. Clip it to [0, 1] before saving it."""
        x, s, r, alpha, color, _ = self.gaussians(t, camera)
        occlusion = "occlusion" in self.design.effects
        (image, *_), _ = render.forward(
            x, s, r, alpha, color, camera, self.background, settings, occlusion, keep=False
        )
        return image
