"""Known mistakes in Eqs. (7), (8) and (10) to (13): noise, steps, rounding, the cost of values."""

import math

import numpy as np
from scipy.special import expit, ndtr

from p4dgs_ref.equations.prior import RAW_MAX, RAW_MIN, layout
from p4dgs_ref.equations.step import SMALLEST
from tests.golden.mistakes.kit import (
    NotApplicable,
    bars_of,
    exponential,
    headed,
    known,
    last_columns,
    no_gradient,
    port,
    surgery,
    without,
)

LOG_2 = math.log(2)
PHI_0 = 1 / math.sqrt(2 * math.pi)  # density of the standard Gaussian at its mean


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
def steps(value):
    """A head whose steps are Q_0 times `value(psi_q) -> value, slope`."""

    def head(y, given):
        share, slope = value(y)
        return {"q": given["Q_0"] * share}, lambda bars: (bars["q"] * given["Q_0"] * slope, {})

    return head


def twice_sigmoid(y):
    """1 + tanh y above its floor, and its slope everywhere."""
    share = 2 * expit(2 * y)
    return share, 2 * share * expit(-2 * y)


def floored(share, slope):
    return np.maximum(share, SMALLEST), np.where(share > SMALLEST, slope, 0)


def no_one(y):
    return np.tanh(y), 1 - np.tanh(y) ** 2


def half_argument(y):
    return floored(2 * expit(y), 2 * expit(y) * expit(-y))


def half_slope(y):
    share, slope = twice_sigmoid(y)
    return floored(share, slope / 2)


def passing_floor(y):
    share, slope = twice_sigmoid(y)
    return np.maximum(share, SMALLEST), slope


def columns_of_groups(given):
    if len(given["Q_0"]) != 4:
        raise NotApplicable("other groups than f, s, l, O")
    return np.array([0, 2, 1, 3])


def plain_Q_0(given):
    return {**given, "Q_0": np.ones_like(given["Q_0"])}


STEP = [
    headed("step", "step-no-one", "q = Q_0 tanh(psi_q): the 1 + is missing", steps(no_one)),
    headed(
        "step",
        "step-half-argument",
        "q = 2 Q_0 sigmoid(psi_q): the sigmoid of 2 psi_q is meant",
        steps(half_argument),
    ),
    headed("step", "step-exp", "q = Q_0 exp(psi_q)", steps(exponential)),
    headed(
        "step",
        "step-no-floor",
        "q has no floor: it vanishes where tanh is -1",
        steps(twice_sigmoid),
    ),
    headed(
        "step",
        "step-floor-gradient",
        "the floor of q lets the gradient through",
        steps(passing_floor),
    ),
    headed(
        "step",
        "step-half-slope",
        "the slope lacks the inner factor 2 of sigmoid(2 psi_q)",
        steps(half_slope),
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
def rounded(rule, back=lambda symbols, f, q: (symbols * q.astype(float)).astype(f.dtype)):
    """Another `rule(f, q)` for the symbols, or another way back."""

    def run(given, cotangents):
        f, q = given["f"], given["q"]
        symbols = np.asarray(rule(f, q)).astype(np.int64)
        return {"symbols": symbols, "f_hat": back(symbols, f, q)}, {}

    return run


def ratio(f, q):
    return np.divide(f, q, dtype=np.float64)


def away(f, q):
    r = np.abs(ratio(f, q))
    return np.sign(ratio(f, q)) * np.where(r - np.floor(r) >= 0.5, np.floor(r) + 1, np.floor(r))


def half_up(f, q):
    r = ratio(f, q)
    return np.where(r - np.floor(r) >= 0.5, np.floor(r) + 1, np.floor(r))


ROUNDING = [
    surgery(
        "rounding",
        "rounding-half-away",
        "ties are rounded away from zero instead of to even",
        rounded(away),
    ),
    surgery(
        "rounding", "rounding-half-up", "ties are rounded up instead of to even", rounded(half_up)
    ),
    surgery(
        "rounding", "rounding-floor", "floor for round", rounded(lambda f, q: np.floor(ratio(f, q)))
    ),
    surgery(
        "rounding",
        "rounding-truncate",
        "truncation towards zero for round",
        rounded(lambda f, q: np.trunc(ratio(f, q))),
    ),
    surgery(
        "rounding",
        "rounding-float32",
        "f / q is divided in float32",
        rounded(lambda f, q: np.rint(f.astype(np.float32) / q.astype(np.float32))),
    ),
    surgery(
        "rounding",
        "rounding-symbols-for-values",
        "f_hat is the symbol itself: it is not multiplied by q",
        rounded(lambda f, q: np.rint(ratio(f, q)), lambda symbols, f, q: symbols.astype(f.dtype)),
    ),
]


# --- Eq. (11) -----------------------------------------------------------------------------------
HAC_BITS = -math.log2(1e-6)


def density(given, cotangents):
    """q times the density at f."""
    f, mu, sigma, q = (given[name] for name in ("f_noisy", "mu", "sigma", "q"))
    z, bar = (f - mu) / sigma, bars_of(cotangents)["bits"] / LOG_2
    log_p = -0.5 * z * z - 0.5 * math.log(2 * math.pi) + np.log(q / sigma)
    return {"bits": -log_p / LOG_2}, {
        "f_noisy": bar * z / sigma,
        "mu": -bar * z / sigma,
        "sigma": bar * (1 - z * z) / sigma,
        "q": -bar / q,
    }


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


LIKELIHOOD = [
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
        outputs={"bits": lambda bits: np.minimum(bits, bits.dtype.type(HAC_BITS))},
        outputs_bar={"bits": lambda bar, bits: np.where(bits <= HAC_BITS, bar, 0)},
    ),
    surgery(
        "likelihood",
        "likelihood-literal",
        "the printed difference of two values near one: no digits in the tails",
        printed,
    ),
    surgery(
        "likelihood",
        "likelihood-density",
        "the density at f times q for the mass of the bin",
        density,
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


# --- B1 -----------------------------------------------------------------------------------------
def laplace_density(given, cotangents):
    w, step, b = given["w"], given["step"], given["b"]
    k, bits_bar = w / step, cotangents["bits_bar"] / LOG_2
    slope = bits_bar * np.sign(k) / b / step
    bits = (np.abs(k) / b + np.log(2 * b)) / LOG_2
    return {"bits": bits}, {"w": slope, "step": -slope * k}


WEIGHT_BITS = [
    known(
        "weight_bits",
        "weight-bits-no-step",
        "the weights are not divided by the step",
        inputs={"step": np.ones_like},
        inputs_bar={"step": no_gradient},
    ),
    known(
        "weight_bits",
        "weight-bits-whole-step",
        "the bin reaches from k - 1 to k + 1",
        inputs={"step": lambda step: 2 * step, "b": lambda b: b / 2},
        inputs_bar={"step": lambda bar, _: 2 * bar},
    ),
    known(
        "weight_bits",
        "weight-bits-nats",
        "the bits are nats: the natural logarithm for that to base 2",
        outputs={"bits": lambda bits: bits * LOG_2},
        outputs_bar={"bits": lambda bar, _: bar * LOG_2},
    ),
    surgery(
        "weight_bits",
        "weight-bits-density",
        "the density at k for the mass of the bin",
        laplace_density,
    ),
    known(
        "weight_bits",
        "weight-bits-no-gradient-of-step",
        "no gradient flows to the step",
        inputs_bar={"step": no_gradient},
    ),
    known(
        "weight_bits",
        "weight-bits-sign-of-step",
        "the gradient of the step has the wrong sign",
        inputs_bar={"step": lambda bar, _: -bar},
    ),
]


# --- Eq. (12) -----------------------------------------------------------------------------------
def deviations(value):
    """A head whose sigma is `value(raw) -> sigma, slope`."""

    def head(y, given):
        mu, raw = layout(given["widths"])
        sigma, slope = value(y[:, raw])

        def pull(bars):
            y_bar = np.zeros_like(y)
            y_bar[:, mu], y_bar[:, raw] = bars["mu"], bars["sigma"] * slope
            return y_bar, {}

        return {"mu": y[:, mu], "sigma": sigma}, pull

    return head


def clamped(function):
    """`function(raw) -> sigma, slope` behind the clamp of raw."""

    def of_raw(raw):
        value, slope = function(np.clip(raw, RAW_MIN, RAW_MAX))
        return value, slope * ((raw >= RAW_MIN) & (raw <= RAW_MAX))

    return of_raw


def clamp_passing(raw):
    sigma = np.exp(np.clip(raw, RAW_MIN, RAW_MAX))
    return sigma, sigma


def positions(rule):
    """The changes that read psi_p's outputs elsewhere.

    rule(start, i, n) returns the columns of mu and of raw sigma for the numbers i of a group.
    """

    def order(given):
        widths = given["widths"]
        starts, index = np.cumsum((0, *widths[:-1])), np.empty(2 * sum(widths), int)
        for start, width in zip(starts, widths):
            mu = 2 * start + np.arange(width)
            index[mu], index[mu + width] = rule(start, np.arange(width), sum(widths))
        return index

    return last_columns(order)


def exchange(tree, given):
    """The groups s and l exchanged."""
    widths = given["widths"]
    if len(widths) != 4 or widths[1] != widths[2]:
        raise NotApplicable("other groups than f, s, l, O")
    f, s, l, O = np.split(np.arange(sum(widths)), np.cumsum(widths[:-1]))
    return {name: a[:, np.concatenate([f, l, s, O])] for name, a in tree.items()}


PRIOR = [
    headed(
        "prior",
        "prior-not-exponentiated",
        "sigma is the raw output: exp is missing",
        deviations(clamped(lambda raw: (raw, np.ones_like(raw)))),
    ),
    headed(
        "prior",
        "prior-power-of-two",
        "sigma = 2^raw instead of exp(raw)",
        deviations(clamped(lambda raw: (np.exp2(raw), LOG_2 * np.exp2(raw)))),
    ),
    headed(
        "prior",
        "prior-softplus",
        "sigma = softplus(raw) instead of exp(raw)",
        deviations(clamped(lambda raw: (np.logaddexp(0, raw), expit(raw)))),
    ),
    headed(
        "prior",
        "prior-log-variance",
        "sigma = exp(raw / 2): raw is taken for the logarithm of a variance",
        deviations(clamped(lambda raw: (np.exp(raw / 2), np.exp(raw / 2) / 2))),
    ),
    headed("prior", "prior-no-clamp", "raw sigma is not clamped", deviations(exponential)),
    headed(
        "prior",
        "prior-clamp-gradient",
        "the clamp of raw sigma lets the gradient through",
        deviations(clamp_passing),
    ),
    known(
        "prior",
        "prior-interleaved",
        "psi_p's outputs are read as mu, sigma, mu, sigma ... channel by channel",
        **positions(lambda start, i, n: (2 * (start + i), 2 * (start + i) + 1)),
    ),
    known(
        "prior",
        "prior-all-means-first",
        "psi_p's outputs are read as all mu of all groups, then all sigma",
        **positions(lambda start, i, n: (start + i, n + start + i)),
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


def gradient_behind_mask(given, cotangents):
    out, bars = port("anchor_rate")(given, cotangents)
    return out, {**bars, "bits_O": np.full_like(bars["bits_O"], cotangents["R_anchor_bar"])}


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


def means_of_groups(given, cotangents):
    """The mean of each of f, s, l, O over its entries, masked ones included; then their sum."""
    bits = {name: a for name, a in given.items() if name.startswith("bits_")}
    kept = np.broadcast_to(given["mask"][:, :, None], bits["bits_O"].shape)
    bits["bits_O"] = np.where(kept, bits["bits_O"], 0)
    bar = cotangents["R_anchor_bar"]
    bars = {name: np.full_like(a, bar / np.float64(a.size)) for name, a in bits.items()}
    bars["bits_O"] = bars["bits_O"] * kept
    total = sum(a.sum() / np.float64(a.size) for a in bits.values())
    return {"R_anchor": np.asarray(total)}, bars


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
    surgery(
        "anchor_rate",
        "anchor-rate-gradient-behind-mask",
        "masked offsets receive a gradient",
        gradient_behind_mask,
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
    surgery(
        "anchor_rate",
        "anchor-rate-means-of-groups",
        "the bits of f, s, l and O are means over their entries instead of sums",
        means_of_groups,
    ),
]

MISTAKES = [*NOISE, *STEP, *ROUNDING, *LIKELIHOOD, *WEIGHT_BITS, *PRIOR, *ANCHOR_RATE]
