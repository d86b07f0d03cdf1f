"""Where the search looks: for every equation, a map from genes in [0, 1) onto its domain.

`decode` turns a row of genes into one input of an equation, so that the input stays within the
domain whatever the search does to the genes. Equal genes become equal numbers: copying a gene makes
ties, coincident points and flat boxes.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from p4dgs_ref.lab.random_inputs import random_field


class Arena(NamedTuple):
    """How to make inputs for one equation."""

    own: int  # genes of one input
    shared: int  # genes of what all rows of one call share, like weights or a camera
    decode: object  # decode(own (n, .), shared (.,), dtype) -> inputs; n = 1 unless `rows`
    rows: bool = True  # each row of a call is an input of its own
    fixed: tuple = ()  # inputs that only decide an order; `search.sizes` does not vary them
    share: float = 1.0  # of the inputs of a search; less where an evaluation takes longer


def number(g, low, high, tiny=0.0):
    """Genes to numbers of either sign from 10^low to 10^high, a few of them 0, -0 or +-`tiny`."""
    t = 2 * np.asarray(g) - 1
    u = np.abs(t)
    size = np.where(
        u < 0.03,
        0.0,
        np.where(u < 0.05, tiny, 10.0 ** (low + (high - low) * np.maximum(u - 0.05, 0) / 0.95)),
    )
    return np.copysign(size, t)


def positive(g, low, high):
    """Genes to numbers from 10^low to 10^high."""
    return 10.0 ** (low + (high - low) * np.asarray(g))


def reach(dtype, double=30, single=9):
    """The largest power of ten for equations that multiply a few numbers."""
    return double if dtype == np.float64 else single


def take(genes, *shapes):
    """Cut rows of genes into arrays (n, *shape), or one row into arrays of these shapes."""
    parts, at, lead = [], 0, genes.shape[:-1]
    for shape in shapes:
        size = int(np.prod(shape))
        parts.append(genes[..., at : at + size].reshape(*lead, *shape))
        at += size
    return parts


def network(genes, dtype, *widths):
    """Weights and biases of a network from a vector of genes: 1e-3 to 1e2, with zeros."""
    pairs = list(zip(widths[:-1], widths[1:]))
    parts = take(number(genes, -3, 2), *pairs, *((n,) for _, n in pairs))
    return dict(weights=parts[: len(pairs)], biases=parts[len(pairs) :])


def genes_of(*widths):
    return sum((a + 1) * b for a, b in zip(widths[:-1], widths[1:]))


# --- the equations, one function each ------------------------------------------------------------
def offsets(own, shared, dtype):
    x_a, O_a, l_a = take(
        number(own, -reach(dtype), reach(dtype), np.finfo(dtype).smallest_subnormal),
        (3,),
        (2, 3),
        (3,),
    )
    return dict(x_a=x_a, O_a=O_a, l_a=l_a)


def view(own, shared, dtype):
    e = reach(dtype, 200, 25)
    most = e * (2 * shared[3] - 1)  # the size of the scene
    return dict(x_a=number(own, -e, most), x_c=number(shared[:3], -e, most))


def _seen(own, shared, dtype, outputs):
    f_a, delta_vc, d_vc = take(own, (2,), (1,), (3,))
    d_vc = 2 * d_vc - 1
    return dict(
        f_a=number(f_a, -4, 4),
        delta_vc=positive(delta_vc, -4, 4),
        d_vc=d_vc / np.maximum(np.linalg.norm(d_vc, axis=1, keepdims=True), 1e-3),
        **network(shared, dtype, 6, 3, outputs),
    )


def scale(own, shared, dtype):
    return dict(
        s_a=number(own[:, :3], -reach(dtype, 12, 4), reach(dtype, 12, 4)),
        **_seen(own[:, 3:], shared, dtype, 6),
    )


def masking(own, shared, dtype):
    alpha, mask, x, color, s, r = take(own, (2,), (2,), (2, 3), (2, 3), (2, 3), (2, 4))
    e = 300 if dtype == np.float64 else 37
    x, color, s, r = (
        number(v, -e, e, np.finfo(dtype).smallest_subnormal) for v in (x, color, s, r)
    )
    return dict(
        alpha=2 * alpha - 1,
        mask=mask > 0.2,
        tau_alpha=float(np.float32(shared[0] - 0.5)),
        x=x,
        color=color,
        s=s,
        r=r,
    )


def positional_encoding(own, shared, dtype):
    return dict(p=number(own, -6, reach(dtype, 12, 4)), L=int(20 * shared[0]))


def deformation(own, shared, dtype):
    field = random_field(np.random.default_rng(int(1e9 * shared[0])), 2, 1, 3, heads=(3, 3, 4))
    gain = number(shared[1], -2, 3)
    return dict(
        x=number(own, -4, 3),
        t=float(np.float32(number(shared[2], -3, 1))),
        **{**field, "weights": [gain * W for W in field["weights"]]},
    )


def deformed(own, shared, dtype):
    e = reach(dtype)
    x, s, delta_x, delta_s, r, delta_r = take(own, *4 * ((3,),), *2 * ((4,),))
    r, delta_r = (number(v, -reach(dtype, 100, 12), reach(dtype, 100, 12)) for v in (r, delta_r))
    return dict(
        **{
            n: number(v, -e, e) for n, v in dict(x=x, s=s, delta_x=delta_x, delta_s=delta_s).items()
        },
        r=r,
        delta_r=delta_r,
    )


def covariance(own, shared, dtype):
    s, r = take(own, (3,), (4,))
    r = number(r, -6, 0)
    norm = np.linalg.norm(r, axis=1, keepdims=True)
    return dict(
        s=number(s, -reach(dtype, 60, 8), reach(dtype, 60, 8)),
        r=np.where(norm > 0, r / np.where(norm > 0, norm, 1), (1, 0, 0, 0)),
    )


def projection(own, shared, dtype):
    """Sigma is L L^T of a triangular L that may be singular; the camera is turned and moved."""
    x, L = take(own, (3,), (3, 3))
    L = np.tril(number(L, -3, 3))
    q = number(shared[:4], -3, 0)
    w, a, b, c = q / np.linalg.norm(q) if q.any() else (1.0, 0.0, 0.0, 0.0)
    W = np.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )
    focal, center, T = (
        positive(shared[4:6], 0, 4),
        number(shared[6:8], 0, 3),
        number(shared[8:11], -3, 2),
    )
    return dict(
        x=number(x, -4, 4),
        Sigma=L @ L.transpose(0, 2, 1),
        W=W,
        T=T,
        focal=focal,
        center=center,
        size=np.array([64.0, 48.0]),
    )


def compositing(own, shared, dtype):
    """Five splats on 3 x 2 pixels: eigenvalues of conics from 1e-6 to 3, opacities up to 1."""
    own = own[0]
    mean, angle, curve, alpha, color, depth, background = take(
        own, (5, 2), (5,), (5, 2), (5,), (5, 3), (5,), (3,)
    )
    c, s, (p, q) = np.cos(7 * angle), np.sin(7 * angle), positive(curve, -6, 0.5).T
    return dict(
        mean2d=number(mean, -2, reach(dtype, 3, 2)),
        conic=np.stack([c * c * p + s * s * q, c * s * (p - q), s * s * p + c * c * q], 1),
        alpha=np.where(alpha > 0.9, 1, np.where(alpha > 0.8, 0.99, alpha)),
        color=number(color, -6, 2),
        depth=np.floor(8 * depth) / 4,
        visible=np.arange(5) < 4.5 * (alpha[0] + 0.2),
        background=number(background, -3, 1),
        height=3,
        width=2,
        occlusion=bool(alpha[1] < 0.8),
    )


def _images(own, size):
    """Two images: random, nearly equal, or one of them flat, as the first two genes say."""
    image, truth = take(own[0, 2:], size, size)
    how, near = own[0, :2]
    image, truth = (
        np.clip(1.2 * image - 0.1, 0, 1),
        np.clip(1.2 * truth - 0.1, 0, 1),
    )  # black and white among them
    if how < 0.5:
        image = np.clip(truth + number(near, -16, -1) * (image - 0.5), 0, 1)
    return dict(image=image, truth=truth if how < 0.75 else 0 * truth + truth[0, 0])


def ssim(own, shared, dtype):
    return _images(own, (3, 4, 1))


def render_loss(own, shared, dtype):
    return dict(**_images(own[:, 1:], (3, 4, 1)), lambda_ssim=float(np.float32(own[0, 0])))


def hash_grid(own, shared, dtype):
    lo, extent, entries = take(shared, (3,), (3,), (2, 8, 1))
    e = reach(dtype)
    lo = number(lo, -3, 3)
    return dict(
        x_a=lo + number(own, -3, 3),
        lo=lo,
        hi=lo + np.abs(number(extent, -3, 3)),
        grids=[number(level, -e, 1, np.finfo(dtype).smallest_subnormal) for level in entries],
        resolutions=(("xyz", 2), ("xz", 5)),
    )


def step(own, shared, dtype):
    return dict(
        h=number(own, -3, 3),
        **network(shared, dtype, 3, 3, 4),
        Q_0=np.array([1.0, 2.0**-10, 2.0**-9, 0.25]),
    )


def prior(own, shared, dtype):
    return dict(h=number(own, -3, 3), **network(shared, dtype, 3, 3, 8), widths=(1, 3))


def noise(own, shared, dtype):
    f, u, q = take(own, (3,), (3,), (1,))
    e = reach(dtype, 100, 18)
    return dict(
        f=number(f, -e, e, np.finfo(dtype).smallest_subnormal), u=u - 0.5, q=positive(q, -e, e)
    )


def rounding(own, shared, dtype):
    """Multiples of half a step, and numbers a few ulp beside them."""
    n, hair, q = take(own, (3,), (3,), (1,))
    q = positive(q, -6, 3).astype(np.float32)
    return dict(
        f=np.rint(number(n, 0, 9)) * 0.5 * q * (1 + np.rint(8 * hair - 4) * np.finfo(dtype).eps),
        q=q,
    )


def likelihood(own, shared, dtype):
    """Up to 1000 sigma away in bins of 1e-12 to 1e6 sigma, some with an edge next to mu."""
    z, w, sigma, mu, hair = np.moveaxis(own.reshape(len(own), 2, 5), 2, 0)
    w, sigma = (
        positive(w, -12, 6),
        positive(sigma, *((-30, 30) if dtype == np.float64 else (-6, 2.6))),
    )
    z = np.where(
        hair < 0.3,
        np.copysign(np.minimum(w / 2, 900), z - 0.5) * (1 + number(z, -12, -1)),
        number(z, -9, 3),
    )
    mu = np.where(hair > 0.5, 0, number(mu, -3, 3) * sigma)
    return dict(f_noisy=mu + np.clip(z, -990, 990) * sigma, mu=mu, sigma=sigma, q=w * sigma)


def anchor_rate(own, shared, dtype):
    f, O, l, s, mask = take(own, (2, 4), (2, 3, 3), (2, 3), (2, 3), (2, 3))
    bits = {
        f"bits_{n}": np.abs(number(v[0], -30, reach(dtype, 30, 30)))
        for n, v in dict(f=f, O=O, l=l, s=s).items()
    }
    return dict(**bits, mask=mask[0] > 0.3)


def hash_rate(own, shared, dtype):
    entries = number(own[0], -30, 1, np.finfo(dtype).smallest_subnormal)
    return dict(grids=[entries[:12].reshape(6, 2), entries[12:].reshape(3, 2)])


def rate_loss(own, shared, dtype):
    R = np.abs(number(own[0, :2], -3, 12))
    return dict(
        R_anchor=R[0],
        R_hash=R[1],
        n_parameters=int(positive(own[0, 2], 0, 9)) if own[0, 2] > 0.1 else 0,
    )


def total_loss(own, shared, dtype):
    a = number(own[0], -9, 9)
    return dict(L_render=a[0], L_rate=a[1], lambda_rate=float(np.float32(np.abs(a[2]))))


def mlp(own, shared, dtype):
    return dict(
        x=number(own, -reach(dtype), reach(dtype), np.finfo(dtype).smallest_subnormal),
        **network(shared, dtype, 4, 3, 3, 2),
    )


ARENAS = {
    "offsets": Arena(12, 0, offsets),
    "view": Arena(3, 4, view),
    "opacity": Arena(6, genes_of(6, 3, 2), partial(_seen, outputs=2)),
    "masking": Arena(30, 1, masking, rows=False, share=0.04),
    "color": Arena(6, genes_of(6, 3, 6), partial(_seen, outputs=6)),
    "rotation": Arena(6, genes_of(6, 3, 8), partial(_seen, outputs=8)),
    "scale": Arena(9, genes_of(6, 3, 6), scale),
    "positional_encoding": Arena(2, 1, positional_encoding),
    "deformation": Arena(3, 3, deformation, share=0.5),
    "deformed": Arena(20, 0, deformed),
    "noise": Arena(7, 0, noise),
    "step": Arena(3, genes_of(3, 3, 4), step),
    "hash_grid": Arena(3, 22, hash_grid, share=0.5),
    "rounding": Arena(7, 0, rounding),
    "likelihood": Arena(10, 0, likelihood, share=0.7),
    "prior": Arena(3, genes_of(3, 3, 8), prior),
    "anchor_rate": Arena(44, 0, anchor_rate, rows=False, share=0.04),
    "hash_rate": Arena(18, 0, hash_rate, rows=False, share=0.04),
    "total_loss": Arena(3, 0, total_loss, rows=False, share=0.04),
    "render_loss": Arena(27, 0, render_loss, rows=False, share=0.04),
    "rate_loss": Arena(3, 0, rate_loss, rows=False, share=0.04),
    "mlp": Arena(4, genes_of(4, 3, 3, 2), mlp),
    "ssim": Arena(26, 0, ssim, rows=False, share=0.04),
    "covariance": Arena(7, 0, covariance),
    "projection": Arena(12, 11, projection),
    "compositing": Arena(53, 0, compositing, rows=False, fixed=("depth",), share=0.04),
}
