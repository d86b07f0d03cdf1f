"""Vectors of level L2, the half of Fig. 2: from positions to what coding needs, and from noisy attributes to bits."""

from typing import NamedTuple

import numpy as np

from .. import model
from ..equations import hash_grid, hash_rate
from ..equations.equation import Case
from ..equations.mlp import random_network
from ..model import Context
from ..training import objective
from .undeclared import SILENT, flat_gradients, flat_networks, networks_of, shapes_of, undeclared


# --- positions -> steps and priors ---------------------------------------------------------------------------------
class Read(NamedTuple):
    h: np.ndarray  # (A, I)
    q: np.ndarray  # (A, 4)
    mu: np.ndarray  # (A, n)
    sigma: np.ndarray  # (A, n)


def context_forward(x_a, lo, hi, grids, resolutions, Q_0, d, k, **networks):
    """The coding context: hash grid, adaptive steps, prior.

    Shapes     x_a (A, 3), lo, hi (3,), grids [(T, F), ...], resolutions ((axes, res), ...), Q_0 (4,), psi_q, psi_p
               -> h (A, L F), q (A, 4), mu, sigma (A, n), n = d + 6 + 3k: columns f, s, l, O
    Units      as in the equations
    Domain     as in the equations
    Gradient   grids (straight through the sign where |parameter| <= 1), psi_q, psi_p; positions are data
    Choice     Q6 to Q8, Q11
    Reference  P-4DGS Fig. 2, Eqs. (8), (9), (12)
    """
    located = hash_grid.locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])
    read, res_h = hash_grid.query(located, grids)
    design = SILENT._replace(d=d, k=k, Q_0=tuple(Q_0))
    context, res = model.context(design, networks_of(networks), grids, located)
    return Read(read.h, *context), (res_h, res)


def context_backward(res, h_bar, q_bar, mu_bar, sigma_bar):
    direct = hash_grid.backward(res[0], h_bar)["grids"]
    grids, networks = model.context_backward(res[1], q_bar, mu_bar, sigma_bar)
    return {"grids": [a + b for a, b in zip(direct, grids)], **flat_gradients(networks)}


def context_surrogate(**base):
    """The context of grids whose signs stay those of `base` and move by the parameters' change."""
    read = hash_grid.surrogate(
        *(base[name] for name in ("x_a", "lo", "hi", "grids", "resolutions"))
    )

    def smooth(grids, Q_0, d, k, **inputs):
        h = read(grids=grids).h
        networks = networks_of(inputs)
        q = model.step.forward(h, *networks["psi_q"], Q_0)[0].q
        return Read(h, q, *model.prior.forward(h, *networks["psi_p"], (d, 3, 3, 3 * k))[0])

    return smooth


def context_cases():
    def inputs(seed, A, d, k, resolutions, tables, F, hidden):
        rng = np.random.default_rng(seed)
        networks = {
            name: random_network(rng, F * len(tables), *hidden, columns)
            for name, columns in (("psi_q", 4), ("psi_p", 2 * (d + 6 + 3 * k)))
        }
        hi = np.array([1, 0.7, 0.4])
        return dict(
            x_a=rng.uniform(-1, 1, (A, 3)) * hi,
            lo=-hi,
            hi=hi,
            grids=[rng.uniform(-0.9, 0.9, (T, F)) for T in tables],
            resolutions=resolutions,
            Q_0=np.array([1.0, 0.001, 0.002, 0.2]),
            d=d,
            k=k,
            **flat_networks(networks),
        )

    dense = (("xyz", 3), ("xy", 4), ("xz", 4), ("yz", 4))
    yield Case("ordinary", inputs(241, 7, 5, 2, dense, (27, 16, 16, 16), 2, (8,)))
    hashed = (("xyz", 5), ("xyz", 9), ("xy", 7), ("yz", 11))
    yield Case("hashed", inputs(242, 9, 4, 3, hashed, (32, 32, 19, 19), 3, (6, 7)))
    outside = inputs(243, 8, 2, 4, (("xyz", 3), ("xz", 5)), (27, 25), 1, (5,))
    yield Case("outside_the_box", {**outside, "x_a": 1.7 * outside["x_a"]}, ("outside", "clamped"))


# --- noisy attributes -> bits --------------------------------------------------------------------------------------
class Rate(NamedTuple):
    bits: np.ndarray  # ()
    L_rate: np.ndarray  # ()


def rate_forward(noisy, mu, sigma, q, mask, grids, d, k):
    """The rate of everything: likelihood, anchor_rate, hash_rate, rate_loss.

    Shapes     noisy, mu, sigma (A, n), n = d + 6 + 3k: columns f, s, l, O; q (A, 4), mask (A, k), grids [(T, F), ...]
               -> bits, L_rate ()
    Units      bits: bits; L_rate: bits per coded number, of which there are A n
    Domain     sigma, q > 0
    Gradient   noisy, mu, sigma, q, grids (straight through the sign where |parameter| <= 1); 0 for masked offsets
    Choice     Q6: one q for all columns of a group; Q12, Q15
    Reference  P-4DGS Eqs. (11), (13), (14), (17)
    """
    design = SILENT._replace(d=d, k=k)
    out, res = objective.rate_forward(noisy, Context(q, mu, sigma), grids, mask, design)
    return Rate(out.bits, out.L_rate), (res, noisy.size, design)


def rate_backward(res, bits_bar, L_rate_bar):
    inner, count, design = res
    both = L_rate_bar + count * bits_bar  # bits = A n L_rate
    return dict(
        zip(("noisy", "mu", "sigma", "q", "grids"), objective.rate_backward(inner, both, design))
    )


def rate_surrogate(**base):
    """The rate of grids whose signs stay those of `base` and whose price follows the parameters' change."""
    priced, held = hash_rate.surrogate(base["grids"]), hash_rate.forward(base["grids"])[0].R_hash

    def smooth(grids, **others):
        out = rate_forward(grids=base["grids"], **others)[0]
        more = priced(grids=grids).R_hash - held
        return Rate(out.bits + more, out.L_rate + more / others["noisy"].size)

    return smooth


def rate_cases():
    def inputs(seed, A, d, k, spread, tables=((8, 2), (9, 2))):
        rng = np.random.default_rng(seed)
        n = d + 6 + 3 * k
        sigma, mu = rng.lognormal(-1, 0.5, (A, n)), rng.normal(size=(A, n))
        return dict(
            noisy=mu + spread * sigma * rng.normal(size=(A, n)),
            mu=mu,
            sigma=sigma,
            q=rng.uniform(0.1, 0.8, (A, 4)),
            mask=rng.random((A, k)) < 0.7,
            grids=[rng.uniform(-0.5, 0.9, shape) for shape in tables],
            d=d,
            k=k,
        )

    yield Case("ordinary", inputs(251, 6, 4, 5, 1.0))
    yield Case("tails", inputs(252, 5, 3, 2, 30.0), ("tail", "masked"))
    masked = inputs(253, 4, 5, 2, 1.0)
    yield Case("all_masked", {**masked, "mask": np.zeros((4, 2), bool)}, ("masked",))


SUBJECTS_CODING = [
    (
        "hash_grid",
        undeclared(
            "context_stage",
            "8, 9, 12",
            "positions -> h, q, mu, sigma",
            {
                "x_a": "A 3",
                "lo": "3",
                "hi": "3",
                "grids": "*T F",
                "resolutions": "",
                "Q_0": "G",
                "d": "",
                "k": "",
                **shapes_of("psi_q", "psi_p"),
                "h": "A I",
                "q": "A G",
                "mu": "A n",
                "sigma": "A n",
            },
            ("grids", *shapes_of("psi_q", "psi_p")),
            context_forward,
            context_backward,
            context_cases,
            context_surrogate,
        ),
    ),
    (
        "rate_loss",
        undeclared(
            "rate_stage",
            "11, 13, 14, 17",
            "noisy attributes -> bits, L_rate",
            {
                "noisy": "A n",
                "mu": "A n",
                "sigma": "A n",
                "q": "A 4",
                "mask": "A k",
                "grids": "*T F",
                "d": "",
                "k": "",
                "bits": "",
                "L_rate": "",
            },
            ("noisy", "mu", "sigma", "q", "grids"),
            rate_forward,
            rate_backward,
            rate_cases,
            rate_surrogate,
        ),
    ),
]
