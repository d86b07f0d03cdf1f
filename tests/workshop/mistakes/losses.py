"""Known mistakes in Eqs. (15) to (17) and in SSIM: what training minimises."""

import numpy as np

from tests.workshop.mistakes.kit import edited, known, no_gradient, surgery

# --- Eqs. (15) and (17) -------------------------------------------------------------------------


TOTAL_LOSS = [
    edited(
        "total_loss",
        "total-loss-lambda-exchanged",
        "lambda_rate multiplies L_render instead of L_rate",
        {
            "weight * L_rate + L_render": "L_rate + weight * L_render",
            '"L_render": L_total_bar, "L_rate": weight * L_total_bar': (
                '"L_render": weight * L_total_bar, "L_rate": L_total_bar'
            ),
        },
    ),
    edited(
        "total_loss",
        "total-loss-convex",
        "L_render is multiplied by 1 - lambda_rate",
        {
            "weight * L_rate + L_render": "weight * L_rate + (1 - weight) * L_render",
            '"L_render": L_total_bar': '"L_render": (1 - weight) * L_total_bar',
        },
    ),
    edited(
        "total_loss",
        "total-loss-lambda-on-both",
        "lambda_rate multiplies both losses",
        {
            "weight * L_rate + L_render": "weight * (L_rate + L_render)",
            '"L_render": L_total_bar': '"L_render": weight * L_total_bar',
        },
    ),
    edited(
        "total_loss",
        "total-loss-no-lambda",
        "lambda_rate is left out",
        {"weight * L_rate + L_render": "L_rate + L_render", "weight * L_total_bar": "L_total_bar"},
    ),
    edited(
        "total_loss",
        "total-loss-gradient",
        "the gradient of L_rate lacks lambda_rate",
        {"weight * L_total_bar": "L_total_bar"},
    ),
]


def exchanged(tree, *_):
    return {"bits": tree["L_rate"], "L_rate": tree["bits"]}


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
    edited(
        "rate_loss",
        "rate-loss-hash-not-divided",
        "R_hash is added to L_rate without being divided",
        {
            "L_rate = bits / count if count else count * bits": (
                "L_rate = (R_anchor / count if count else count * R_anchor) + R_hash"
            ),
            '"R_hash": bar': '"R_hash": bits_bar + L_rate_bar',
        },
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


RENDER_LOSS = [
    edited(
        "render_loss",
        "render-loss-lambda-exchanged",
        "lambda_ssim and 1 - lambda_ssim are exchanged",
        {
            "precision(1 - lambda_ssim) * L1": "precision(lambda_ssim) * L1",
            "precision(lambda_ssim) * D_SSIM": "precision(1 - lambda_ssim) * D_SSIM",
            "(1 - lambda_ssim) * L_render_bar": "lambda_ssim * L_render_bar",
            "D_SSIM_bar + lambda_ssim * L_render_bar": (
                "D_SSIM_bar + (1 - lambda_ssim) * L_render_bar"
            ),
        },
    ),
    edited(
        "render_loss",
        "render-loss-l1-whole",
        "L1 is not multiplied by 1 - lambda_ssim",
        {
            "precision(1 - lambda_ssim) * L1": "L1",
            "(1 - lambda_ssim) * L_render_bar": "L_render_bar",
        },
    ),
    edited(
        "render_loss",
        "render-loss-squares",
        "the mean square for the mean absolute difference",
        {
            "np.abs(difference).mean": "np.square(difference).mean",
            "(np.sign(difference), lambda_ssim": "(2 * difference, lambda_ssim",
        },
    ),
    edited(
        "render_loss",
        "render-loss-sum",
        "L1 is the sum over the pixels instead of the mean",
        {
            "np.abs(difference).mean": "np.abs(difference).sum",
            "L1_bar / slope.size * slope": "L1_bar * slope",
        },
    ),
    edited(
        "render_loss",
        "render-loss-halved",
        "D_SSIM is (1 - SSIM) / 2",
        {
            "D_SSIM = precision(D_SSIM)": "D_SSIM = precision(D_SSIM / 2)",
            "-D_SSIM_bar)": "-D_SSIM_bar / 2)",
        },
    ),
    edited(
        "render_loss",
        "render-loss-similarity",
        "SSIM is added instead of 1 - SSIM: likeness is punished",
        {
            "D_SSIM = precision(D_SSIM)": "D_SSIM = precision(1 - D_SSIM)",
            "-D_SSIM_bar)": "D_SSIM_bar)",
        },
    ),
    edited(
        "render_loss",
        "render-loss-sign-of-zero",
        "where image and truth are equal, L1 has slope 1, not the convention 0 of all kinks here",
        {
            "(np.sign(difference), lambda_ssim": (
                "(np.where(difference >= 0, 1, -1).astype(image.dtype), lambda_ssim"
            ),
        },
    ),
    edited(
        "render_loss",
        "render-loss-half-weight",
        "L_render has lambda_ssim (1 - SSIM) / 2",
        {
            "precision(lambda_ssim) * D_SSIM": "precision(lambda_ssim / 2) * D_SSIM",
            "D_SSIM_bar + lambda_ssim * L_render_bar": (
                "D_SSIM_bar + lambda_ssim / 2 * L_render_bar"
            ),
        },
    ),
    edited(
        "render_loss",
        "render-loss-squares-in-the-sum",
        "L_render has the mean square in place of L1",
        {
            "precision(1 - lambda_ssim) * L1": (
                "precision(1 - lambda_ssim) * "
                "precision(np.square(difference).mean(dtype=np.float64))"
            ),
            "(np.sign(difference), lambda_ssim": (
                "((np.sign(difference), 2 * difference), lambda_ssim"
            ),
            "slope, lambda_ssim, saved_ssim = saved": (
                "(slope, twice), lambda_ssim, saved_ssim = saved"
            ),
            "L1_bar = float(L1_bar + (1 - lambda_ssim) * L_render_bar)": (
                "L1_bar, square_bar = float(L1_bar), float((1 - lambda_ssim) * L_render_bar)"
            ),
            "L1_bar / slope.size * slope": "(L1_bar * slope + square_bar * twice) / slope.size",
        },
    ),
    edited(
        "render_loss",
        "render-loss-root-mean-square",
        "the root of the mean square for the mean absolute difference",
        {
            "np.abs(difference).mean(dtype=np.float64)": (
                "np.sqrt(np.square(difference).mean(dtype=np.float64))"
            ),
            "(np.sign(difference), lambda_ssim": "(difference / L1, lambda_ssim",
        },
    ),
    edited(
        "render_loss",
        "render-loss-negative-sign-of-zero",
        "where image and truth are equal, L1 has slope -1, not the convention 0 of all kinks here",
        {
            "(np.sign(difference), lambda_ssim": (
                "(np.where(difference > 0, 1, -1).astype(image.dtype), lambda_ssim"
            ),
        },
    ),
]


# --- SSIM ---------------------------------------------------------------------------------------


def padded(mode):
    """`run` for images that np.pad continues; the windows whose centres lie in the image count."""

    def run(given, cotangents):
        height, width, _ = given["image"].shape
        places = np.pad(np.arange(height * width).reshape(height, width), 5, mode=mode)
        wide = {name: a.reshape(height * width, -1)[places] for name, a in given.items()}
        out, bars = VALID.run(wide, cotangents)
        image_bar = np.zeros_like(given["image"]).reshape(height * width, -1)
        np.add.at(image_bar, places, bars["image"])
        return out, {"image": image_bar.reshape(given["image"].shape)}

    return run


VALID = edited(
    "ssim",
    "ssim-valid",
    "only pixels whose window lies inside the image count (valid padding)",
    {
        "np.mean(luminance + structure - luminance * structure)": (
            "np.mean((luminance + structure - luminance * "
            "structure)[blur(np.ones_like(x)) > 1 - 1e-9])"
        ),
        "share = ssim_bar / x.size": (
            "share = ssim_bar * (inside := blur(np.ones_like(x)) > 1 - 1e-9) / max(inside.sum(), 1)"
        ),
    },
)
SSIM = [
    VALID,
    surgery(
        "ssim",
        "ssim-reflect",
        "at the border the images are continued by their mirror (reflect padding), not by zeros",
        padded("reflect"),
    ),
    edited(
        "ssim",
        "ssim-renormalised",
        "at the border the window is cut and renormalised instead of padded with zeros",
        {
            "mu_y, square_y = blur(np.stack([y, y * y], axis=1)).swapaxes(0, 1)": (
                "edge = blur(np.ones_like(y))"
            ),
            (
                "mu_e, square_e, square_x = blur(np.stack([e, e * e, x * x], "
                "axis=1)).swapaxes(0, 1)"
            ): (
                "mu_e, square_e, square_x, mu_y, square_y = blur(np.stack([e, e * e, x * x, "
                "y, y * y], axis=1)).swapaxes(0, 1) / edge"
            ),
            "blur(np.stack([mu_bar, square_e_bar, square_x_bar], axis=1))": (
                "blur(np.stack([mu_bar, square_e_bar, square_x_bar], axis=1) / "
                "blur(np.ones_like(x))[:, None])"
            ),
        },
    ),
    edited(
        "ssim",
        "ssim-box",
        "a window of equal weights for the Gaussian one",
        {"_tap / _tap.sum()": "np.full(11, 1 / 11)"},
        helper="p4dgs_ref.equations.window",
    ),
    edited(
        "ssim",
        "ssim-sample-variance",
        "variances and covariance are divided by 120 instead of 121",
        {
            "square_x - mu_x * mu_x + (square_y - mu_y * mu_y) + C2": (
                "(square_x - mu_x * mu_x + square_y - mu_y * mu_y) * 121 / 120 + C2"
            ),
            "structure = (square_e - mu_e * mu_e) / D2": (
                "structure = (square_e - mu_e * mu_e) * 121 / 120 / D2"
            ),
            "-share * (1 - luminance) / D2": "-share * (1 - luminance) * 121 / 120 / D2",
        },
    ),
    edited(
        "ssim",
        "ssim-constants",
        "C1 and C2 are 0.01 and 0.03 instead of their squares",
        {"C1, C2 = 0.01**2, 0.03**2": "C1, C2 = 0.01, 0.03"},
    ),
    edited(
        "ssim",
        "ssim-range",
        "C1 and C2 are those of intensities from 0 to 255",
        {"C1, C2 = 0.01**2, 0.03**2": "C1, C2 = 2.55**2, 7.65**2"},
    ),
    edited(
        "ssim",
        "ssim-covariance",
        "the covariance lacks its factor 2",
        {
            "structure = (square_e - mu_e * mu_e) / D2": (
                "structure = (square_e - mu_e * mu_e + D2 - C2) / (2 * D2)"
            ),
            "-share * (1 - luminance) / D2": "-share * (1 - luminance) / (2 * D2)",
            "-structure * square_e_bar": "(1 - 2 * structure) * square_e_bar",
            "mu_bar += 2 * square_e_bar * (structure * mu_x - mu_e)": (
                "mu_bar -= 2 * (square_e_bar * mu_e + square_x_bar * mu_x)"
            ),
        },
    ),
    edited(
        "ssim",
        "ssim-gray",
        "the images are compared in gray, the mean of the channels",
        {
            "y = to_rows(truth)": "y = to_rows(truth.mean(axis=2, keepdims=True))",
            "x = to_rows(image)": "x = to_rows(image.mean(axis=2, keepdims=True))",
            "D2, image.dtype)": "D2, image)",
            "structure, D1, D2, dtype = saved": "structure, D1, D2, image = saved",
            'image_bar.transpose(0, 2, 1).astype(dtype, order="C")': (
                "np.broadcast_to(image_bar.transpose(0, 2, 1) / image.shape[2], "
                "image.shape).astype(image.dtype)"
            ),
        },
    ),
    known(
        "ssim",
        "ssim-gradient-sum",
        "the gradient is not divided by the number of pixels: it is that of the sum",
        outputs_bar=lambda bars, out, given: {"ssim": bars["ssim"] * given["image"].size},
    ),
]

MISTAKES = [*SSIM, *RENDER_LOSS, *RATE_LOSS, *TOTAL_LOSS]
