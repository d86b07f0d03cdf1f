"""The formulas that the hard cases break, as papers print them or as code usually has them.

Each takes the inputs and cotangents of a case in one precision and returns the number that the
table shows, or the array that holds it.
"""

import numpy as np

from p4dgs_ref.equations import mlp, positional_encoding
from p4dgs_ref.lab.accuracy import formulas


# --- rate and quantiser --------------------------------------------------------------------------
def printed_bits(v):
    """Eq. (11)."""
    return _printed(v)[0]


def printed_gradient(v):
    """The gradient of f_noisy in Eq. (11)."""
    f_slope, _, _ = _printed(v)[1]
    return v["bits_bar"] * f_slope


def _printed(v):
    return formulas.as_printed(v["f_noisy"], v["mu"], v["sigma"], v["q"])


def printed_entropy(v):
    """Eq. (14) of one grid."""
    grid = v["grids"][0]
    n, n_pos = (grid.dtype.type(count) for count in (grid.size, np.count_nonzero(grid >= 0)))
    n_neg = n - n_pos
    return -n_pos * np.log2(n_pos / n) - n_neg * np.log2(n_neg / n)


# --- splatting -----------------------------------------------------------------------------------


def gradient_of_the_mean_alone(v):
    """The gradient of z as if it moved only the mean and the depth, not the covariance."""
    x, y, z = v["x"][0]
    along = v["mean2d_bar"][0] @ (np.array([x, y], v["x"].dtype) * v["focal"])
    return -along / z**2 + v["depth_bar"][0]


def conic_by_determinant(v):
    """The first number of the conic, with a c - b^2 in the given precision."""
    a, b, c = v["Sigma"][0, 0, 0], v["Sigma"][0, 0, 1], v["Sigma"][0, 1, 1]
    blur = v["Sigma"].dtype.type(0.3)
    a, c = a + blur, c + blur
    return c / (a * c - b * b)


def plainly_normalised(v):
    r = v["r"] + v["delta_r"]
    return r[0, 1] / np.sqrt((r**2).sum())


def gradient_without_clamp(v):
    """The gradient of one layer's opacity, as if opacities were not clamped."""
    over_background = (v["color"][0] - v["background"]) * v["image_bar"][0, 0]
    return over_background.sum() - v["transmittance_bar"][0, 0]


def gradient_by_division(v):
    """The gradient of the first opacity, with every T recovered from the last one by division.

    Published kernels do this, so that they need to store only the last transmittance.
    """
    alpha, color = v["alpha"], v["color"]
    T = np.cumprod(1 - alpha)[-1]
    behind = v["background"] * T
    for i in reversed(range(1, len(alpha))):
        T = T / (1 - alpha[i])
        behind = behind + alpha[i] * T * color[i]
    T = T / (1 - alpha[0])
    return (v["image_bar"][0, 0] * (T * color[0] - behind / (1 - alpha[0]))).sum()


def ties_in_reverse(v):
    """The red of a pixel when splats of equal depth are taken last first."""
    T, red = 1.0, 0.0
    for i in [3, 1, 4, 2, 0]:
        red = red + T * v["alpha"][i] * v["color"][i, 0]
        T = T * (1 - v["alpha"][i])
    return red + T * v["background"][0]


# --- prediction, deformation, grid ---------------------------------------------------------------
def plain_distance(v):
    return np.sqrt(((v["x_a"][0] - v["x_c"]) ** 2).sum())


def plain_direction(v):
    return (v["x_a"][0, 0] - v["x_c"][0]) / plain_distance(v)


def gradient_by_projection(v):
    """The first number of (I - d d^T) d_vc_bar / delta_vc."""
    delta = plain_distance(v)
    d, bar = (v["x_a"][0] - v["x_c"]) / delta, v["d_vc_bar"][0]
    return ((bar - d * (d @ bar)) / delta)[0]


def network_on_one_row(v):
    """The first number of psi_d, from E(x) and E(t) written side by side."""
    t = np.full((1, 1), v["t"], v["x"].dtype)
    E_x, _ = positional_encoding.forward(v["x"][:1], v["L_x"])
    E_t, _ = positional_encoding.forward(t, v["L_t"])
    E = np.concatenate([E_x, E_t], axis=1)
    return mlp.forward(E, v["weights"][:-2], v["biases"][:-2])[0][0, 0]


def sine_by_doubling(v):
    """sin 2a = 2 sin a cos a, L - 1 times: the error doubles each time."""
    sine, cosine = np.sin(v["p"][0, 0]), np.cos(v["p"][0, 0])
    for _ in range(v["L"] - 1):
        # NumPy 1 would make float64 of a float32 scalar times 2.
        sine, cosine = (sine + sine) * cosine, cosine * cosine - sine * sine
    return sine


def node_without_clamp(v):
    """Where along x the first anchor would read, counted in nodes."""
    share = (v["x_a"][0, 0] - v["lo"][0]) / (v["hi"][0] - v["lo"][0])
    return float(share * v["resolutions"][0][1])


def plain_sigmoid_slope(v):
    s = 1 / (1 + np.exp(-v["biases"][-1][2]))
    return s * (1 - s)


# --- losses --------------------------------------------------------------------------------------
def ssim_by_moments(v):
    """SSIM with variances as E[x^2] - E[x]^2, in the given precision."""
    x, y = v["image"], v["truth"]
    line = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = (np.outer(line, line) / line.sum() ** 2).astype(x.dtype)[:, :, None]

    def mean(a):
        H, W, _ = a.shape
        padded = np.pad(a, ((5, 5), (5, 5), (0, 0)))
        rows = [[padded[i : i + 11, j : j + 11] for j in range(W)] for i in range(H)]
        return np.array([[(window * around).sum(axis=(0, 1)) for around in row] for row in rows])

    m_x, m_y = mean(x), mean(y)
    v_x, v_y = mean(x * x) - m_x * m_x, mean(y * y) - m_y * m_y
    v_xy = mean(x * y) - m_x * m_y
    C_1, C_2 = x.dtype.type(1e-4), x.dtype.type(9e-4)
    above = (2 * m_x * m_y + C_1) * (2 * v_xy + C_2)
    below = (m_x * m_x + m_y * m_y + C_1) * (v_x + v_y + C_2)
    return (above / below).mean()


def one_minus_ssim(v):
    return 1 - v["image"].dtype.type(ssim_by_moments(v))
