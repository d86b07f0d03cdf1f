"""The good conformance streams: models made of integers, each for one corner of the format.

The texts of GOOD are published in the manifest.
"""

import numpy as np

from p4dgs_ref.codec.context import coding_context
from p4dgs_ref.codec.file import attribute_columns, sections_of
from p4dgs_ref.codec.quantise import Quantised, coded_columns
from p4dgs_ref.codec.streams import encode_bits, encode_gaussian
from p4dgs_ref.model import Anchors, Design, Model, split, unsnap
from p4dgs_ref.scenes.scene import MODEL_EFFECTS

BASE = Design(
    d=2,
    k=2,
    hidden=(2,),
    deformation=(3,),
    L_x=1,
    L_t=1,
    context=(4,),
    grid=(("xyz", 3), ("xy", 5)),
    table=(64, 64),
    F=2,
    Q_0=(0.5, 0.01, 0.01, 0.1),
    tau_alpha=0.0,
    effects=MODEL_EFFECTS,
)
LARGEST, SUBNORMAL = 65504.0, 2.0**-24  # float16's largest number and its smallest


class Draw:
    """Pseudo-random integers: the top 32 bits of Knuth's 64-bit linear congruential generator."""

    def __init__(self, seed):
        self.state = seed

    def __call__(self, least, most, *shape):
        """Integers from least to most, both included."""
        numbers = []
        for _ in range(int(np.prod(shape))):
            self.state = (self.state * 6364136223846793005 + 1442695040888963407) % 2**64
            numbers.append(least + (self.state >> 32) % (most - least + 1))
        return np.array(numbers, np.int64).reshape(shape)


class Parts:
    """The parts of a stream before its context is computed; a maker below changes what it tests."""

    def __init__(self, seed, anchors=4, **changes):
        self.draw, self.design = Draw(seed), Design(**{**vars(BASE), **changes})
        self.positions = self.draw(0, 65535, anchors, 3)
        self.box = np.array([-1.5, -1.0, 0.25], np.float32), np.array([1.5, 2.0, 1.75], np.float32)
        self.mask = self.draw(0, 3, anchors, self.design.k) > 0
        # Every anchor keeps a child.
        self.mask[range(anchors), np.arange(anchors) % self.design.k] = True
        self.grids = [
            np.where(self.draw(0, 2, T, F) > 0, 1.0, -1.0) for T, F in self.design.levels()
        ]
        self.networks = {
            name: (
                [self.draw(-512, 512, *pair) / 512 for pair in layers],
                [self.draw(-512, 512, columns) / 1024 for _, columns in layers],
            )
            for name, layers in self.design.layers().items()
        }
        self.lanes = {}  # section -> number of lanes, where the encoder does not choose
        prior, n = self.networks["psi_p"][1][-1], 0
        for width in self.design.widths:  # raw deviations from -4 to 0
            prior[n + width : n + 2 * width] = self.draw(-32, 0, width) / 8
            n += 2 * width

    def prior(self, weights=0.0, mu=None, raw=None):
        """Overwrite the last layer of psi_p.

        All weights become `weights`; the biases of the means and of the raw deviations become `mu`
        and `raw`, repeated as needed.
        """
        W, b = (arrays[-1] for arrays in self.networks["psi_p"])
        W[...] = weights
        columns = np.split(np.arange(len(b)), np.cumsum(np.repeat(self.design.widths, 2))[:-1])
        for values, parts in ((mu, columns[::2]), (raw, columns[1::2])):
            if values is not None:
                b[np.concatenate(parts)] = np.resize(values, sum(self.design.widths))

    def steps(self, *biases):
        """Let psi_q return these numbers for f, s, l and O, whatever h is."""
        self.networks["psi_q"][0][-1][...] = 0
        self.networks["psi_q"][1][-1][...] = biases

    def quantised(self, symbols=None):
        """The quantised model, with these symbols [A, n] or some within about a deviation."""
        ctx = coding_context(self.design, self.networks, self.grids, self.positions)
        kept = coded_columns(self.mask, self.design)
        if symbols is None:
            reach = np.minimum(1 << np.maximum(ctx.sigma_units >> 4, 0), 2**20)
            away = self.draw(-(2**20), 2**20, *kept.shape) * (2 * reach + 1) >> 21
            symbols = np.clip((ctx.mu_units + 512 >> 10) + away, -(2**31), 2**31)
        symbols = np.where(kept, symbols, 0)
        f, s, l, O = split(symbols * np.repeat(ctx.q, self.design.widths, axis=1), self.design)
        anchors = Anchors(unsnap(self.positions, *self.box), f, s, l, O, self.mask)
        background = np.array([0.25, 0.5, 1.0])
        model = Model(self.design, anchors, self.networks, self.grids, self.box, background)
        return Quantised(model, self.positions, symbols, kept, ctx)


def one_anchor():
    parts = Parts(
        2, anchors=1, d=1, k=1, grid=(("xy", 2),), F=1, hidden=(), context=(), deformation=()
    )
    parts.box = parts.box[0], parts.box[0]
    return parts


def all_masked():
    parts = Parts(3, anchors=1)
    parts.mask[...] = False
    return parts


def all_masked_but_one():
    parts = Parts(4, anchors=5, k=3)
    parts.mask[...] = np.arange(15).reshape(5, 3) == 10
    return parts


def one_child():
    parts = Parts(5, anchors=7, k=1)
    parts.mask[...] = True
    parts.grids = [np.ones_like(grid) for grid in parts.grids]
    return parts


def escapes():
    """mu is 0 and sigma / q is 2^-8, 1 or 2^20: the windows reach 2, 13 and 193 blocks far."""
    parts = Parts(6, anchors=8, Q_0=(0.5, 1.0, 2.0**-12, 2.0**-12))
    parts.prior(mu=0.0, raw=[-14.0, -14.0, *[0.0] * 3, *[6.0] * 9])
    parts.steps(0.0, 0.0, 0.0, 0.0)
    parts.mask[...] = True
    table = np.array(
        [
            [0, 1, 2],
            [-1, -2, -3],
            [12, 13, 14],
            [-12, -13, -14],
            [2**20, -(2**20), 2**24],
            [2**31 - 1, -(2**31) + 1, 2**31 - 2**20],
            [2**31, -(2**31), 2**30],
            [-(2**31), 2**31, 193 << 15],
        ]
    )
    return parts, np.concatenate([table[:, :2], table, table, table, -table], axis=1)


def sigma_clamps():
    """Raw deviations at, next to and beyond -14 and 6; sigma / q beyond 2^-8 and 2^20."""
    parts = Parts(7, anchors=3, Q_0=(0.5, 2.0**-12, 2.0**-11, 2.0**-4))
    parts.steps(0.0, 0.0, 0.0, 0.0)
    mu = np.repeat(parts.design.Q_0, parts.design.widths) * 511 / 1024
    parts.prior(mu=mu, raw=[-100.0, 100.0, -14.0, 6.0, -13.9921875, 5.99609375, -14.0078125])
    return parts


def smallest_steps():
    parts = Parts(8)
    parts.steps(-LARGEST, -4.0, -3.501953125, -2.5)
    return parts


def largest_steps():
    parts = Parts(9)
    parts.steps(LARGEST, 5.99609375, 6.0, 3.0)
    return parts


def base_steps():
    """mu / q is beyond +-2^34 for the smallest base step and almost 0 for the largest."""
    parts = Parts(10, Q_0=(2.0**-100, 2.0**100, 0.1, 2 / 3))
    parts.prior(weights=0.25, mu=[1.0, -1.0, 0.0, 300.0, -300.0])
    symbols = parts.draw(-3, 3, 4, 14)
    symbols[:, :2] = [2**31, -(2**31) + 1]
    return parts, symbols


def lattice():
    """Anchors are on nodes and on upper faces; the box has no extent along z."""
    parts = Parts(14, anchors=6, grid=(("xyz", 4), ("xz", 16), ("yz", 2)))
    parts.positions[:, 0] = [0, 65535, 21845, 65535, 21844, 4369]
    parts.positions[:, 1] = [0, 65535, 43690, 0, 43691, 1]
    parts.positions[:, 2] = 0
    parts.box[1][2] = parts.box[0][2]
    return parts


def lanes():
    """Messages have more lanes than an encoder would choose, from 2 to 1024."""
    parts = Parts(
        15, anchors=24, d=7, k=3, grid=(("xyz", 12), ("xy", 126), ("xz", 31)), table=(2**12, 2**14)
    )
    parts.prior(weights=0.125, raw=[1.5, 1.5, 1.5, 0.25])
    parts.lanes = {"features": 16, "scales": 2, "offset_scales": 4, "offsets": 8, "hash_grid": 1024}
    return parts


def raw_bits():
    """sigma / q is from 2^6 to almost 2^20: up to 15 raw bits per symbol, of either sign."""
    parts = Parts(16, anchors=6, Q_0=(2.0**-6, 2.0**-9, 2.0**-12, 2.0**-10))
    parts.prior(weights=0.5, raw=np.arange(14) / 4)
    return parts


def largest_weights():
    """Eight hidden layers of psi_p with weights at float16's limit: every activation is shifted."""
    parts = Parts(17, anchors=3, context=(3,) * 8)
    for W, b in zip(*parts.networks["psi_p"]):
        W[...], b[...] = np.where(W < 0, -LARGEST, LARGEST), LARGEST
        W[:, 0] = LARGEST  # lets positive numbers through all layers
    parts.networks["psi_p"][0][0][:, 1] = -LARGEST  # makes negative inputs positive
    return parts


def smallest_weights(unit=SUBNORMAL, seed=18):
    """Tiny weights precede a layer of large ones, whose largest bias limits their bits."""
    parts = Parts(seed, anchors=3)
    for name in ("psi_p", "psi_q"):
        weights, biases = parts.networks[name]
        weights[0][...], biases[0][...] = np.rint(weights[0] * 9) * unit, 9 * unit
        weights[1][...], biases[1][0] = parts.draw(-2047, 2047, *weights[1].shape), LARGEST
    return parts


def coarse_units():
    """All hidden activations are 0, so the outputs are the biases, rounded to sixteenths."""
    parts = Parts(22, anchors=2)
    for name in ("psi_p", "psi_q"):
        weights, biases = parts.networks[name]
        weights[0][0, 0] = weights[1][0, 0] = LARGEST
        biases[0][...] = -LARGEST
    parts.networks["psi_p"][1][1][...] = parts.draw(-56, 8, 28) / 32
    parts.networks["psi_q"][1][1][...] = [0.1875, -0.3125, 0.375, -0.75]
    return parts


def deviations():
    """Every float16 raw deviation next to the edge of a sixteenth of log2 sigma; log2 q is -1."""
    raw = np.arange(-14 << 16, 6 << 16)
    beyond = (raw * 94548 + 2**15 >> 16) % 4096 - 2048
    raw = raw[(-3 <= beyond) & (beyond < 7) & (np.float16(raw / 2**16) == raw / 2**16)] / 2**16
    parts = Parts(
        23,
        anchors=1,
        d=len(raw) - 9,
        k=1,
        Q_0=(0.5,) * 4,
        grid=(("xy", 2),),
        F=1,
        hidden=(1,),
        context=(),
        effects=(),
    )
    parts.steps(0.0, 0.0, 0.0, 0.0)
    parts.prior(weights=0.0, mu=0.0, raw=raw)
    return parts


def ties():
    """Weights and biases are half-way between two fixed-point integers."""
    parts = Parts(19, anchors=6)
    for weights, biases in (parts.networks["psi_p"], parts.networks["psi_q"]):
        for W, b in zip(weights, biases):
            W[...] = parts.draw(-9, 9, *W.shape) * 2.0**-15
            W[0, 0], W[-1, -1] = 1.0, -1.0
            b[...] = np.rint(b * 1024) * 2.0**-10
    return parts


def full():
    """Every effect, section and axis; several layers and levels, dense and hashed."""
    return Parts(
        20,
        anchors=12,
        d=4,
        k=3,
        hidden=(6, 5),
        deformation=(5, 4),
        L_x=2,
        L_t=3,
        context=(6, 5),
        F=2,
        grid=(
            ("xyz", 4),
            ("xyz", 7),
            ("xy", 6),
            ("xy", 11),
            ("xz", 6),
            ("xz", 11),
            ("yz", 6),
            ("yz", 11),
        ),
        table=(100, 64),
    )


# name: what it tests, and how it is made
GOOD = {
    "smallest_grid": (
        "a hash grid of one level with one node, the least there is: "
        "no grid is not a choice of the format",
        lambda: Parts(1, grid=(("xyz", 1),), F=1),
    ),
    "one_anchor": (
        "one anchor in a box without extent, d = k = 1, networks without hidden layers",
        one_anchor,
    ),
    "all_masked": (
        "one anchor and no child: `offsets` is empty, `masks` is a stream of equal bits",
        all_masked,
    ),
    "all_masked_but_one": (
        "one child of fifteen kept: anchors without children keep their other attributes",
        all_masked_but_one,
    ),
    "one_child": ("k = 1, all kept and all signs +1: two streams of equal bits", one_child),
    "escapes": ("symbols inside, at and outside of their windows, to +-2^31", escapes),
    "sigma_clamps": (
        "raw sigma at and beyond both clamps, sigma/q at and beyond both ends of its range",
        sigma_clamps,
    ),
    "smallest_steps": ("q on its floor, and just above", smallest_steps),
    "largest_steps": ("q at its ceiling, and just below", largest_steps),
    "base_steps": ("Q_0 from 2^-100 to 2^100, mu/q saturated at both ends", base_steps),
    "static": (
        "a scene that does not move: no section deformation_mlp; the view is seen by psi_c alone",
        lambda: Parts(11, hidden=(), effects=("view_color", "occlusion", "background")),
    ),
    "no_effects": (
        "no effect at all, two 2D levels, tables of neither xy nor xyz",
        lambda: Parts(12, anchors=5, effects=(), k=3, grid=(("yz", 4), ("xz", 3))),
    ),
    "hashed": (
        "hashed levels, 3D and 2D, to 65536 nodes an axis",
        # Tables are smaller than their grids; with 65536 nodes along an axis, positions are nodes.
        lambda: Parts(
            13,
            anchors=9,
            grid=(("xyz", 65536), ("xyz", 514), ("xy", 65536), ("xz", 130), ("yz", 9)),
            table=(61, 37),
            context=(5, 4),
        ),
    ),
    "lattice": ("positions on nodes and on the faces of a flat box", lattice),
    "lanes": ("2 to 1024 lanes", lanes),
    "raw_bits": ("sigma/q > 32: low bits of symbols stand as they are", raw_bits),
    "largest_weights": (
        "psi_p of eight hidden layers at float16's largest number",
        largest_weights,
    ),
    "smallest_weights": ("subnormal weights, units as fine as they get", smallest_weights),
    "small_weights": (
        "a bias that decides the units of its layer",
        lambda: smallest_weights(2.0**-18, 24),
    ),
    "coarse_units": (
        "outputs in units coarser than what is made of them, ties of biases",
        coarse_units,
    ),
    "deviations": ("raw sigma at the edges of its rounding", deviations),
    "ties": ("weights half-way between two fixed-point integers: to even", ties),
    "full": ("every effect, every section", full),
}


def stream_of(maker):
    """Build one good stream: (quantised, sections)."""
    made = maker()
    parts, symbols = made if isinstance(made, tuple) else (made, None)
    quantised = parts.quantised(symbols)
    sections, ctx = sections_of(quantised), quantised.context
    for name, columns in attribute_columns(parts.design):
        if name in parts.lanes:
            kept = quantised.kept[:, columns]
            arrays = (quantised.symbols, ctx.mu_units, ctx.sigma_units)
            coded = [array[:, columns][kept] for array in arrays]
            sections[name] = encode_gaussian(*coded, parts.lanes[name])
    if "hash_grid" in parts.lanes:
        signs = np.concatenate([grid.ravel() for grid in parts.grids])
        sections["hash_grid"] = encode_bits(signs > 0, parts.lanes["hash_grid"])
    return quantised, sections
