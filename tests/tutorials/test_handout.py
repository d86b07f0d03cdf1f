"""The handout: one page without overlaps, its gradients those of the code.

Each gradient is written once more in NumPy, as the handout prints it, and compared with the
`backward` of its equation on a published case. Of a network, `psi` is the gradient of its output;
its sums over the rows are the gradients of the last biases.
"""

import hashlib
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.text import Text
from scipy.stats import norm

from p4dgs_ref.equations.prior import layout
from p4dgs_ref.oracle import published
from p4dgs_ref.splatting.covariance import rotation_matrix
from p4dgs_ref.table import EQUATIONS
from tests.tutorials.drawn import overlaps
from tutorials.tools import handout

FILE = Path(__file__).resolve().parents[2] / "tutorials" / "handout.pdf"


# --- each gradient as printed: arguments are inputs, outputs and gradients of outputs -------------
def offsets(O_a, l_a, x_bar, **_):
    l = l_a[:, None]
    return {"x_a": x_bar.sum(axis=1), "O_a": x_bar * l, "l_a": (x_bar * O_a).sum(axis=1)}


def view(delta_vc, d_vc, delta_vc_bar, d_vc_bar, **_):
    across = d_vc_bar - d_vc * (d_vc * d_vc_bar).sum(axis=1, keepdims=True)
    return {"x_a": d_vc * delta_vc_bar + across / delta_vc}


def opacity(alpha, alpha_bar, **_):
    return {"psi": alpha_bar * (1 - alpha**2)}


def color(color, color_bar, **_):
    return {"psi": color_bar * color * (1 - color)}


def network(x, weights, biases):
    """The output of a network, and the input of its last layer before and after the ReLU."""
    z = x
    for W, b in zip(weights[:-1], biases):
        z = x @ W + b
        x = np.maximum(0, z)
    return x @ weights[-1] + biases[-1], z, x


def rotation(f_a, delta_vc, d_vc, weights, biases, r, r_bar, **_):
    y = network(np.hstack([f_a, delta_vc, d_vc]), weights, biases)[0].reshape(r.shape)
    length = np.linalg.norm(y, axis=2, keepdims=True)
    return {"psi": (r_bar - r * (r * r_bar).sum(axis=2, keepdims=True)) / length}


def scale(s_a, s, s_bar, **_):
    g = s / s_a[:, None]
    return {"s_a": (s_bar * g).sum(axis=1), "psi": s_bar * s_a[:, None] * g * (1 - g)}


def mlp(x, weights, biases, y_bar, **_):
    _, z, h = network(x, weights, biases)
    return {"W": h.T @ y_bar, "psi": np.hstack([(y_bar @ weights[-1].T) * (z > 0), y_bar])}


def deformation(delta_x_bar, delta_s_bar, delta_r_bar, **_):
    return {"psi": np.hstack([delta_x_bar, delta_s_bar, delta_r_bar])}


def deformed(r, delta_r, r_t, x_t_bar, s_t_bar, r_t_bar, **_):
    across = r_t_bar - r_t * (r_t * r_t_bar).sum(axis=1, keepdims=True)
    turned = across / np.linalg.norm(r + delta_r, axis=1, keepdims=True)
    bars = {"x": x_t_bar, "s": s_t_bar, "r": turned}
    return bars | {f"delta_{name}": bar for name, bar in bars.items()}


def noise(u, f_noisy_bar, **_):
    return {"f": f_noisy_bar, "q": (u * f_noisy_bar).sum(axis=1, keepdims=True)}


def step(h, weights, biases, Q_0, q, q_bar, **_):
    psi_q = network(h, weights, biases)[0]
    return {"psi": q_bar * Q_0 * (1 - np.tanh(psi_q) ** 2) * (q > Q_0 / 1024)}


def hash_grid(x_a, lo, hi, grids, resolutions, h_bar, **_):
    """One level of one cell: its nodes are the corners of the box."""
    corners = np.array([[(j >> axis) & 1 for axis in range(3)] for j in range(8)])
    place = (x_a[:, None] - lo) / (hi - lo)
    w = np.prod(np.where(corners, place, 1 - place), axis=2)  # [anchor, corner]
    return {"grids": [(np.abs(grids[0]) <= 1) * (w.T @ h_bar)]}


def rounding(**_):
    return {}


def likelihood(f_noisy, mu, sigma, q, bits_bar, **_):
    upper, lower = (f_noisy + q / 2 - mu) / sigma, (f_noisy - q / 2 - mu) / sigma
    kappa = -bits_bar / (sigma * (norm.cdf(upper) - norm.cdf(lower)) * np.log(2))
    f_bar = kappa * (norm.pdf(upper) - norm.pdf(lower))
    q_bar = kappa * (norm.pdf(upper) + norm.pdf(lower)) / 2
    sigma_bar = -kappa * (upper * norm.pdf(upper) - lower * norm.pdf(lower))
    return {"f_noisy": f_bar, "mu": -f_bar, "q": q_bar, "sigma": sigma_bar}


def prior(h, weights, biases, widths, sigma, mu_bar, sigma_bar, **_):
    psi_p, (means, logarithms) = network(h, weights, biases)[0], layout(widths)
    psi_bar = np.zeros(psi_p.shape)
    psi_bar[:, means], psi_bar[:, logarithms] = mu_bar, sigma * sigma_bar
    psi_bar[:, logarithms] *= (psi_p[:, logarithms] >= -14) & (psi_p[:, logarithms] <= 6)
    return {"psi": psi_bar}


def anchor_rate(mask, bits_f, bits_s, bits_l, bits_O, R_anchor_bar, **_):
    bits = {"bits_f": bits_f, "bits_s": bits_s, "bits_l": bits_l, "bits_O": bits_O}
    bars = {name: np.full(b.shape, R_anchor_bar) for name, b in bits.items()}
    return bars | {"bits_O": bars["bits_O"] * mask[:, :, None]}


def hash_rate(grids, n_pos, n_neg, R_hash_bar, **_):
    slope = 0.5 * np.log2(n_neg / n_pos) * R_hash_bar
    return {"grids": [(np.abs(grid) <= 1) * slope for grid in grids]}


def total_loss(lambda_rate, L_total_bar, **_):
    return {"L_rate": lambda_rate * L_total_bar, "L_render": L_total_bar}


def render_loss(image, truth, lambda_ssim, L_render_bar, **_):
    by_ssim = EQUATIONS["ssim"].vjp(image=image, truth=truth)[1](ssim_bar=1.0)["image"]
    slope = (1 - lambda_ssim) * np.sign(image - truth) / image.size - lambda_ssim * by_ssim
    return {"image": L_render_bar * slope}


def rate_loss(n_parameters, L_rate_bar, **_):
    return dict.fromkeys(("R_anchor", "R_hash"), L_rate_bar / n_parameters)


def slopes(function, at, h=1e-6):
    """The derivatives of an array by every number of `at`."""
    return [(function(at + h * e) - function(at - h * e)) / (2 * h) for e in np.eye(len(at))]


def covariance(s, r, Sigma_bar, **_):
    R = rotation_matrix(r)
    M_bar = (Sigma_bar + Sigma_bar.transpose(0, 2, 1)) @ (R * s[:, None])
    R_bar = M_bar * s[:, None]
    turns = [slopes(lambda r: rotation_matrix(r[None])[0], row) for row in r]
    return {"s": (M_bar * R).sum(axis=1), "r": np.einsum("nij,nkij->nk", R_bar, turns)}


def projection(x, Sigma, W, T, focal, cov2d_bar, **_):
    def jacobian(x):
        x = W @ x + T
        f_x, f_y = focal / x[2]
        return np.array([[f_x, 0, -f_x * x[0] / x[2]], [0, f_y, -f_y * x[1] / x[2]]]) @ W

    a, b, c = cov2d_bar.T
    bar = np.array([[a, b / 2], [b / 2, c]]).transpose(2, 0, 1)  # b stands for both entries
    V = np.array([jacobian(row) for row in x])
    V_bar = (bar + bar.transpose(0, 2, 1)) @ V @ Sigma
    moves = [slopes(jacobian, row) for row in x]
    x_bar = np.einsum("nij,nkij->nk", V_bar, moves)
    return {"Sigma": V.transpose(0, 2, 1) @ bar @ V, "x": x_bar}


def compositing(alpha, color, background, image_bar, **_):
    """In one pixel, with all splats at its centre."""
    C_bar, behind = image_bar[0, 0], [background]
    T = np.cumprod([1, *1 - alpha])[:-1]
    for a, c in zip(alpha[:0:-1], color[:0:-1]):
        behind.insert(0, a * c + (1 - a) * behind[0])
    return {"color": (alpha * T)[:, None] * C_bar, "alpha": T * ((color - behind) @ C_bar)}


PRINTED = (
    *(offsets, view, opacity, color, rotation, scale, mlp, deformation, deformed, noise, step),
    *(hash_grid, rounding, likelihood, prior, anchor_rate, hash_rate, total_loss, render_loss),
    *(rate_loss, covariance, projection, compositing),
)
CASES = [
    *((printed, "ordinary") for printed in PRINTED if printed not in (hash_grid, compositing)),
    (step, "saturated"),
    (hash_rate, "by_hand"),
    (prior, "clamped"),
    (hash_grid, "own"),
    (compositing, "own"),
]
# Of the printed gradients. Where one changes, change its twin above first.
DIGEST = "a6bdccc254b8"


def own(key):
    """Inputs and cotangents where the published cases do more than the printed formula."""
    rng = np.random.default_rng(1217)
    if key == "hash_grid":
        box = {"lo": -np.ones(3), "hi": np.ones(3), "resolutions": (("xyz", 2),)}
        inputs = {"x_a": rng.uniform(-1, 1, (4, 3)), "grids": [2 * rng.normal(size=(8, 2))]}
        return inputs | box, {"h_bar": rng.normal(size=(4, 2))}
    splats = {"mean2d": np.zeros((3, 2)), "conic": np.ones((3, 3)), "color": rng.random((3, 3))}
    splats |= {"alpha": rng.uniform(0.2, 0.8, 3), "depth": np.arange(3.0)}
    view = {"visible": np.ones(3, bool), "background": rng.random(3), "height": 1, "width": 1}
    return splats | view, {"image_bar": rng.normal(size=(1, 1, 3))}


def flat(a):
    """All numbers of an array or of a list of arrays."""
    return np.concatenate([np.ravel(part) for part in (a if isinstance(a, list) else [a])])


@pytest.mark.parametrize("printed, name", CASES)
def test_gradient_as_printed_is_that_of_the_code(printed, name):
    key, asked = printed.__name__, inspect.signature(printed).parameters
    if name == "own":
        inputs, bars = own(key)
    else:
        (case,) = (case for case in published.cases(key) if case.name == name)
        inputs, bars = case.inputs(), case.cotangents()
    bars = {bar: value if bar in asked else 0 * value for bar, value in bars.items()}
    outputs, pullback = EQUATIONS[key].vjp(**inputs)
    found, wanted = pullback(**bars), printed(**inputs | outputs | bars)
    assert bool(found) == bool(wanted)
    if "psi" in wanted:
        wanted["psi"] = wanted["psi"].reshape(len(wanted["psi"]), -1).sum(axis=0)
        found["psi"] = flat(found["biases"])[-len(wanted["psi"]) :]
        found["W"] = found["weights"][-1]
    for input_name, bar in wanted.items():
        assert np.allclose(flat(found[input_name]), flat(bar), rtol=1e-7, atol=1e-9), input_name


def test_every_row_has_a_twin_that_was_written_for_it():
    keys = dict.fromkeys(row.key for row in handout.ROWS)
    assert list(keys) == [printed.__name__ for printed in PRINTED]
    gradients = "".join(row.gradients for row in handout.ROWS)
    assert hashlib.sha256(gradients.encode()).hexdigest()[:12] == DIGEST


def test_all_equations_of_the_paper_are_on_the_page():
    numbers = [row.number for row in handout.ROWS if row.number]
    assert list(dict.fromkeys(numbers)) == [f"({i})" for i in range(1, 18)]
    for row in handout.ROWS:
        own = EQUATIONS[row.key].number.rstrip("'")
        assert row.number in ("", f"({own})"), row.key


# --- the page -------------------------------------------------------------------------------------
@pytest.mark.slow
def test_texts_are_large_enough_within_the_margins_and_apart():
    figure = handout.draw()
    assert overlaps(figure) == []
    margin = 0.3 * figure.dpi
    for text in [text for text in figure.findobj(Text) if text.get_text()]:
        place = text.get_window_extent().extents
        assert text.get_fontsize() >= handout.SMALLEST
        assert np.all(place[:2] >= margin), text.get_text()
        assert np.all(place[2:] <= figure.bbox.extents[2:] - margin), text.get_text()


def test_file_is_one_small_page():
    data = FILE.read_bytes()
    assert data.startswith(b"%PDF-") and len(data) < 200_000
    assert len(re.findall(rb"/Type /Page\b", data)) == 1
    assert b"/CreationDate" not in data


@pytest.mark.slow
def test_file_is_the_same_in_every_run(tmp_path):
    for name in ("a.pdf", "b.pdf"):
        handout.save(tmp_path / name)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
