"""D2: a colour that depends on the direction of view, from spherical harmonics.

    color = max(0, 1/2 + sum_k sh_k Y_k(d))

Kerbl et al. 2023 (3DGS). The Y_k are the real spherical harmonics up to degree 3, polynomials of
the unit vector d. `backward` differentiates the polynomials; the length of d is that of Eq. (2).
"""

import numpy as np

C_0 = 0.28209479177387814
C_1 = 0.4886025119029199
C_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C_3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154)


def forward(
    d,  # [N, 3]  directions from the camera to the Gaussians, unit vectors
    sh,  # [N, 3, K]  coefficients of red, green and blue; K is 1, 4, 9 or 16, the degree 0 to 3
):
    """Return color [N, 3] and what `backward` needs."""
    Y, slopes = basis(d, sh.shape[2])
    raw = 0.5 + np.einsum("nck,nk->nc", sh, Y)
    return np.maximum(raw, 0), (sh, Y, slopes, raw)


def backward(saved, color_bar):
    """Gradients of d and sh; at the clamp itself the gradient passes.

    A colour of exactly 0 is black paint that must be able to become brighter.
    """
    sh, Y, slopes, raw = saved
    raw_bar = color_bar * (raw >= 0)
    Y_bar = np.einsum("nck,nc->nk", sh, raw_bar)
    return {
        "d": np.einsum("nk,nik->ni", Y_bar, slopes),
        "sh": raw_bar[:, :, None] * Y[:, None, :],
    }


def basis(d, K):
    """The first K harmonics [N, K] of directions [N, 3], and their slopes [N, 3, K]."""
    x, y, z = d.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    a, b, c = C_2
    e, f, g, h = C_3
    harmonics = [  # Y, then its slopes along x, y and z
        (C_0 * one, zero, zero, zero),
        (-C_1 * y, zero, -C_1 * one, zero),
        (C_1 * z, zero, zero, C_1 * one),
        (-C_1 * x, -C_1 * one, zero, zero),
    ]
    if K > 4:
        harmonics += [
            (a * x * y, a * y, a * x, zero),
            (-a * y * z, zero, -a * z, -a * y),
            (b * (2 * z * z - x * x - y * y), -2 * b * x, -2 * b * y, 4 * b * z),
            (-a * x * z, -a * z, zero, -a * x),
            (c * (x * x - y * y), 2 * c * x, -2 * c * y, zero),
        ]
    if K > 9:
        xx, yy, zz = x * x, y * y, z * z
        harmonics += [
            (-e * y * (3 * xx - yy), -6 * e * x * y, -3 * e * (xx - yy), zero),
            (f * x * y * z, f * y * z, f * x * z, f * x * y),
            (
                -g * y * (4 * zz - xx - yy),
                2 * g * x * y,
                -g * (4 * zz - xx - 3 * yy),
                -8 * g * y * z,
            ),
            (
                h * z * (2 * zz - 3 * xx - 3 * yy),
                -6 * h * x * z,
                -6 * h * y * z,
                3 * h * (2 * zz - xx - yy),
            ),
            (
                -g * x * (4 * zz - xx - yy),
                -g * (4 * zz - 3 * xx - yy),
                2 * g * x * y,
                -8 * g * x * z,
            ),
            (f / 2 * z * (xx - yy), f * x * z, -f * y * z, f / 2 * (xx - yy)),
            (-e * x * (xx - 3 * yy), -3 * e * (xx - yy), 6 * e * x * y, zero),
        ]
    Y, *slopes = (np.stack(column, axis=1) for column in zip(*harmonics[:K]))
    return Y, np.stack(slopes, axis=1)
