"""Known mistakes written into Eqs. (7) to (14): {file: {id: [(old text, new text), ...]}}."""

STEP_BAR = "(f_noisy_bar * res.u).sum(axis=1, keepdims=True)"
NOISE = {
    "noise-without-step": [("f + u * q", "f + u"), (STEP_BAR, "0 * f_noisy_bar[:, :1]")],
    "noise-not-centred": [("Out(f + u * q), Res(u)", "Out(f + (u + 0.5) * q), Res(u + 0.5)")],
    "noise-twice-as-wide": [("Out(f + u * q), Res(u)", "Out(f + 2 * u * q), Res(2 * u)")],
    "noise-no-gradient-of-step": [(STEP_BAR, "0 * f_noisy_bar[:, :1]")],
    "noise-mean-gradient": [(STEP_BAR, "(f_noisy_bar * res.u).mean(axis=1, keepdims=True)")],
}

SHARE, Q = "share = expit(2 * y.y)", "Out(2 * Q_0 * np.maximum(share, FLOOR / 2))"
SLOPE, STEEP = (
    "np.where(share > FLOOR / 2, 4 * Q_0 * share * expit(-2 * y.y), 0)",
    "4 * Q_0 * share * expit(-2 * y.y)",
)
STEP = {
    "step-no-one": [(Q, "Out(Q_0 * np.tanh(y.y))"), (SLOPE, "Q_0 * (1 - np.tanh(y.y) ** 2)")],
    "step-half-argument": [(SHARE, "share = expit(y.y)"), (STEEP, "2 * Q_0 * share * expit(-y.y)")],
    "step-exp": [(Q, "Out(Q_0 * np.exp(y.y))"), (SLOPE, "Q_0 * np.exp(y.y)")],
    "step-no-floor": [(Q, "Out(2 * Q_0 * share)"), (SLOPE, STEEP)],
    "step-floor-gradient": [(SLOPE, STEEP)],
    "step-half-slope": [(STEEP, "2 * Q_0 * share * expit(-2 * y.y)")],
    "step-no-base": [
        (Q, "Out(2 * np.maximum(share, FLOOR / 2))"),
        (STEEP, "4 * share * expit(-2 * y.y)"),
    ],
    "step-groups": [
        (
            "    " + SHARE,
            "    psi = y.y[:, [0, 2, 1, 3]] if len(Q_0) == 4 else y.y\n    share = expit(2 * psi)",
        ),
        (STEEP, "4 * Q_0 * share * expit(-2 * psi)"),
        (
            "q_bar * res.slope",
            "(q_bar * res.slope)[:, [0, 2, 1, 3] if q_bar.shape[1] == 4 else slice(None)]",
        ),
    ],
}

ROUND, BACK = (
    "np.rint(np.divide(f, q, dtype=np.float64))",
    "(symbols * q.astype(np.float64)).astype(f.dtype)",
)
DIVIDED = "np.divide(f, q, dtype=np.float64)"
ROUNDING = {
    "rounding-half-away": [
        (
            ROUND,
            f"np.rint({DIVIDED})\n        tie = np.abs({DIVIDED} - np.trunc({DIVIDED})) == 0.5\n"
            f"        ratio = np.where(tie, np.trunc({DIVIDED}) + np.sign({DIVIDED}), ratio)",
        )
    ],
    "rounding-half-up": [
        (
            ROUND,
            f"np.rint({DIVIDED})\n        tie = {DIVIDED} - np.floor({DIVIDED}) == 0.5\n"
            f"        ratio = np.where(tie, np.ceil({DIVIDED}), ratio)",
        )
    ],
    "rounding-floor": [(ROUND, f"np.floor({DIVIDED})")],
    "rounding-truncate": [(ROUND, f"np.trunc({DIVIDED})")],
    "rounding-float32": [(ROUND, "np.rint(np.float32(f) / np.float32(q)).astype(float)")],
    "rounding-symbols-for-values": [(BACK, "symbols.astype(f.dtype)")],
}

MASS, UNIT = "b = log_mass(f_noisy, mu, sigma, q)", "per_unit = -1 / (math.log(2) * sigma)"
BITS, SIGMA_SLOPE = (
    "bits = b.log_p * (-1 / math.log(2)) + 0.0",
    "-(b.z * b.slope_z + b.w * b.slope_w)",
)
SLOPES = f"slopes = (b.slope_z, {SIGMA_SLOPE}, b.slope_w)"
LIKELIHOOD = {
    "likelihood-nats": [(BITS, "bits = -b.log_p"), (UNIT, "per_unit = -1 / sigma")],
    "likelihood-variance": [
        ("    " + MASS, "    sigma = np.sqrt(sigma)\n    " + MASS),
        (SIGMA_SLOPE, SIGMA_SLOPE + " / (2 * sigma)"),
    ],
    "likelihood-whole-step": [
        (MASS, "b = log_mass(f_noisy, mu, sigma, q + q)"),
        (", b.slope_w)", ", 2 * b.slope_w)"),
    ],
    "likelihood-no-mean": [
        (MASS, "b = log_mass(f_noisy, np.zeros_like(mu), sigma, q)"),
        ('"mu": -f_bar', '"mu": 0 * f_bar'),
    ],
    "likelihood-erf": [
        ("    " + MASS, "    sigma = sigma / math.sqrt(2)\n    " + MASS),
        (SIGMA_SLOPE, SIGMA_SLOPE + " / math.sqrt(2)"),
    ],
    "likelihood-floor": [
        (
            BITS,
            "low = b.log_p < math.log(1e-6)\n"
            "    slopes = [np.where(low, 0, s) for s in slopes]\n"
            "    bits = np.where(low, math.log(1e-6), b.log_p) / -math.log(2)",
        )
    ],
    "likelihood-literal": [("log_mass=gaussian_bin.stable", "log_mass=gaussian_bin.literal")],
    "likelihood-density": [
        (
            BITS,
            "bits = np.log2(math.sqrt(2 * math.pi) * sigma / q) + ((f_noisy - mu) / sigma) ** 2 / (2 * math.log(2))",
        ),
        (SLOPES, "slopes = (-b.z, b.z**2 - 1, sigma / q)"),
    ],
    "likelihood-mean-gradient": [('"mu": -f_bar', '"mu": f_bar')],
    "likelihood-no-gradient-of-step": [('"q": bits_bar * res.q_slope', '"q": 0 * bits_bar')],
    "likelihood-no-gradient-of-sigma": [
        ('"sigma": bits_bar * res.sigma_slope', '"sigma": 0 * bits_bar')
    ],
}

CLIPPED, CHAIN = "np.clip(raw, RAW_MIN, RAW_MAX)", "sigma_bar * res.sigma * res.free"
EXP, COLUMNS = f"np.exp({CLIPPED})", "    return mu, mu + np.repeat(widths, widths)"
PRIOR = {
    "prior-not-exponentiated": [(EXP, CLIPPED), (CHAIN, "sigma_bar * res.free")],
    "prior-power-of-two": [
        (EXP, f"2.0 ** {CLIPPED}"),
        (CHAIN, "sigma_bar * res.sigma * 0.6931471805599453 * res.free"),
    ],
    "prior-softplus": [
        (EXP, f"np.log1p({EXP})"),
        (CHAIN, "sigma_bar * -np.expm1(-res.sigma) * res.free"),
    ],
    "prior-log-variance": [
        (EXP, f"np.sqrt({EXP})"),
        (CHAIN, "0.5 * sigma_bar * res.sigma * res.free"),
    ],
    "prior-no-clamp": [(EXP, "np.exp(raw)"), (CHAIN, "sigma_bar * res.sigma")],
    "prior-clamp-gradient": [(CHAIN, "sigma_bar * res.sigma")],
    "prior-interleaved": [
        ("2 * start + np.arange(width)", "2 * start + np.arange(0, 2 * width, 2)"),
        (COLUMNS, "    return mu, mu + 1"),
    ],
    "prior-all-means-first": [
        (COLUMNS, "    return np.arange(sum(widths)), np.arange(sum(widths), 2 * sum(widths))")
    ],
    "prior-groups": [
        (
            COLUMNS,
            "    raw = mu + np.repeat(widths, widths)\n    if len(widths) == 4:\n"
            "        f, n = widths[0], widths[1]\n"
            "        order = np.r_[:f, f + n:f + 2 * n, f:f + n, f + 2 * n:len(mu)]\n"
            "        mu, raw = mu[order], raw[order]\n"
            "    return mu, raw",
        )
    ],
}

KEPT, DROPPED = "np.where(mask[:, :, None], bits_O, 0)", 'bars["bits_O"][~res.mask] = 0'
TERMS, OUT = "(bits_f, kept, bits_l, bits_s))", "Out(np.asarray(total, bits_f.dtype))"
TILED = "np.concatenate([{m}, {m}, {m}], axis=1).reshape(*{m}.shape, 3)"
ANCHOR_RATE = {
    "anchor-rate-mask-ignored": [(KEPT, "bits_O"), (DROPPED, "pass")],
    "anchor-rate-mask-coordinate-major": [
        (KEPT, f"np.where({TILED.format(m='mask')}, bits_O, 0)"),
        (DROPPED, f'bars["bits_O"][~{TILED.format(m="res.mask")}] = 0'),
    ],
    "anchor-rate-mask-multiplied": [(KEPT, "mask[:, :, None] * bits_O")],
    "anchor-rate-gradient-behind-mask": [(DROPPED, "pass")],
    "anchor-rate-mean": [
        (OUT, "Out(np.asarray(total / len(mask), bits_f.dtype))"),
        (
            "np.full(shape, R_anchor_bar, res.dtype)",
            "np.full(shape, R_anchor_bar / max(len(res.mask), 1), res.dtype)",
        ),
    ],
    "anchor-rate-without-l": [
        (TERMS, "(bits_f, kept, bits_s))"),
        ("    " + DROPPED, '    bars["bits_l"][:] = 0\n    ' + DROPPED),
    ],
    "anchor-rate-only-living": [
        (TERMS, "(b[mask.any(axis=1)] for b in (bits_f, kept, bits_l, bits_s)))"),
        (
            "    return bars",
            "    for bar in bars.values():\n        bar[~res.mask.any(axis=1)] = 0\n    return bars",
        ),
    ],
}

READ, H = (
    "np.where(np.concatenate(grids) >= 0, 1, -1)",
    "h = (located @ signs).reshape(-1, len(grids) * signs.shape[1])",
)
INSIDE, LEVELS = (
    "[np.abs(grid) <= 1 for grid in grids]",
    "locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])",
)
GRID = {
    "hash-grid-planes": [
        (
            f"    return query({LEVELS}, grids)",
            f"    located, L = {LEVELS}, len(grids)\n"
            "    if [axes for axes, _ in resolutions[-2:]] == ['xz', 'yz']:\n"
            "        located = located[[a * L + i for a in range(len(x_a)) for i in [*range(L - 2), L - 1, L - 2]]]\n"
            "    return query(located, grids)",
        )
    ],
    "hash-grid-feature-major": [
        (
            H,
            "L, F = len(grids), signs.shape[1]\n"
            "    h = (located @ signs).reshape(-1, L, F).swapaxes(1, 2).reshape(-1, L * F)",
        ),
        (
            "h_bar.reshape(-1, res.inside[0].shape[1])",
            "h_bar.reshape(-1, res.inside[0].shape[1], len(res.inside)).swapaxes(1, 2).reshape(-1, res.inside[0].shape[1])",
        ),
    ],
    "hash-grid-sign-of-zero": [(READ, "np.sign(np.concatenate(grids))")],
    "hash-grid-zero-negative": [(READ, "np.where(np.concatenate(grids) > 0, 1, -1)")],
    "hash-grid-not-binary": [(READ, "np.concatenate(grids)")],
    "hash-grid-straight-through": [(INSIDE, "[np.ones(grid.shape, bool) for grid in grids]")],
    "hash-grid-strictly-inside": [(INSIDE, "[np.abs(grid) < 1 for grid in grids]")],
}
PLACE, WEIGHT = "np.clip(u, 0, 1) * (res - 1)", "np.where(step, fraction, 1 - fraction)"
DENSE, XOR = (
    "corner @ res ** np.arange(D)",
    "np.bitwise_xor.reduce(corner.astype(np.uint32) * PRIMES[:D], axis=2)",
)
NODES = {
    "hash-grid-cube": [("extent = (hi - lo)[axis]", "extent = np.repeat(np.max(hi - lo), D)")],
    "hash-grid-res": [(PLACE, "np.clip(u, 0, 1) * res")],
    "hash-grid-cells": [(PLACE, "np.clip(np.clip(u, 0, 1) * res - 0.5, 0, res - 1)")],
    "hash-grid-nearest": [(PLACE, "np.rint(np.clip(u, 0, 1) * (res - 1))")],
    "hash-grid-mirrored": [(WEIGHT, "np.where(step, 1 - fraction, fraction)")],
    "hash-grid-dense-order": [(DENSE, "corner[:, :, ::-1] @ res ** np.arange(D)")],
    "hash-grid-never-dense": [("if res**D <= table:", "if table == 0:")],
    "hash-grid-modulo-first": [(XOR, XOR.replace("[:D]", "[:D] % np.uint32(table)"))],
    "hash-grid-prime-order": [
        (
            "np.array([1, 2654435761, 805459861], np.uint32)",
            "np.array([1, 805459861, 2654435761], np.uint32)",
        )
    ],
    "hash-grid-no-wrap": [
        (XOR, "np.bitwise_xor.reduce(corner * PRIMES[:D].astype(np.int64), axis=2)"),
        ("hashed % np.uint32(table)", "hashed % table"),
    ],
    "hash-grid-added": [
        (XOR, XOR.replace("bitwise_xor", "add").replace("axis=2", "axis=2, dtype=np.uint32"))
    ],
}

PRICE, ENTROPY = "own * math.log1p(other / own) for own, other", "entropy(n_pos, n - n_pos), dtype)"
EACH, COUNT = "0.5 * np.log2((res.n - res.n_pos) / res.n_pos)", "np.count_nonzero(grid >= 0)"
THROUGH = "np.where(np.abs(grid) <= 1, slope, 0)"
HASH_RATE = {
    "hash-rate-crossed": [
        (PRICE, "own * math.log1p(own / other) for own, other"),
        ("(n_neg, n_pos)) if own)", "(n_neg, n_pos)) if n_pos and n_neg)"),
        (
            EACH,
            "0.5 * (np.log2(res.n_pos / (res.n - res.n_pos)) + (res.n_pos / (res.n - res.n_pos)\n"
            "                   - (res.n - res.n_pos) / res.n_pos) / math.log(2))",
        ),
    ],
    "hash-rate-nats": [
        (" if own) / math.log(2)", " if own)"),
        (EACH, "0.5 * np.log((res.n - res.n_pos) / res.n_pos)"),
    ],
    "hash-rate-per-entry": [
        (ENTROPY, "np.divide(entropy(n_pos, n - n_pos), n), dtype)"),
        (EACH, EACH + " / res.n"),
    ],
    "hash-rate-strict": [(COUNT, "np.count_nonzero(grid > 0)")],
    "hash-rate-clamp": [
        (ENTROPY, "clamped_entropy(n_pos, n - n_pos), dtype)"),
        (
            "\n\ndef forward(",
            "\n\ndef clamped_entropy(n_pos, n_neg):\n"
            "    p = np.clip(n_pos / max(n_pos + n_neg, 1), 1e-6, 1 - 1e-6)\n"
            "    return -(n_pos * np.log2(p) + n_neg * np.log2(1 - p))\n\n\ndef forward(",
        ),
    ],
    "hash-rate-by-level": [
        (ENTROPY, "sum(entropy(int((g >= 0).sum()), int((g < 0).sum())) for g in grids), dtype)"),
        (
            "    # dR/dN+ =",
            "    return {'grids': [backward_of_level(g, R_hash_bar) for g in res.grids]}\n    # dR/dN+ =",
        ),
        (
            "\n\ndef backward(",
            "\n\ndef backward_of_level(g, bar):\n"
            "    p, m = int((g >= 0).sum()), int((g < 0).sum())\n"
            "    slope = float(bar) * math.log2(m / p) / 2 if p and m else 0.0\n"
            "    return (slope * (np.abs(g) <= 1)).astype(g.dtype)\n\n\ndef backward(",
        ),
    ],
    "hash-rate-straight-through": [(THROUGH, "np.full(grid.shape, slope)")],
    "hash-rate-whole-sign": [(EACH, EACH.replace("0.5 * ", ""))],
}

PATCHES = {
    "equations/noise.py": NOISE,
    "equations/step.py": STEP,
    "equations/rounding.py": ROUNDING,
    "equations/likelihood.py": LIKELIHOOD,
    "equations/prior.py": PRIOR,
    "equations/anchor_rate.py": ANCHOR_RATE,
    "equations/hash_grid.py": GRID,
    "equations/grid_nodes.py": NODES,
    "equations/hash_rate.py": HASH_RATE,
}
