"""The paper's formulas as they are printed, and how many digits they keep on the published cases.

`python -m tests.golden.printed` adds to `p4dgs_ref/oracle/printed_v1.safetensors`; what is there
keeps its bytes.

Some cases have numbers that only a formula written for them can compute: the slopes of tanh where
tanh is 1, the length of a vector whose square overflows. A port on stock automatic differentiation
has the right formula and misses them. For such tensors the file holds `<precision>/<subject>/
<case>/scale.<tensor>`, a scale that takes the place of the published S, and
`<precision>/<subject>/<case>/range.<tensor>`, which is true where the printed formula leaves the
range of the precision. `p4dgs_ref.oracle.compare` reads both.

The scale is the largest of S, of the effect of roundings within the printed formula (the root mean
square change of a number when the result of every operation is changed by +-delta of itself,
divided by delta), and of MARGIN / (c eps) times the formula's own error in the precision.
"""

import zlib
from functools import partial
from unittest.mock import patch

import numpy as np

from p4dgs_ref.equations import ssim
from p4dgs_ref.oracle import published, safetensors
from p4dgs_ref.oracle.compare import IMAGES, PRINTED, RECIPES, cast, deviations, expected
from tests.golden import tape
from tests.golden.tape import Value

PROBES = 24
DELTA = 2.0**-34
MARGIN = 4  # times its own error in one arithmetic a formula may be off in another


# --- the formulas -------------------------------------------------------------------------------
def network(x, weights, biases):
    """psi(x): layers with ReLU between them."""
    *hidden, last = zip(weights, biases)
    for W, b in hidden:
        x = (x @ W + b).at_least(0)
    W, b = last
    return x @ W + b


def attribute(width, f_a, delta_vc, d_vc, weights, biases):
    """psi(f_a, delta_vc, d_vc), child by child."""
    y = network(tape.side_by_side([f_a, delta_vc, d_vc]), weights, biases)
    A, columns = y.array.shape
    return y.reshape(A, columns // width, width)


def unit(r):
    """r / sqrt(|r|**2 + 1e-24)."""
    return r / ((r * r).sum(axis=-1) + 1e-24).sqrt()


def view(x_a, x_c):
    v = x_a - x_c
    square = (v * v).sum(axis=1)
    apart = square.array > 0
    delta_vc = (square.where(apart) + ~apart).sqrt().where(apart)
    return {"delta_vc": delta_vc, "d_vc": (v / (delta_vc + ~apart)).where(apart)}


def opacity(**inputs):
    psi = attribute(1, **inputs)
    return {"alpha": psi.reshape(*psi.array.shape[:2]).tanh()}


def scale(s_a, **inputs):
    A, axes = s_a.array.shape
    return {"s": s_a.reshape(A, 1, axes) * attribute(3, **inputs).sigmoid()}


def deformed(x, s, r, delta_x, delta_s, delta_r):
    return {
        "x_t": x + delta_x if delta_x.array.shape[1] else x,
        "s_t": s + delta_s if delta_s.array.shape[1] else s,
        "r_t": unit(r + delta_r) if delta_r.array.shape[1] else r,
    }


def of_network(u, Q_0):
    """Eq. (8) with its floor, of the network's output u."""
    return {"q": (Q_0 * (1 + u.tanh())).at_least(2.0**-10 * Q_0.array)}


def averages(n):
    """The matrix [n, n] that averages n rows over the window of SSIM, zeros around them."""
    apart = np.subtract.outer(np.arange(n), np.arange(n))
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    return np.where(np.abs(apart) <= 5, np.exp(-0.5 * (apart / 1.5) ** 2) / taps.sum(), 0)


def by_products(a):
    """The averages of an image [H, W], as two products with matrices."""
    H, W = a.array.shape
    return a.of(averages(H)) @ a @ averages(W)


def by_convolution(a):
    """The same as a sum of 11 x 11 shifted images. The window is symmetric: its own adjoint."""
    H, W = a.array.shape
    taps = averages(11)[5].astype(a.array.dtype)

    def mean(image):
        around = np.pad(image, 5)
        return sum(
            taps[i] * taps[j] * around[i : i + H, j : j + W] for i in range(11) for j in range(11)
        )

    return a.made(mean(a.array), (a, mean))


def similarity(image, truth, mean=by_products):
    """The mean SSIM of Wang et al. with variances E[x**2] - mu**2."""
    H, W, C = image.array.shape
    total = 0
    for c in range(C):
        channel = np.eye(C)[:, [c]]
        x, y = ((a.reshape(H * W, C) @ channel).reshape(H, W) for a in (image, truth))
        mu_x, mu_y = mean(x), mean(y)
        cov_xy = mean(x * y) - mu_x * mu_y
        var_x, var_y = mean(x * x) - mu_x * mu_x, mean(y * y) - mu_y * mu_y
        above = (2 * mu_x * mu_y + 0.01**2) * (2 * cov_xy + 0.03**2)
        below = (mu_x * mu_x + mu_y * mu_y + 0.01**2) * (var_x + var_y + 0.03**2)
        total = (above / below).sum() + total
    return total / float(H * W * C)


def with_printed_ssim(vjp):
    """Return two answers of the steps of a training that has `similarity` in place of our SSIM."""
    return tuple(partial(_with_similarity, vjp, mean) for mean in (by_products, by_convolution))


def _with_similarity(vjp, mean, inputs, cotangents):
    def dissimilarity(image, truth, _=None):
        x, y = (Value(np.asarray(a, image.dtype), np.asarray) for a in (image, truth))
        alike = similarity(x, y, mean)
        return (1 - alike).array, (alike, x)

    def backward(saved, ssim_bar):
        alike, x = saved
        return {"image": tape.gradients([alike], [ssim_bar], [x])[0]}

    with patch.multiple(ssim, dissimilarity=dissimilarity, backward=backward):
        return published.flatten(vjp(**inputs)[0], "out.")


def render_loss(image, truth, lambda_ssim):
    L1, D_SSIM = (image - truth).absolute().mean(), 1 - similarity(image, truth)
    loss = (1 - lambda_ssim) * L1 + lambda_ssim * D_SSIM
    return {"L_render": loss, "L1": L1, "D_SSIM": D_SSIM}


FORMULAS = {
    "tanh": lambda y: {"alpha": y.tanh()},
    "sigmoid": lambda y: {"color": y.sigmoid().reshape(y.array.shape[0], 1, -1)},
    "unit_quaternion": lambda y: {"r": unit(y.reshape(y.array.shape[0], 1, -1))},
    "step_floor": lambda u, Q_0: of_network(u, Q_0),
    "view": view,
    "opacity": opacity,
    "color": lambda **inputs: {"color": attribute(3, **inputs).sigmoid()},
    "rotation": lambda **inputs: {"r": unit(attribute(4, **inputs))},
    "scale": scale,
    "deformed": deformed,
    "step": lambda h, weights, biases, Q_0: of_network(network(h, weights, biases), Q_0),
    "ssim": lambda image, truth: {"ssim": similarity(image, truth)},
    "render_loss": render_loss,
}


# --- what they give on a case -------------------------------------------------------------------
def answer(case, rounded, dtype=np.float64):
    """Return outputs and gradients of a case by the printed formula: {"out.x": array, ...}."""

    def leaf(a):
        return [Value(b, rounded) for b in a] if isinstance(a, list) else Value(a, rounded)

    inputs = cast(case.inputs(), dtype)
    leaves = {n: leaf(a) if isinstance(a, (list, np.ndarray)) else a for n, a in inputs.items()}
    outputs = FORMULAS[case.subject](**leaves)
    flat = {f"out.{name}": value.array for name, value in outputs.items()}
    bars = {n.removesuffix("_bar"): bar for n, bar in case.cotangents().items()}
    differentiable = published.subjects()[case.subject]["differentiable"]
    asked = flatten_values({n: leaves[n] for n in differentiable})
    gradients = tape.gradients([outputs[n] for n in bars], bars.values(), list(asked.values()))
    return {**flat, **{f"in_bar.{name}": a for name, a in zip(asked, gradients)}}


def flatten_values(values):
    """Return {"weights": [W0, W1]} as {"weights.0": W0, "weights.1": W1}."""
    flat = {}
    for name, value in values.items():
        rows = enumerate(value) if isinstance(value, list) else [("", value)]
        flat.update({f"{name}.{i}".rstrip("."): v for i, v in rows})
    return flat


def disturbed(a, rng, tiny):
    """A rounding that shows: every number is changed by +-DELTA of itself.

    Below the smallest normal number `tiny` the digits have a fixed place: +-DELTA of `tiny`.
    """
    by = rng.choice([-1.0, 1.0], (2, *np.shape(a)))
    return a + DELTA * (a * by[0] + tiny * by[1])


def flushed(a, dtype):
    """A result in a precision whose numbers below the smallest normal one are 0."""
    a = np.asarray(a, dtype)
    return np.where(np.abs(a) < np.finfo(dtype).tiny, dtype(0), a)


def tainted(a, dtype):
    """A result that is NaN where it overflows, so that everything computed from it is NaN."""
    a = np.asarray(a, dtype)
    return np.where(np.isinf(a), dtype(np.nan), a)


def spread(case, tiny=0.0):
    """Return how far roundings within the printed formula move every number, per unit of them."""
    rng = np.random.default_rng(zlib.crc32(case.id.encode()))
    exact = answer(case, np.asarray)
    squares = {name: np.zeros(a.shape) for name, a in exact.items()}
    for _ in range(PROBES):
        moved = answer(case, partial(disturbed, rng=rng, tiny=tiny))
        for name, a in moved.items():
            squares[name] += ((a - exact[name]) / DELTA) ** 2
    roots = {name: np.sqrt(a / PROBES) for name, a in squares.items()}
    return {name: np.where(np.isfinite(a), a, 0) for name, a in roots.items()}


def plain_answers(case, dtype):
    """Return what the formula gives in a precision: with numbers below `tiny`, without, tainted."""
    return [answer(case, partial(f, dtype=dtype), dtype) for f in (np.asarray, flushed, tainted)]


def precisions(case):
    """Return the precisions in which a case is asked."""
    return [dtype for dtype in (np.float64, np.float32) if case.tolerance(np.dtype(dtype).name)]


def worse(case, relative):
    """Return the names of the tensors for which the printed formula may have too few digits.

    Those are the tensors that it misses, and those that its roundings could make it miss.
    """
    names = set()
    for dtype in precisions(case):
        c = case.tolerance(np.dtype(dtype).name)["eps_S"]
        plain = plain_answers(case, dtype)
        for name, inner in relative.items():
            right, S = case.tensors[name], case.tensors["scale." + name]
            errors = [deviations(a[name].reshape(right.shape), right, S, dtype)[1] for a in plain]
            rounded = np.where(inner == 0, 0, inner.reshape(right.shape) / S)
            error = MARGIN * max(error.max(initial=0) for error in errors)
            if max(error, rounded.max(initial=0)) > c:
                names.add(name)
    return sorted(names)


def scales(case, names, relative, dtype):
    """Return {tensor: (scale, where the printed formula leaves the range)} in a precision."""
    eps, c = np.finfo(dtype).eps, case.tolerance(np.dtype(dtype).name)["eps_S"]
    plain, results = plain_answers(case, dtype), {}
    # Numbers below the smallest normal one of float64 cannot be disturbed in float64.
    absolute = spread(case, np.finfo(dtype).tiny) if dtype is np.float32 else relative
    for name in names:
        right = case.tensors[name]
        answers = [answered[name].reshape(right.shape).astype(float) for answered in plain]
        S = np.maximum(case.tensors["scale." + name], relative[name].reshape(right.shape))
        # Digits may cancel down to 0; this is not the range, and is part of S.
        gone = [~np.isfinite(a) | (a == 0) & (np.abs(right) > c * eps * S) for a in answers]
        miss = [np.where(lost, 0, np.abs(a - right)) for a, lost in zip(answers, gone)]
        small = absolute[name].reshape(right.shape)
        small = np.where(eps * small < np.abs(right), small, 0)  # otherwise nothing is left
        size = np.maximum.reduce([S, small, *(MARGIN * m / (c * eps) for m in miss)])
        if name.split(".")[1] in IMAGES:
            size = size.max()
        results[name] = size, np.logical_or.reduce(gone)
    return results


def culled(case):
    """Return {name: array} of what a projection in float32 alone loses, the same for every formula.

    Where a covariance overflows, or the determinant of a projected one is no longer positive and
    finite, the Gaussian is not drawn. All its numbers may then be 0, infinite or NaN.
    """
    a, b, c = case.tensors["out.cov2d"].astype(np.float32).T
    det, Sigma = a * c - b * b, case.tensors["in.Sigma"].astype(np.float32)
    lost = case.tensors["out.visible"] & ~((det > 0) & np.isfinite(det))
    lost = lost | ~np.isfinite(Sigma).all(axis=(1, 2))
    right = expected(case.tensors) if lost.any() and case.tolerance("float32") else {}
    of_rows = {name: np.broadcast_to(lost, a.T.shape).T for name, a in right.items()}
    return {f"float32/{case.id}/range.{name}": a for name, a in of_rows.items()}


def build(keys=tuple(RECIPES)):
    """Return {name: array} for the file, or the part of it that some subjects have."""
    tensors = {}
    cases = [case for key in keys for case in published.cases(key)]
    with np.errstate(all="ignore"):
        for case in cases:
            if case.subject not in FORMULAS:
                tensors |= culled(case)
                continue
            relative = spread(case)
            names = worse(case, relative)
            for dtype in precisions(case) if names else ():
                prefix = f"{np.dtype(dtype).name}/{case.id}"
                for name, (size, lost) in scales(case, names, relative, dtype).items():
                    if not np.array_equal(size, case.tensors[f"scale.{name}"]):
                        tensors[f"{prefix}/scale.{name}"] = size
                    if lost.any():
                        tensors[f"{prefix}/range.{name}"] = lost
    return tensors


def main():
    stored = safetensors.load(PRINTED.read_bytes())  # keeps its bytes
    tensors = {name: stored.get(name, a) for name, a in build().items()}
    data = safetensors.dump(tensors, {"license": "CC0-1.0"})
    PRINTED.write_bytes(data)
    print(f"{PRINTED.name}: {len(data):,} bytes")


if __name__ == "__main__":
    main()
