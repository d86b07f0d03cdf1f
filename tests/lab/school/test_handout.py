"""The handout: one page without overlaps, up to date, its gradients those of the code.

Each gradient is written once more in NumPy, as the handout prints it, and compared with the
`backward` of its equation. Networks have one layer and one row, so that the gradient of the bias
is that of the network's output.
"""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from p4dgs_ref.splatting.covariance import rotation_matrix
from p4dgs_ref.table import EQUATIONS
from tutorials.tools import handout

FILE = Path(__file__).resolve().parents[3] / "tutorials" / "handout.pdf"
RNG = np.random.default_rng(1217)
K, D = 3, 4  # children and numbers of a feature


def normal(*shape):
    return RNG.standard_normal(shape)


def positive(*shape):
    return RNG.uniform(0.3, 1.5, shape)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def vjp(key, cotangents, **inputs):
    """The outputs of an equation as a tuple, and the gradients of its inputs."""
    outputs, pullback = EQUATIONS[key].vjp(**inputs)
    return tuple(outputs.values()), pullback(**cotangents)


def network(rows, columns):
    """A network of one layer, as arguments."""
    return {"weights": [normal(rows, columns)], "biases": [normal(columns)]}


def anchor(columns):
    """The inputs of an equation of spatial prediction, for one anchor."""
    return {"f_a": normal(1, D), "delta_vc": positive(1, 1), "d_vc": normal(1, 3)} | network(
        D + 4, columns
    )


# --- each gradient as printed ---------------------------------------------------------------------
def check_offsets():
    O_a, l_a, x_bar = normal(5, K, 3), positive(5, 3), normal(5, K, 3)
    _, found = vjp("offsets", {"x_bar": x_bar}, x_a=normal(5, 3), O_a=O_a, l_a=l_a)
    for a in range(5):
        yield found["x_a"][a], sum(x_bar[a, i] for i in range(K))
        yield found["O_a"][a], [x_bar[a, i] * l_a[a] for i in range(K)]
        yield found["l_a"][a], sum(x_bar[a, i] * O_a[a, i] for i in range(K))


def check_view():
    delta_bar, d_bar = normal(1, 1), normal(1, 3)
    bars = {"delta_vc_bar": delta_bar, "d_vc_bar": d_bar}
    (delta, d), found = vjp("view", bars, x_a=normal(1, 3), x_c=normal(3))
    d_times_d_bar = (d * d_bar).sum()
    yield found["x_a"], d * delta_bar + (d_bar - d * d_times_d_bar) / delta


def check_opacity():
    alpha_bar = normal(1, K)
    (alpha,), found = vjp("opacity", {"alpha_bar": alpha_bar}, **anchor(K))
    yield found["biases"][0], (alpha_bar * (1 - alpha**2))[0]


def check_color():
    c_bar = normal(1, K, 3)
    (c,), found = vjp("color", {"color_bar": c_bar}, **anchor(3 * K))
    yield found["biases"][0], (c_bar * c * (1 - c)).ravel()


def check_rotation():
    r_bar, inputs = normal(1, 1, 4), anchor(4)
    (r,), found = vjp("rotation", {"r_bar": r_bar}, **inputs)
    x = np.concatenate([inputs["f_a"], inputs["delta_vc"], inputs["d_vc"]], axis=1)
    length = np.linalg.norm(x @ inputs["weights"][0] + inputs["biases"][0])
    yield found["biases"][0], ((r_bar - r * (r * r_bar).sum()) / length).ravel()


def check_scale():
    s_bar, s_a, inputs = normal(1, K, 3), positive(1, 3), anchor(3 * K)
    (s,), found = vjp("scale", {"s_bar": s_bar}, s_a=s_a, **inputs)
    g = s[0] / s_a
    yield found["s_a"][0], sum(s_bar[0, i] * g[i] for i in range(K))
    yield found["biases"][0], (s_bar[0] * s_a * g * (1 - g)).ravel()


def check_mlp():
    (W_0, W), (b_0, b) = (normal(4, 6), normal(6, 2)), (normal(6), normal(2))
    x, y_bar = normal(5, 4), normal(5, 2)
    _, found = vjp("mlp", {"y_bar": y_bar}, x=x, weights=[W_0, W], biases=[b_0, b])
    z = x @ W_0 + b_0
    h = np.maximum(0, z)
    yield found["weights"][1], h.T @ y_bar
    yield found["biases"][1], y_bar.sum(axis=0)
    yield found["biases"][0], ((y_bar @ W.T) * (z > 0)).sum(axis=0)


def check_deformation():
    heads = [normal(8, width) for width in (3, 3, 4)]
    inputs = {"weights": [normal(12, 8), *heads], "biases": [normal(n) for n in (8, 3, 3, 4)]}
    bars = {name: normal(1, len(inputs["biases"][i])) for i, name in enumerate(("", *"xsr")) if i}
    cotangents = {f"delta_{name}_bar": bar for name, bar in bars.items()}
    _, found = vjp("deformation", cotangents, x=normal(1, 3), t=0.3, L_x=1, L_t=1, **inputs)
    for head_bar, bar in zip(found["biases"][1:], bars.values(), strict=True):
        yield head_bar, bar[0]


def check_deformed():
    x, s, r = normal(1, 3), positive(1, 3), normal(1, 4)
    moves = {"delta_x": normal(1, 3), "delta_s": normal(1, 3), "delta_r": normal(1, 4)}
    x_bar, s_bar, r_bar = normal(1, 3), normal(1, 3), normal(1, 4)
    bars = {"x_t_bar": x_bar, "s_t_bar": s_bar, "r_t_bar": r_bar}
    (_, _, r_t), found = vjp("deformed", bars, x=x, s=s, r=r, **moves)
    turned = (r_bar - r_t * (r_t * r_bar).sum()) / np.linalg.norm(r + moves["delta_r"])
    for name, bar in (("x", x_bar), ("s", s_bar), ("r", turned)):
        yield found[name], bar
        yield found[f"delta_{name}"], bar


def check_noise():
    u, bar = RNG.uniform(-0.5, 0.5, (1, D)), normal(1, D)
    _, found = vjp("noise", {"f_noisy_bar": bar}, f=normal(1, D), u=u, q=positive(1, 1))
    yield found["f"], bar
    yield found["q"], [[sum(u[0, n] * bar[0, n] for n in range(D))]]


def check_step():
    inputs, Q_0, h, q_bar = network(D, 4), positive(4), normal(1, D), normal(1, 4)
    inputs["biases"][0][3] = -30.0  # on the floor
    (q,), found = vjp("step", {"q_bar": q_bar}, h=h, Q_0=Q_0, **inputs)
    psi_q = (h @ inputs["weights"][0] + inputs["biases"][0])[0]
    above = q[0] > Q_0 / 1024
    assert above.tolist() == [True, True, True, False]
    yield found["biases"][0], q_bar[0] * Q_0 * (1 - np.tanh(psi_q) ** 2) * above


def check_hash_grid():
    grids, x_a, h_bar = [2 * normal(8, 2)], RNG.uniform(-1, 1, (4, 3)), normal(4, 2)
    inputs = {"lo": -np.ones(3), "hi": np.ones(3), "resolutions": (("xyz", 2),)}
    (h,), found = vjp("hash_grid", {"h_bar": h_bar}, x_a=x_a, grids=grids, **inputs)
    corners = np.array([[(j >> axis) & 1 for axis in range(3)] for j in range(8)])
    place = (x_a[:, None] + 1) / 2
    w = np.prod(np.where(corners, place, 1 - place), axis=2)  # [anchor, corner]
    assert np.allclose(h, w @ np.where(grids[0] >= 0, 1, -1))
    yield found["grids"][0], (np.abs(grids[0]) <= 1) * (w.T @ h_bar)


def check_rounding():
    _, found = vjp("rounding", {"f_hat_bar": normal(2, D)}, f=normal(2, D), q=positive(2, 1))
    assert found == {}
    yield 0, 0


def likelihood():
    """Inputs, cotangent, gradients, and what both lines of Eq. (11) have in common."""
    f, mu, sigma, q, b_bar = normal(4), normal(4), positive(4), positive(4), normal(4)
    inputs = {"f_noisy": f, "mu": mu, "sigma": sigma, "q": q}
    inputs = {name: a[:, None] for name, a in inputs.items()}
    _, found = vjp("likelihood", {"bits_bar": b_bar[:, None]}, **inputs)
    upper, lower = (f + q / 2 - mu) / sigma, (f - q / 2 - mu) / sigma
    p = norm.cdf(upper) - norm.cdf(lower)
    kappa = -b_bar / (sigma * p * np.log(2))
    return {name: bar[:, 0] for name, bar in found.items()}, upper, lower, kappa


def check_likelihood():
    found, upper, lower, kappa = likelihood()
    yield found["f_noisy"], kappa * (norm.pdf(upper) - norm.pdf(lower))
    yield found["mu"], -found["f_noisy"]
    yield found["q"], kappa * (norm.pdf(upper) + norm.pdf(lower)) / 2


def check_likelihood_by_sigma():
    found, upper, lower, kappa = likelihood()
    yield found["sigma"], -kappa * (upper * norm.pdf(upper) - lower * norm.pdf(lower))


def check_prior():
    inputs, mu_bar, sigma_bar = network(D, 6), normal(1, 3), normal(1, 3)
    inputs["biases"][0][5] = 40.0  # beyond the limit of log sigma
    bars = {"mu_bar": mu_bar, "sigma_bar": sigma_bar}
    (_, sigma), found = vjp("prior", bars, h=normal(1, D), widths=(3,), **inputs)
    yield found["biases"][0], np.concatenate([mu_bar, sigma * sigma_bar * [1, 1, 0]], axis=1)[0]


def check_anchor_rate():
    mask, bar = np.array([[True, False, True]]), np.asarray(1.7)
    bits = {"bits_f": normal(1, D), "bits_s": normal(1, 3), "bits_l": normal(1, 3)}
    inputs = {**bits, "bits_O": normal(1, K, 3), "mask": mask}
    _, found = vjp("anchor_rate", {"R_anchor_bar": bar}, **inputs)
    for name in bits:
        yield found[name], np.full(bits[name].shape, bar)
    yield found["bits_O"], np.broadcast_to(bar * mask[:, :, None], (1, K, 3))


def check_hash_rate():
    grids, bar = [2 * normal(16, 2) + 0.7], np.asarray(0.6)
    (_, n_pos, n_neg), found = vjp("hash_rate", {"R_hash_bar": bar}, grids=grids)
    yield found["grids"][0], (np.abs(grids[0]) <= 1) * 0.5 * np.log2(n_neg / n_pos) * bar


def check_total_loss():
    bar, weight = np.asarray(0.8), 0.004
    inputs = {"L_render": np.asarray(0.1), "L_rate": np.asarray(3.0), "lambda_rate": weight}
    _, found = vjp("total_loss", {"L_total_bar": bar}, **inputs)
    yield found["L_rate"], weight * bar
    yield found["L_render"], bar


def check_render_loss():
    image, truth, weight = positive(12, 13, 3), positive(12, 13, 3), 0.2
    bar = np.asarray(1.3)
    inputs = {"image": image, "truth": truth}
    _, found = vjp("render_loss", {"L_render_bar": bar}, lambda_ssim=weight, **inputs)
    _, by_ssim = vjp("ssim", {"ssim_bar": np.asarray(1.0)}, **inputs)
    sign = np.sign(image - truth)
    yield found["image"], bar * ((1 - weight) * sign / image.size - weight * by_ssim["image"])


def check_rate_loss():
    bar, n = np.asarray(0.9), 14
    inputs = {"R_anchor": np.asarray(80.0), "R_hash": np.asarray(20.0), "n_parameters": n}
    _, found = vjp("rate_loss", {"L_rate_bar": bar}, **inputs)
    yield found["R_anchor"], bar / n
    yield found["R_hash"], bar / n


def check_covariance():
    s, r, Sigma_bar = positive(1, 3), normal(1, 4), normal(1, 3, 3)
    r /= np.linalg.norm(r)
    _, found = vjp("covariance", {"Sigma_bar": Sigma_bar}, s=s, r=r)
    R = rotation_matrix(r)[0]
    M = R * s
    M_bar = (Sigma_bar[0] + Sigma_bar[0].T) @ M
    yield found["s"][0], [sum(M_bar[i, j] * R[i, j] for i in range(3)) for j in range(3)]
    R_bar, h = M_bar * s, 1e-6
    slopes = [
        (rotation_matrix(r + h * e) - rotation_matrix(r - h * e))[0] / (2 * h) for e in np.eye(4)
    ]
    yield found["r"][0], [(R_bar * slope).sum() for slope in slopes]


def check_projection():
    root, x = normal(1, 3, 3), np.array([[0.2, -0.3, 4.0]])
    Sigma, focal = root @ root.transpose(0, 2, 1), np.array([30.0, 40.0])
    camera = {"focal": focal, "center": np.array([8.0, 9.0]), "size": np.array([17, 19])}
    inputs = {"x": x, "W": np.eye(3), "T": np.zeros(3), **camera}
    a, b, c = normal(3)
    _, found = vjp("projection", {"cov2d_bar": np.array([[a, b, c]])}, Sigma=Sigma, **inputs)
    Sigma_2d_bar = np.array([[a, b / 2], [b / 2, c]])  # b stands for both entries
    V = jacobian(x[0], focal)
    yield found["Sigma"][0], V.T @ Sigma_2d_bar @ V
    V_bar = (Sigma_2d_bar + Sigma_2d_bar.T) @ V @ Sigma[0]
    h = 1e-6
    slopes = [
        (jacobian(x[0] + h * e, focal) - jacobian(x[0] - h * e, focal)) / (2 * h) for e in np.eye(3)
    ]
    yield found["x"][0], [(V_bar * slope).sum() for slope in slopes]


def jacobian(x, focal):
    """The slopes of the perspective projection at a point in camera coordinates."""
    f_x, f_y = focal / x[2]
    return np.array([[f_x, 0, -f_x * x[0] / x[2]], [0, f_y, -f_y * x[1] / x[2]]])


def check_compositing():
    alpha, color, background = RNG.uniform(0.2, 0.8, 3), positive(3, 3), positive(3)
    splats = {"mean2d": np.zeros((3, 2)), "conic": np.ones((3, 3)), "alpha": alpha, "color": color}
    view = {"depth": np.arange(3.0), "visible": np.ones(3, bool), "background": background}
    C_bar = normal(3)
    bars = {"image_bar": C_bar.reshape(1, 1, 3)}
    _, found = vjp("compositing", bars, **splats, **view, height=1, width=1)
    T = np.array([1, 1 - alpha[0], (1 - alpha[0]) * (1 - alpha[1])])
    behind = [background]
    for i in (2, 1):
        behind.insert(0, alpha[i] * color[i] + (1 - alpha[i]) * behind[0])
    for i in range(3):
        yield found["color"][i], alpha[i] * T[i] * C_bar
        yield found["alpha"][i], T[i] * (color[i] - behind[i]) @ C_bar


CHECKS = (
    check_offsets,
    check_view,
    check_opacity,
    check_color,
    check_rotation,
    check_scale,
    check_mlp,
    check_deformation,
    check_deformed,
    check_noise,
    check_step,
    check_hash_grid,
    check_rounding,
    check_likelihood,
    check_likelihood_by_sigma,
    check_prior,
    check_anchor_rate,
    check_hash_rate,
    check_total_loss,
    check_render_loss,
    check_rate_loss,
    check_covariance,
    check_projection,
    check_compositing,
)
# Of the printed gradients. Where one changes, change its check above first.
PRINTED = "a6bdccc254b8"


@pytest.mark.parametrize("check", CHECKS)
def test_gradient_as_printed_is_that_of_the_code(check):
    for found, printed in check():
        assert np.allclose(found, printed, rtol=1e-7, atol=1e-9)


def test_every_row_has_a_check_that_was_written_for_it():
    assert [row.key for row in handout.ROWS] == [
        check.__name__.removeprefix("check_").removesuffix("_by_sigma") for check in CHECKS
    ]
    printed = "".join(row.gradients for row in handout.ROWS)
    assert hashlib.sha256(printed.encode()).hexdigest()[:12] == PRINTED


def test_all_equations_of_the_paper_are_on_the_page():
    numbers = [row.number for row in handout.ROWS if row.number]
    assert list(dict.fromkeys(numbers)) == [f"({i})" for i in range(1, 18)]
    for row in handout.ROWS:
        own = EQUATIONS[row.key].number.rstrip("'")
        assert row.number in ("", f"({own})"), row.key


# --- the page -------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def texts():
    """The texts of the page with their extents in pixels, and the page's."""
    figure = handout.draw()
    figure.canvas.draw()
    written = [*figure.texts, *figure.axes[0].texts]
    return figure, {t: t.get_window_extent().extents for t in written if t.get_text()}


@pytest.mark.slow
def test_texts_are_large_enough_within_the_margins_and_apart(texts):
    figure, places = texts
    page = figure.bbox.extents
    margin = 0.3 * figure.dpi
    named = list(places.items())
    for i, (text, place) in enumerate(named):
        assert text.get_fontsize() >= handout.SMALLEST
        assert np.all(place[:2] >= margin), text.get_text()
        assert np.all(place[2:] <= page[2:] - margin), text.get_text()
        for other, its_place in named[i + 1 :]:
            gap = max(np.max(place[:2] - its_place[2:]), np.max(its_place[:2] - place[2:]))
            assert gap >= -2, (text.get_text(), other.get_text())  # extents exceed the ink


def test_file_is_one_page_made_from_the_sources_of_today():
    data = FILE.read_bytes()
    assert data.startswith(b"%PDF-") and len(data) < 200_000
    assert len(re.findall(rb"/Type /Page\b", data)) == 1
    assert handout.fingerprint().encode() in data
    assert b"/CreationDate" not in data


@pytest.mark.slow
def test_file_is_the_same_in_every_run(tmp_path):
    for name in ("a.pdf", "b.pdf"):
        handout.save(tmp_path / name)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
