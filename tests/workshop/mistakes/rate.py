"""Known mistakes in Eqs. (7), (8) and (10) to (13): noise, steps, rounding, the cost of values."""

import math

import numpy as np
from scipy.special import ndtr

from tests.workshop.mistakes.kit import (
    NotApplicable,
    bars_of,
    edited,
    given_as,
    known,
    last_columns,
    no_gradient,
    surgery,
    without,
)

LOG_2 = math.log(2)
PHI_0 = 1 / math.sqrt(2 * math.pi)  # density of the standard Gaussian at its mean

# Text of the equations that several mistakes replace.
SIGMA = "np.exp(np.clip(raw, RAW_MIN, RAW_MAX))"
SIGMA_BAR = "sigma_bar * sigma * free"
RINT = "np.rint(np.divide(f, q, dtype=np.float64))"
FLOORED = "np.where(share > SMALLEST, 4 * Q_0 * sigmoid_slope(2 * psi_q), 0)"


# --- Eq. (7) ------------------------------------------------------------------------------------
NOISE = [
    known(
        "noise",
        "noise-without-step",
        "the noise is added without the factor q",
        inputs={"q": np.ones_like},
        inputs_bar={"q": no_gradient},
    ),
    known(
        "noise",
        "noise-not-centred",
        "the noise lies in [0, 1) instead of [-1/2, 1/2)",
        inputs={"u": lambda u: u + u.dtype.type(0.5)},
    ),
    known(
        "noise",
        "noise-twice-as-wide",
        "the noise lies in [-1, 1) instead of [-1/2, 1/2)",
        inputs={"u": lambda u: 2 * u},
    ),
    known(
        "noise",
        "noise-half-as-wide",
        "the noise lies in [-1/4, 1/4) instead of [-1/2, 1/2)",
        inputs={"u": lambda u: u / 2},
    ),
    known(
        "noise",
        "noise-no-gradient-of-step",
        "no gradient flows to q",
        inputs_bar={"q": no_gradient},
    ),
    known(
        "noise",
        "noise-mean-gradient",
        "the gradient of q is the mean over the channels instead of the sum",
        inputs_bar=lambda bars, given: {**bars, "q": bars["q"] / given["f"].shape[1]},
    ),
]


# --- Eq. (8) ------------------------------------------------------------------------------------


def columns_of_groups(given):
    if len(given["Q_0"]) != 4:
        raise NotApplicable("other groups than f, s, l, O")
    return np.array([0, 2, 1, 3])


def plain_Q_0(given):
    return {**given, "Q_0": np.ones_like(given["Q_0"])}


STEP = [
    edited(
        "step",
        "step-no-one",
        "q = Q_0 tanh(psi_q): the 1 + is missing",
        {
            "share = 2 * sigmoid(2 * psi_q)": "share = np.tanh(psi_q)",
            "np.maximum(share, SMALLEST)": "share",
            FLOORED: "Q_0 * (1 - share**2)",
        },
    ),
    edited(
        "step",
        "step-no-one-but-a-floor",
        "q = Q_0 tanh(psi_q), above the floor: the 1 + is missing",
        {
            "share = 2 * sigmoid(2 * psi_q)": "share = np.tanh(psi_q)",
            FLOORED: "np.where(share > SMALLEST, Q_0 * (1 - share**2), 0)",
        },
    ),
    edited(
        "step",
        "step-half-argument",
        "q = 2 Q_0 sigmoid(psi_q): the sigmoid of 2 psi_q is meant",
        {
            "share = 2 * sigmoid(2 * psi_q)": "share = 2 * sigmoid(psi_q)",
            "4 * Q_0 * sigmoid_slope(2 * psi_q)": "2 * Q_0 * sigmoid_slope(psi_q)",
        },
    ),
    edited(
        "step",
        "step-exp",
        "q = Q_0 exp(psi_q)",
        {
            "share = 2 * sigmoid(2 * psi_q)": "share = np.exp(psi_q)",
            "np.maximum(share, SMALLEST)": "share",
            FLOORED: "Q_0 * share",
        },
    ),
    edited(
        "step",
        "step-no-floor",
        "q has no floor: it vanishes where tanh is -1",
        {"np.maximum(share, SMALLEST)": "share", FLOORED: "4 * Q_0 * sigmoid_slope(2 * psi_q)"},
    ),
    edited(
        "step",
        "step-floor-gradient",
        "the floor of q lets the gradient through",
        {FLOORED: "4 * Q_0 * sigmoid_slope(2 * psi_q)"},
    ),
    edited(
        "step",
        "step-half-slope",
        "the slope lacks the inner factor 2 of sigmoid(2 psi_q)",
        {"4 * Q_0": "2 * Q_0"},
    ),
    known("step", "step-no-base", "the base step Q_0 is left out", inputs=plain_Q_0),
    known(
        "step",
        "step-groups",
        "psi_q's outputs are read as f, l, s, O: the steps of s and l are exchanged",
        **last_columns(columns_of_groups),
    ),
]


# --- Eq. (10) -----------------------------------------------------------------------------------


ROUNDING = [
    edited(
        "rounding",
        "rounding-half-away",
        "ties are rounded away from zero instead of to even",
        {
            RINT: (
                "np.trunc(r := np.divide(f, q, dtype=np.float64)) + np.trunc(2 * (r - np.trunc(r)))"
            )
        },
    ),
    edited(
        "rounding",
        "rounding-half-up",
        "ties are rounded up instead of to even",
        {RINT: "np.floor(r := np.divide(f, q, dtype=np.float64)) + (r - np.floor(r) >= 0.5)"},
    ),
    edited(
        "rounding",
        "rounding-floor",
        "floor for round",
        {RINT: "np.floor(np.divide(f, q, dtype=np.float64))"},
    ),
    edited(
        "rounding",
        "rounding-truncate",
        "truncation towards zero for round",
        {RINT: "np.trunc(np.divide(f, q, dtype=np.float64))"},
    ),
    edited(
        "rounding",
        "rounding-half-step-up",
        "f_hat is half a step too high: (symbol + 1/2) q",
        {"(symbols * q.astype(np.float64))": "((symbols + 0.5) * q.astype(np.float64))"},
    ),
    edited(
        "rounding",
        "rounding-float32",
        "f / q is divided in float32",
        {RINT: "np.rint(f.astype(np.float32) / q.astype(np.float32))"},
    ),
    edited(
        "rounding",
        "rounding-symbols-for-values",
        "f_hat is the symbol itself: it is not multiplied by q",
        {"(symbols * q.astype(np.float64)).astype(f.dtype)": "symbols.astype(f.dtype)"},
    ),
]


# --- Eq. (11) -----------------------------------------------------------------------------------
# The cases in which `printed` gives other digits with ndtr, with erfc and with erf.
ROUNDED = (
    *("tail", "narrow", "tail_of_narrow_bins", "nearly_narrow"),
    *("H-R1.6sigma", "H-R1.9sigma", "H-R1.20sigma", "H-R2.6sigma", "H-R2.9sigma", "H-R2.20sigma"),
    *("H-R5.width1e-12", "H-R5.width1e-09", "H-R5.width1e-06", "H-R5.width0.001", "H-R5.width10"),
)


def printed(given, cotangents):
    """The difference of the two values as printed, which cancels in the tails."""
    f, mu, sigma, q = (given[name] for name in ("f_noisy", "mu", "sigma", "q"))
    up, down = (f + q / 2 - mu) / sigma, (f - q / 2 - mu) / sigma
    p = ndtr(up) - ndtr(down)
    at_up, at_down = (PHI_0 * np.exp(-0.5 * edge * edge) for edge in (up, down))
    slope_z, slope_w = (at_up - at_down) / p, (at_up + at_down) / (2 * p)
    bar = -bars_of(cotangents)["bits"] / (LOG_2 * sigma)
    return {"bits": -np.log2(p)}, {
        "f_noisy": bar * slope_z,
        "mu": -bar * slope_z,
        "q": bar * slope_w,
        "sigma": -bar * ((f - mu) / sigma * slope_z + q / sigma * slope_w),
    }


def mass_at_least(floor):
    """The bits of a mass with a lower bound, and no gradient beyond it."""
    most = -math.log2(floor)
    return dict(
        outputs={"bits": lambda bits: np.minimum(bits, bits.dtype.type(most))},
        outputs_bar={"bits": lambda bar, bits: np.where(bits <= most, bar, 0)},
    )


LIKELIHOOD = [
    known(
        "likelihood",
        "likelihood-least-sigma",
        "sigma is at least 0.11, as in entropy-model libraries whose symbols are integers",
        inputs={"sigma": lambda sigma: np.maximum(sigma, sigma.dtype.type(0.11))},
        inputs_bar={"sigma": lambda bar, sigma: np.where(sigma >= 0.11, bar, 0)},
    ),
    known(
        "likelihood",
        "likelihood-least-mass",
        "the mass is at least 1e-9, as in entropy-model libraries: at most 29.9 bits",
        **mass_at_least(1e-9),
    ),
    known(
        "likelihood",
        "likelihood-mass-plus",
        "1e-10 is added to the mass before the logarithm",
        outputs={"bits": lambda bits: -np.log2(np.exp2(-bits) + bits.dtype.type(1e-10))},
        outputs_bar={"bits": lambda bar, bits: bar / (1 + 1e-10 * np.exp2(bits))},
    )._replace(noisy=("H-R5.width10",)),
    known(
        "likelihood",
        "likelihood-sigma-plus",
        "1e-6 is added to sigma",
        inputs={"sigma": lambda sigma: sigma + sigma.dtype.type(1e-6)},
    ),
    known(
        "likelihood",
        "likelihood-bin-from-f",
        "the bin reaches from f to f + q instead of from f - q/2 to f + q/2",
        inputs=lambda given: {**given, "f_noisy": given["f_noisy"] + given["q"] / 2},
        inputs_bar=lambda bars, given: {**bars, "q": bars["q"] + bars["f_noisy"] / 2},
    ),
    known(
        "likelihood",
        "likelihood-nats",
        "the bits are nats: the natural logarithm for that to base 2",
        outputs={"bits": lambda bits: bits * LOG_2},
        outputs_bar={"bits": lambda bar, _: bar * LOG_2},
    ),
    known(
        "likelihood",
        "likelihood-variance",
        "sigma is taken for a variance: its root divides",
        inputs={"sigma": np.sqrt},
        inputs_bar={"sigma": lambda bar, sigma: bar / (2 * np.sqrt(sigma))},
    ),
    known(
        "likelihood",
        "likelihood-whole-step",
        "the bin reaches from f - q to f + q: the half before q is missing",
        inputs={"q": lambda q: 2 * q},
        inputs_bar={"q": lambda bar, _: 2 * bar},
    ),
    known("likelihood", "likelihood-no-mean", "mu is left out", **without("mu")),
    known(
        "likelihood",
        "likelihood-erf",
        "Phi(x) is taken as (1 + erf(x)) / 2: the root of 2 is missing",
        inputs={"sigma": lambda sigma: sigma * math.sqrt(0.5)},
        inputs_bar={"sigma": lambda bar, _: bar * math.sqrt(0.5)},
    ),
    known(
        "likelihood",
        "likelihood-floor",
        "the mass has HAC's floor of 1e-6: at most 19.93 bits, no gradient beyond",
        **mass_at_least(1e-6),
    ),
    surgery(
        "likelihood",
        "likelihood-literal",
        "the printed difference of two values near one: no digits in the tails",
        printed,
    )._replace(noisy=ROUNDED),
    edited(
        "likelihood",
        "likelihood-density",
        "the density at f times q for the mass of the bin",
        {
            "TO_BITS * log_p, *slopes(offset, sigma, low, high, z, w, ratio)": (
                "TO_BITS * (np.log(w * PHI_0) - z * z / 2), *(TO_BITS * a for a in (-offset "
                "/ sigma**2, (z * z - 1) / sigma, 1 / q))"
            )
        },
    ),
    known(
        "likelihood",
        "likelihood-mean-gradient",
        "the gradient of mu has the sign of that of f",
        inputs_bar={"mu": lambda bar, _: -bar},
    ),
    known(
        "likelihood",
        "likelihood-no-gradient-of-step",
        "no gradient flows to q",
        inputs_bar={"q": no_gradient},
    ),
    known(
        "likelihood",
        "likelihood-no-gradient-of-sigma",
        "no gradient flows to sigma",
        inputs_bar={"sigma": no_gradient},
    ),
]


# --- Eq. (12) -----------------------------------------------------------------------------------


def exchange(tree, given):
    """The groups s and l exchanged."""
    widths = given["widths"]
    if len(widths) != 4 or widths[1] != widths[2]:
        raise NotApplicable("other groups than f, s, l, O")
    f, s, l, O = np.split(np.arange(sum(widths)), np.cumsum(widths[:-1]))
    return {name: a[:, np.concatenate([f, l, s, O])] for name, a in tree.items()}


PRIOR = [
    edited(
        "prior",
        "prior-not-exponentiated",
        "sigma is the raw output: exp is missing",
        {SIGMA: "np.clip(raw, RAW_MIN, RAW_MAX)", SIGMA_BAR: "sigma_bar * free"},
    ),
    edited(
        "prior",
        "prior-power-of-two",
        "sigma = 2^raw instead of exp(raw)",
        {
            SIGMA: "np.exp2(np.clip(raw, RAW_MIN, RAW_MAX))",
            SIGMA_BAR: "sigma_bar * sigma * np.log(2) * free",
        },
    ),
    edited(
        "prior",
        "prior-softplus",
        "sigma = softplus(raw) instead of exp(raw)",
        {
            SIGMA: "np.logaddexp(0, np.clip(raw, RAW_MIN, RAW_MAX))",
            SIGMA_BAR: "sigma_bar * -np.expm1(-sigma) * free",
        },
    ),
    edited(
        "prior",
        "prior-softplus-free",
        "sigma = softplus(raw) without the clamp of raw",
        {SIGMA: "np.logaddexp(0, raw)", SIGMA_BAR: "sigma_bar * -np.expm1(-sigma)"},
    ),
    edited(
        "prior",
        "prior-log-variance",
        "sigma = exp(raw / 2): raw is taken for the logarithm of a variance",
        {
            SIGMA: "np.exp(np.clip(raw, RAW_MIN, RAW_MAX) / 2)",
            SIGMA_BAR: "sigma_bar * sigma / 2 * free",
        },
    ),
    edited(
        "prior",
        "prior-no-clamp",
        "raw sigma is not clamped",
        {SIGMA: "np.exp(raw)", SIGMA_BAR: "sigma_bar * sigma"},
    ),
    edited(
        "prior",
        "prior-clamp-gradient",
        "the clamp of raw sigma lets the gradient through",
        {SIGMA_BAR: "sigma_bar * sigma"},
    ),
    edited(
        "prior",
        "prior-interleaved",
        "psi_p's outputs are read as mu, sigma, mu, sigma ... channel by channel",
        {
            "return mu, mu + np.repeat(widths, widths)": (
                "return 2 * np.arange(len(mu)), 2 * np.arange(len(mu)) + 1"
            ),
        },
    ),
    edited(
        "prior",
        "prior-all-means-first",
        "psi_p's outputs are read as all mu of all groups, then all sigma",
        {
            "return mu, mu + np.repeat(widths, widths)": (
                "return np.arange(len(mu)), len(mu) + np.arange(len(mu))"
            ),
        },
    ),
    known(
        "prior",
        "prior-widths-reversed",
        "the widths of the groups after f are taken in the opposite order: O, l, s",
        **given_as(widths=lambda given: (given["widths"][0], *given["widths"][:0:-1])),
    ),
    known(
        "prior",
        "prior-groups",
        "psi_p's groups are read as f, l, s, O: the priors of s and l are exchanged",
        outputs=exchange,
        outputs_bar=lambda bars, out, given: exchange(bars, given),
    ),
]


# --- Eq. (13) -----------------------------------------------------------------------------------
def tiled(mask):
    """The mask repeated coordinate by coordinate, (3, k), over offsets stored as (k, 3)."""
    return np.tile(mask, (1, 3)).reshape(*mask.shape, 3)


def masked_by(factor):
    """The mask applied as `factor(mask)` (A, k, 3), by selection."""
    return dict(
        inputs=lambda given: {
            **given,
            "bits_O": np.where(factor(given["mask"]), given["bits_O"], 0),
            "mask": np.ones_like(given["mask"]),
        },
        inputs_bar=lambda bars, given: {**bars, "bits_O": bars["bits_O"] * factor(given["mask"])},
    )


def of_living(tree, mask):
    alive = mask.any(axis=1)
    return {
        name: np.where(alive.reshape(-1, *[1] * (a.ndim - 1)), a, 0)
        if name.startswith("bits")
        else a
        for name, a in tree.items()
    }


def divided_by(count):
    """The bits and their gradients divided by count(inputs)."""
    return dict(
        outputs=lambda out, given: {"R_anchor": out["R_anchor"] / np.float64(count(given))},
        outputs_bar=lambda bars, out, given: {
            "R_anchor": bars["R_anchor"] / np.float64(count(given))
        },
    )


def entries(given):
    return sum(bits.size for name, bits in given.items() if name.startswith("bits_"))


def coded_entries(given):
    return entries(given) - 3 * np.sum(~given["mask"])


ANCHOR_RATE = [
    known(
        "anchor_rate",
        "anchor-rate-mask-ignored",
        "masked offsets cost bits: the mask is ignored",
        inputs={"mask": np.ones_like},
    ),
    known(
        "anchor_rate",
        "anchor-rate-mask-coordinate-major",
        "the mask is laid over offsets as (3, k) instead of (k, 3)",
        **masked_by(tiled),
    ),
    known(
        "anchor_rate",
        "anchor-rate-mask-multiplied",
        "masked bits are multiplied by 0, and 0 times infinity is no number",
        inputs=lambda given: {
            **given,
            "bits_O": given["bits_O"] * given["mask"][:, :, None],
            "mask": np.ones_like(given["mask"]),
        },
        inputs_bar=lambda bars, given: {
            **bars,
            "bits_O": bars["bits_O"] * given["mask"][:, :, None],
        },
    ),
    edited(
        "anchor_rate",
        "anchor-rate-gradient-behind-mask",
        "masked offsets receive a gradient",
        {"bits_O_bar[~mask] = 0": "pass"},
    ),
    known(
        "anchor_rate",
        "anchor-rate-mean",
        "the bits are the mean over the anchors instead of the sum",
        outputs=lambda out, given: {"R_anchor": out["R_anchor"] / np.float64(len(given["mask"]))},
        outputs_bar=lambda bars, out, given: {
            "R_anchor": bars["R_anchor"] / np.float64(len(given["mask"]))
        },
    ),
    known(
        "anchor_rate", "anchor-rate-without-l", "the bits of l_a are left out", **without("bits_l")
    ),
    known(
        "anchor_rate",
        "anchor-rate-only-living",
        "an anchor whose children are all masked costs nothing at all",
        inputs=lambda given: of_living(given, given["mask"]),
        inputs_bar=lambda bars, given: of_living(bars, given["mask"]),
    ),
    known(
        "anchor_rate",
        "anchor-rate-mean-of-entries",
        "the bits are the mean over all entries instead of the sum",
        **divided_by(entries),
    ),
    known(
        "anchor_rate",
        "anchor-rate-mean-of-coded",
        "the bits are the mean over the entries that are coded instead of the sum",
        **divided_by(coded_entries),
    ),
    edited(
        "anchor_rate",
        "anchor-rate-means-of-groups",
        "the bits of f, s, l and O are means over their entries instead of sums",
        {
            "bits.sum(dtype=np.float64)": "bits.sum() / np.float64(bits.size)",
            "np.full((A, k, 3), R_anchor_bar, dtype)": (
                "np.full((A, k, 3), R_anchor_bar / np.float64(A * k * 3), dtype)"
            ),
            "np.full((A, d), R_anchor_bar, dtype)": (
                "np.full((A, d), R_anchor_bar / np.float64(A * d), dtype)"
            ),
            '"bits_s": np.full((A, 3), R_anchor_bar, dtype)': (
                '"bits_s": np.full((A, 3), R_anchor_bar / np.float64(A * 3), dtype)'
            ),
            '"bits_l": np.full((A, 3), R_anchor_bar, dtype)': (
                '"bits_l": np.full((A, 3), R_anchor_bar / np.float64(A * 3), dtype)'
            ),
        },
    ),
]


MISTAKES = [*NOISE, *STEP, *ROUNDING, *LIKELIHOOD, *PRIOR, *ANCHOR_RATE]
