# %% [markdown]
# # Four ways to move a Gaussian
#
# Four methods draw moving Gaussians. They differ in what they store for a motion:
#
# | method | each Gaussian stores | all Gaussians share | its motion |
# |---|---|---|---|
# | P-4DGS | a share of an anchor | networks, hash grid, $\psi_d$ | a curve that $\psi_d$ gives |
# | D3DGS | 59 numbers | $\psi_d$, made larger by its authors | likewise |
# | 4DHexPlane | 59 numbers | six planes, a small network | a curve from node to node |
# | 4DGS | 161 numbers | nothing | a straight line, seen for a short time |
#
# P-4DGS and D3DGS move a Gaussian alike, by Eq. (5) and Eq. (6). There are therefore three ways to
# compute a motion: with a **network**, with **planes**, and as a **4D Gaussian**. This page fits
# each of them to one path, with the equations, backwards and Adam of this project, and shows where
# each fails. `python -m tutorials.experiments.baselines.four_ways_to_move` takes a minute.
#
# ## By hand
# A 4D Gaussian is an ellipsoid in space and time. Take one space axis, the covariance $\Sigma =
# \begin{pmatrix} A & b \\ b & v\end{pmatrix} = \begin{pmatrix} 0.05 & 0.02 \\ 0.02 &
# 0.01\end{pmatrix}$ and the mean $x = 0$, $\mu_t = 0.5$. A picture at time $t$ shows a slice of
# this ellipsoid (G2), which fades with the distance from $\mu_t$ (G3):
# $$x_t = x + \frac{b}{v}(t - \mu_t),\qquad \Sigma_t = A - \frac{b^2}{v},\qquad
#   w = \exp\Big(-\frac{(t - \mu_t)^2}{2v}\Big).$$
# The velocity is $0.02/0.01 = 2$ and never changes. At $t = 0.6$ the Gaussian is at $0.2$, with the
# variance $0.01$ and the weight $e^{-1/2} = 0.607$. An object that changes direction needs another
# Gaussian.
#
# A plane stores numbers at nodes. Five nodes along $t$ are 0.25 apart. At $t = 0.6$ a reading is
# $0.6$ of the node at 0.5 and $0.4$ of that at 0.75. Nothing is stored about the motion in between.

# %%
import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy is imported

import numpy as np

from p4dgs_ref.equations import mlp, positional_encoding
from p4dgs_ref.report.figures import BLUE, ORANGE, RED, save_figure, styled, subplots
from p4dgs_ref.training.parameters import Adam, Parameters, exponential, random_layers
from p4dgs_ref.training.presets import TINY
from tutorials.experiments import PICTURES
from tutorials.experiments.baselines import (
    conditional,
    gaussian4d,
    hexplane,
    marginal,
    plane_decoder,
    plane_features,
    rotation_4d,
)
from tutorials.experiments.baselines.deformation_d3dgs import deformation_layers

MANY, DENSE = np.linspace(0, 1, 33), np.linspace(0, 1, 193)
PLANES = hexplane.Preset()

# %% [markdown]
# ## The three ways
# `forward` returns the positions `[N, c, T, 3]` and the weights `[N, c, T]` of N moving points at T
# times, where c Gaussians share one point; for networks and planes c is 1. They have no weight, but
# can shrink a Gaussian to nothing: there, $w$ is its area as a share of the unmoved one.


# %%
class Network:
    """psi_d of Eq. (5) for the preset `tiny`; its heads of movement and stretching."""

    rate = (0.003, 1e-3)

    def __init__(self, path, rng):
        self.x = path(MANY).mean(axis=1)  # canonical: the middle of the path
        layers = deformation_layers(TINY.L_x, TINY.L_t, TINY.deformation, (6,))["psi_d"]
        self.parameters = Parameters(random_layers(rng, "psi_d", layers), np.float64)

    def forward(self, t):
        N, T = len(self.x), len(t)
        x = np.repeat(self.x, T, axis=0)
        E_x, _ = positional_encoding.forward(x, TINY.L_x)
        E_t, _ = positional_encoding.forward(np.tile(t, N)[:, None], TINY.L_t)
        inputs = np.concatenate([E_x, E_t], axis=1)
        y, saved = mlp.forward(inputs, *self.parameters.network("psi_d"))
        x_t, size = x + y[:, :3], 1 + y[:, 3]
        return x_t.reshape(N, 1, T, 3), (size**2).reshape(N, 1, T), (saved, size)

    def backward(self, saved, x_t_bar, w_bar):
        saved_mlp, size = saved
        y_bar = np.zeros((len(size), 6))
        y_bar[:, :3] = x_t_bar.reshape(-1, 3)
        y_bar[:, 3] = 2 * size * w_bar.ravel()
        gradients = self.parameters.zeros()
        gradients.fill("psi_d", mlp.backward(saved_mlp, y_bar, needs_x=False))
        return gradients


class Planes:
    """H1 and H2 for the first level of the planes of 4DHexPlane."""

    rate = (0.02, 4e-4)
    box = -np.ones(3), np.ones(3)

    def __init__(self, path, rng):
        self.x = path(MANY).mean(axis=1)
        n, F = PLANES.nodes, PLANES.features
        arrays = {f"planes.{i}": rng.uniform(0.1, 0.5, (n, n, F)) for i in range(3)}
        arrays |= {f"planes.{i}": np.ones((n, PLANES.time_nodes, F)) for i in range(3, 6)}
        arrays |= hexplane.first_network(rng, F, PLANES.hidden, 0.1)
        self.parameters = Parameters(arrays, np.float64)

    def forward(self, t):
        N, T, p = len(self.x), len(t), self.parameters
        x, each = np.repeat(self.x, T, axis=0), np.tile(t, N)[:, None]
        features, saved_planes = plane_features.forward(x, each, *self.box, p.listed("planes"))
        deltas, saved_decoder = plane_decoder.forward(features, *p.network("psi"))
        area = np.exp(2 * deltas[1][:, 0])
        saved = saved_planes, saved_decoder, area
        return (x + deltas[0]).reshape(N, 1, T, 3), area.reshape(N, 1, T), saved

    def backward(self, saved, x_t_bar, w_bar):
        saved_planes, saved_decoder, area = saved
        s_bar, r_bar = np.zeros((len(area), 3)), np.zeros((len(area), 4))
        s_bar[:, 0] = 2 * area * w_bar.ravel()
        psi = plane_decoder.backward(saved_decoder, x_t_bar.reshape(-1, 3), s_bar, r_bar)
        gradients = self.parameters.zeros()
        gradients.fill("psi", psi)
        at = plane_features.backward(saved_planes, psi["features"])
        for i, bar in enumerate(at["planes"]):
            gradients[f"planes.{i}"][...] = bar
        return gradients


class Gaussians4D:
    """G1, G2 and G3: eight Gaussians for each moving point, which begin on its path."""

    rate = (0.03, 5e-4)
    count = 8

    def __init__(self, path, rng):
        mu_t = (np.arange(self.count) + 0.5) / self.count
        x = path(mu_t).reshape(-1, 3)
        n = len(x)
        identity = np.tile([1.0, 0, 0, 0], (n, 1))
        arrays = {
            "x": x,
            "mu_t": np.tile(mu_t, n // self.count),
            "log_s": np.log(np.tile([0.1, 0.1, 0.1, 0.5 / self.count], (n, 1))),
            "raw_l": identity + 0.01 * rng.normal(size=(n, 4)),
            "raw_r": identity + 0.01 * rng.normal(size=(n, 4)),
        }
        self.parameters = Parameters(arrays, np.float64)

    def forward(self, t):
        p, T = self.parameters, len(t)
        s, (R, saved_R) = np.exp(p["log_s"]), rotation_4d.forward(p["raw_l"], p["raw_r"])
        x, mu_t, all_s, all_R = (np.repeat(a, T, axis=0) for a in (p["x"], p["mu_t"], s, R))
        each = np.tile(t, len(s))
        (x_t, _, var_t), saved_line = conditional.forward(x, mu_t, all_s, all_R, each)
        (_, w), saved_weight = marginal.forward(np.ones(len(x)), mu_t, var_t, each)
        shape = len(s) // self.count, self.count, T
        return x_t.reshape(*shape, 3), w.reshape(shape), (s, saved_R, saved_line, saved_weight)

    def backward(self, saved, x_t_bar, w_bar):
        s, saved_R, saved_line, saved_weight = saved
        rows = w_bar.size
        fading = marginal.backward(saved_weight, np.zeros(rows), w_bar.ravel())
        no_Sigma = np.zeros((rows, 3, 3))
        line = conditional.backward(saved_line, x_t_bar.reshape(-1, 3), no_Sigma, fading["var_t"])
        line["mu_t"] = line["mu_t"] + fading["mu_t"]
        line = {k: a.reshape(len(s), -1, *a.shape[1:]).sum(axis=1) for k, a in line.items()}
        turning = rotation_4d.backward(saved_R, line["R"])
        gradients = self.parameters.zeros()
        for name, bar in {**line, **turning, "log_s": line["s"] * s}.items():
            if name in gradients.arrays:
                gradients[name][...] = bar
        return gradients


WAYS = {"network": Network, "planes": Planes, "4D Gaussians": Gaussians4D}
COLORS = dict(zip(WAYS, (BLUE, ORANGE, RED)))

# %% [markdown]
# ## The fit
# No pictures are needed to study a motion. The loss says how far everything visible is from the
# point, and whether the total weight is 1:
# $$L_t = \sum_i w_i\,|x_i - x^*|^2 + \Big(\sum_i w_i - 1\Big)^2.$$


# %%
def loss(way, t, path):
    """The mean of L_t over the times and points, and the gradients of all parameters."""
    x_t, w, saved = way.forward(t)
    off = x_t - path(t)[:, None]
    squared = (off**2).sum(axis=3)
    missing = w.sum(axis=1, keepdims=True) - 1
    L = ((w * squared).sum() + (missing**2).sum()) / missing.size
    w_bar = (squared + 2 * missing) / missing.size
    return L, way.backward(saved, 2 * w[..., None] * off / missing.size, w_bar)


def fit(kind, path, t=MANY, iterations=300):
    """One of the ways after training."""
    way = kind(path, np.random.default_rng(0))
    adam = Adam(way.parameters)
    for i in range(iterations):
        _, gradients = loss(way, t, path)
        rate = exponential(i, *way.rate, iterations)
        adam.step(way.parameters, gradients, lambda name: rate)
    return way


def error(way, path):
    """The root mean square distance of what is visible from the path."""
    x_t, w, _ = way.forward(DENSE)
    squared = ((x_t - path(DENSE)[:, None]) ** 2).sum(axis=3)
    return np.sqrt(((w * squared).sum(axis=1) / w.sum(axis=1)).mean())


def bounce(t):
    """A ball [1, T, 3] that bounces three times; z is its height."""
    u = 3 * t % 1
    return np.stack([1.6 * t - 0.8, 0 * t, 4.8 * u * (1 - u) - 0.6], axis=-1)[None]


def swing(k):
    """A ball that swings k times up and down."""
    return lambda t: np.stack([0 * t, 0 * t, 0.5 * np.sin(2 * np.pi * k * t)], axis=-1)[None]


def apart(gap):
    """Two points that pass each other at a distance."""

    def path(t):
        run = np.stack([0.5 * (t - 0.5), 0 * t, 0 * t], axis=-1)
        middle = np.array([0, 0, gap / 2])
        return np.stack([middle + run, -middle - run])

    return path


# %% [markdown]
# ![One ball, three ways, and its total weight](../pictures/four_ways_to_move.png)
#
# The network and the planes move *one* Gaussian along the whole path. The path of the planes bends
# at the nodes, for example at $t = 2/7$, and both paths are rounded at the bounces. The eight 4D
# Gaussians are straight lines that fade into each other: the arcs have become polygons.
#
# ## Where each fails
# The table that this page prints has the errors of three situations that break at least one way:
#
# - **Fast motion.** A ball swings $k$ times. The network sees the time through waves of at most 8
#   radians, which is 1.3 swings. Eight nodes have fewer than two cells a swing from $k = 4$ on, and
#   eight lines one for each half swing. At 8 swings every error is 0.1 or more.
# - **Topology.** Two points pass each other. For a network and for planes, motion is a smooth
#   function of the position; a hand that leaves a table is such a case. Planes average over a cell
#   and fail at a gap of 0.01; the network becomes steep enough. 4D Gaussians do not mind.
# - **Few views.** The bouncing ball is seen 6, 12 or 24 times. No way knows the path in between.
#
# A network stores a motion once but is evaluated for every picture. 4DGS computes almost nothing
# for a picture, but stores the motion again for every piece of every path.


# %%
@styled()
def draw(fitted):
    """The ball's path by each way, and the weights over time."""
    figure, axes = subplots(2, 3, figsize=(11, 6.2), height_ratios=(1.6, 1), sharey="row")
    truth = bounce(DENSE)[0]
    for (top, below), (name, way) in zip(axes.T, fitted.items()):
        x_t, w, _ = way.forward(DENSE)
        top.plot(truth[:, 0], truth[:, 2], color="0.6", lw=5)
        for path, weight in zip(x_t[0], w[0]):
            seen = weight > gaussian4d.MIN_WEIGHT
            top.scatter(
                path[seen, 0], path[seen, 2], 14, COLORS[name], alpha=weight[seen].clip(max=1)
            )
            below.plot(DENSE, np.where(seen, weight, np.nan), color=COLORS[name], lw=1.5)
        below.plot(DENSE, w[0].sum(axis=0), color="k", ls="--", lw=1.5)
        top.set(title=f"{name}: error {error(way, bounce):.3f}", xlabel="x (scene units)")
        below.set(xlabel="time t", ylim=(0, 1.35))
    axes[0, 0].set_ylabel("height z (scene units)")
    axes[1, 0].set_ylabel("weight (dashed: all)")
    save_figure(figure, PICTURES / "four_ways_to_move.png")


def main():
    """Draw the bouncing ball and print the errors of the three situations."""
    draw({name: fit(kind, bounce) for name, kind in WAYS.items()})
    print("error of the path in scene units")
    for name, kind in WAYS.items():
        cases = {f"{k} swings": (swing(k), MANY) for k in (2, 4, 8)}
        cases |= {f"gap {gap}": (apart(gap), MANY) for gap in (0.2, 0.05, 0.01)}
        cases |= {f"{n} times": (bounce, np.linspace(0, 1, n)) for n in (6, 12, 24)}
        errors = [f"{case} {error(fit(kind, *at), at[0]):.3f}" for case, at in cases.items()]
        print(f"{name}: {', '.join(errors)}")


if __name__ == "__main__":
    main()
