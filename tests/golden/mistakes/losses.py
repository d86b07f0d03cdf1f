"""Known mistakes in Eqs. (15) to (17) and in SSIM: what training minimises."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from p4dgs_ref.equations import ssim
from p4dgs_ref.equations.window import RADIUS, blur, to_rows
from p4dgs_ref.table import EQUATIONS
from tests.golden.mistakes.kit import bars_of, known, no_gradient, surgery


# --- Eqs. (15) and (17) -------------------------------------------------------------------------
def weighed(render, rate):
    """L_total = render(lambda) L_render + rate(lambda) L_rate."""

    def run(given, cotangents):
        weights, bar = (
            [f(given["lambda_rate"]) for f in (render, rate)],
            bars_of(cotangents)["L_total"],
        )
        return (
            {"L_total": np.asarray(weights[0] * given["L_render"] + weights[1] * given["L_rate"])},
            {"L_render": np.asarray(weights[0] * bar), "L_rate": np.asarray(weights[1] * bar)},
        )

    return run


def one(_):
    return 1.0


def itself(weight):
    return weight


def rest(weight):
    return 1 - weight


def no_lambda(bars, given):
    return {**bars, "L_rate": bars["L_render"]}


TOTAL_LOSS = [
    surgery(
        "total_loss",
        "total-loss-lambda-exchanged",
        "lambda_rate multiplies L_render instead of L_rate",
        weighed(itself, one),
    ),
    surgery(
        "total_loss",
        "total-loss-convex",
        "L_render is multiplied by 1 - lambda_rate",
        weighed(rest, itself),
    ),
    surgery(
        "total_loss",
        "total-loss-lambda-on-both",
        "lambda_rate multiplies both losses",
        weighed(itself, itself),
    ),
    surgery("total_loss", "total-loss-no-lambda", "lambda_rate is left out", weighed(one, one)),
    known(
        "total_loss",
        "total-loss-gradient",
        "the gradient of L_rate lacks lambda_rate",
        inputs_bar=no_lambda,
    ),
]


def exchanged(tree, *_):
    return {"bits": tree["L_rate"], "L_rate": tree["bits"]}


def shared_out(given, cotangents):
    """R_hash is left undivided in L_rate."""
    n, bars = given["n_parameters"], bars_of(cotangents)
    return (
        {
            "bits": np.asarray(given["R_anchor"] + given["R_hash"]),
            "L_rate": np.asarray(
                (given["R_anchor"] / n if n else 0 * given["R_anchor"]) + given["R_hash"]
            ),
        },
        {
            "R_anchor": np.asarray(bars["bits"] + (bars["L_rate"] / n if n else 0)),
            "R_hash": np.asarray(bars["bits"] + bars["L_rate"]),
        },
    )


RATE_LOSS = [
    known(
        "rate_loss",
        "rate-loss-exchanged",
        "bits and L_rate are exchanged",
        outputs=exchanged,
        outputs_bar=exchanged,
    ),
    known(
        "rate_loss",
        "rate-loss-not-divided",
        "L_rate is the number of bits: it is not divided by the parameters",
        outputs=lambda out, given: {**out, "L_rate": out["bits"]},
        outputs_bar=lambda bars, out, given: {
            "bits": bars["bits"] + bars["L_rate"],
            "L_rate": 0 * bars["L_rate"],
        },
    ),
    known(
        "rate_loss",
        "rate-loss-no-hash",
        "R_hash is left out",
        inputs={"R_hash": np.zeros_like},
        inputs_bar={"R_hash": no_gradient},
    ),
    surgery(
        "rate_loss",
        "rate-loss-hash-not-divided",
        "R_hash is added to L_rate without being divided",
        shared_out,
    ),
    known(
        "rate_loss",
        "rate-loss-bytes",
        "the rate is in bytes instead of bits",
        outputs=lambda out, given: {name: np.asarray(a / 8) for name, a in out.items()},
        outputs_bar=lambda bars, out, given: {name: bar / 8 for name, bar in bars.items()},
    ),
]


# --- Eq. (16) -----------------------------------------------------------------------------------
def blended(
    of_L1=rest,
    of_D=itself,
    D=itself,
    D_slope=one,
    power=1,
    sign=np.sign,
    mean=True,
    root=False,
):
    """L = of_L1(lambda) L1 + of_D(lambda) D(D_SSIM).

    L1 is the mean or the sum of |difference|^power, or the root of that.
    """

    def run(given, cotangents):
        _, pullback = EQUATIONS["ssim"].vjp(image=given["image"], truth=given["truth"])
        right = EQUATIONS["render_loss"](**given)["D_SSIM"]
        difference, lam = given["image"] - given["truth"], given["lambda_ssim"]
        n, bars = difference.size if mean else 1, bars_of(cotangents)
        L1, D_SSIM = (np.abs(difference) ** power).sum() / n, D(right)
        L1_bar = bars["L1"] + of_L1(lam) * bars["L_render"]
        D_bar = (bars["D_SSIM"] + of_D(lam) * bars["L_render"]) * D_slope(right)
        slope = sign(difference) if power == 1 else 2 * difference
        if root:
            L1_bar = L1_bar / (2 * np.sqrt(L1))
            L1 = np.sqrt(L1)
        image_bar = L1_bar / n * slope + pullback(ssim_bar=-float(D_bar))["image"]
        return {"L_render": of_L1(lam) * L1 + of_D(lam) * D_SSIM, "L1": L1, "D_SSIM": D_SSIM}, {
            "image": image_bar
        }

    return run


def half(D):
    return D / 2


def squares_in_the_sum(given, cotangents):
    """L_render has the mean square; the output L1 remains."""
    of_sum = {name: bar * (name != "L1_bar") for name, bar in cotangents.items()}
    of_L1 = {name: bar * (name == "L1_bar") for name, bar in cotangents.items()}
    out, bars = blended(power=2)(given, of_sum)
    plain, plain_bars = blended()(given, of_L1)
    return {**out, "L1": plain["L1"]}, {"image": bars["image"] + plain_bars["image"]}


RENDER_LOSS = [
    surgery(
        "render_loss",
        "render-loss-lambda-exchanged",
        "lambda_ssim and 1 - lambda_ssim are exchanged",
        blended(itself, rest),
    ),
    surgery(
        "render_loss",
        "render-loss-l1-whole",
        "L1 is not multiplied by 1 - lambda_ssim",
        blended(one),
    ),
    surgery(
        "render_loss",
        "render-loss-squares",
        "the mean square for the mean absolute difference",
        blended(power=2),
    ),
    surgery(
        "render_loss",
        "render-loss-sum",
        "L1 is the sum over the pixels instead of the mean",
        blended(mean=False),
    ),
    surgery(
        "render_loss",
        "render-loss-halved",
        "D_SSIM is (1 - SSIM) / 2",
        blended(D=half, D_slope=lambda D: 0.5),
    ),
    surgery(
        "render_loss",
        "render-loss-similarity",
        "SSIM is added instead of 1 - SSIM: likeness is punished",
        blended(D=rest, D_slope=lambda D: -1.0),
    ),
    surgery(
        "render_loss",
        "render-loss-sign-of-zero",
        "where image and truth are equal, L1 has slope 1 instead of 0",
        blended(sign=lambda d: np.where(d >= 0, 1, -1).astype(d.dtype)),
    ),
    surgery(
        "render_loss",
        "render-loss-half-weight",
        "L_render has lambda_ssim (1 - SSIM) / 2",
        blended(of_D=half),
    ),
    surgery(
        "render_loss",
        "render-loss-squares-in-the-sum",
        "L_render has the mean square in place of L1",
        squares_in_the_sum,
    ),
    surgery(
        "render_loss",
        "render-loss-root-mean-square",
        "the root of the mean square for the mean absolute difference",
        blended(power=2, root=True),
    ),
    surgery(
        "render_loss",
        "render-loss-negative-sign-of-zero",
        "where image and truth are equal, L1 has slope -1 instead of 0",
        blended(sign=lambda d: np.where(d > 0, 1, -1).astype(d.dtype)),
    ),
]


# --- SSIM ---------------------------------------------------------------------------------------
SIDE = 2 * RADIUS + 1


def everywhere(shape):
    return np.full((shape[0], 1, shape[2]), 1 / np.prod(shape))


def interior(shape):
    """The mean over pixels whose window lies inside the image; of a smaller image there is none."""
    rows, columns = (np.maximum(n - SIDE + 1, 0) for n in (shape[0], shape[2]))
    share = np.zeros((shape[0], 1, shape[2]))
    share[RADIUS : RADIUS + rows, :, RADIUS : RADIUS + columns] = 1 / np.float64(
        rows * shape[1] * columns
    )
    return share


def box(a):
    """A window of equal weights; zeros around the image."""
    for axis in (0, -1):
        a = uniform_filter1d(a, SIDE, axis=axis, mode="constant")
    return a


def renormalised(a):
    """The window cut at the border and brought back to weight 1."""
    return blur(a) / blur(np.ones_like(a))


def renormalised_adjoint(a):
    return blur(a / blur(np.ones_like(a)))


def similarity(
    window=blur,
    adjoint=None,
    C1=ssim.C1,
    C2=ssim.C2,
    sample=1.0,
    covariance=1.0,
    share=everywhere,
    mix=None,
):
    """`run` of SSIM with something else: window, constants, factors of moments, mean, channels.

    With e = x - y each numerator is its denominator minus a moment of e, as in our own SSIM, so
    that all digits can be compared.
    """

    def run(given, cotangents):
        image, truth = (np.asarray(mix(given[n]) if mix else given[n]) for n in ("image", "truth"))
        x, y = to_rows(image), to_rows(truth)
        e = x - y
        mu_e, mu_y, ee, xx, yy = map(window, (e, y, e * e, x * x, y * y))
        mu_x, var_e = mu_y + mu_e, sample * (ee - mu_e**2)
        d_1, d_2 = mu_x**2 + mu_y**2 + C1, sample * (xx - mu_x**2 + yy - mu_y**2) + C2
        lost_1, lost_2 = mu_e**2 / d_1, (covariance * var_e + (1 - covariance) * (d_2 - C2)) / d_2
        lost, weights = lost_1 + lost_2 - lost_1 * lost_2, share(x.shape)
        bar = -float(bars_of(cotangents)["ssim"]) * weights
        d_2_bar = bar * (1 - lost_1) * (1 - covariance - lost_2) / d_2
        ee_bar, xx_bar = bar * (1 - lost_1) * covariance * sample / d_2, sample * d_2_bar
        mu_bar = 2 * (
            bar * (1 - lost_2) * (mu_e - lost_1 * mu_x) / d_1 - mu_e * ee_bar - mu_x * xx_bar
        )
        back = adjoint or window
        image_bar = (back(mu_bar) + 2 * e * back(ee_bar) + 2 * x * back(xx_bar)).transpose(0, 2, 1)
        if mix:
            image_bar = np.broadcast_to(image_bar / given["image"].shape[2], given["image"].shape)
        mean, dtype = (lost * weights).sum() if weights.any() else np.nan, given["image"].dtype
        return {"ssim": dtype.type(1 - mean)}, {"image": image_bar.astype(dtype)}

    return run


SSIM = [
    surgery(
        "ssim",
        "ssim-valid",
        "only pixels whose window lies inside the image count (valid padding)",
        similarity(share=interior),
    ),
    surgery(
        "ssim",
        "ssim-renormalised",
        "at the border the window is cut and renormalised instead of padded with zeros",
        similarity(renormalised, renormalised_adjoint),
    ),
    surgery("ssim", "ssim-box", "a window of equal weights for the Gaussian one", similarity(box)),
    surgery(
        "ssim",
        "ssim-sample-variance",
        "variances and covariance are divided by 120 instead of 121",
        similarity(sample=SIDE**2 / (SIDE**2 - 1)),
    ),
    surgery(
        "ssim",
        "ssim-constants",
        "C1 and C2 are 0.01 and 0.03 instead of their squares",
        similarity(C1=0.01, C2=0.03),
    ),
    surgery(
        "ssim",
        "ssim-range",
        "C1 and C2 are those of intensities from 0 to 255",
        similarity(C1=ssim.C1 * 255**2, C2=ssim.C2 * 255**2),
    ),
    surgery(
        "ssim", "ssim-covariance", "the covariance lacks its factor 2", similarity(covariance=0.5)
    ),
    surgery(
        "ssim",
        "ssim-gray",
        "the images are compared in gray, the mean of the channels",
        similarity(mix=lambda a: a.mean(axis=2, keepdims=True)),
    ),
    known(
        "ssim",
        "ssim-gradient-sum",
        "the gradient is not divided by the number of pixels: it is that of the sum",
        outputs_bar=lambda bars, out, given: {"ssim": bars["ssim"] * given["image"].size},
    ),
]

MISTAKES = [*SSIM, *RENDER_LOSS, *RATE_LOSS, *TOTAL_LOSS]
