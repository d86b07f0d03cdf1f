"""Known mistakes written between equations: {file: {id: [(old text, new text), ...]}}; one may need two files."""

MODEL = {
    "stage-l-and-s-exchanged": [
        ("scale.forward(anchors.s_a,", "scale.forward(anchors.l_a,"),
        ("anchors.O_a, anchors.l_a)", "anchors.O_a, anchors.s_a)"),
        (
            '"l_a": placed["l_a"], "s_a": networks["psi_s"]["s_a"]',
            '"s_a": placed["l_a"], "l_a": networks["psi_s"]["s_a"]',
        ),
    ],
    "stage-offsets-coordinate-major": [
        (
            "    return Context(q.q, p.mu, p.sigma), ",
            "    first = sum(design.widths[:3])\n"
            "    n = np.r_[:first, first + np.arange(3 * design.k).reshape(design.k, 3).T.ravel()]\n"
            "    columns = tuple(c[n] for c in res_p.columns)\n"
            "    res_p = res_p._replace(columns=columns, sigma=res_p.sigma[:, n], free=res_p.free[:, n])\n"
            "    return Context(q.q, p.mu[:, n], p.sigma[:, n]), ",
        )
    ],
}
STAGES = {
    "stage-gradient-through-encoding": [
        (
            'bars["delta_s"], bars["delta_r"], needs_x=False)\n',
            'bars["delta_s"], bars["delta_r"])\n    bars["x"] = bars["x"] + network.pop("x")\n',
        )
    ],
}
CODED = "noisy.shape[0] * (design.d + 6) + 3 * int(mask.sum())"
OBJECTIVE = {
    "stage-steps-exchanged": [
        ("np.repeat(ctx.q, design", "np.repeat(ctx.q[:, [0, 2, 1, 3]], design"),
        (
            'np.add.reduceat(bars["q"], starts, axis=1)',
            'np.add.reduceat(bars["q"], starts, axis=1)[:, [0, 2, 1, 3]]',
        ),
    ],
    "stage-masked-not-counted": [("grid.R_hash, noisy.size)", f"grid.R_hash, {CODED})")],
}
# the stage makes the gradient of bits out of that of L_rate
STAGES_CODING = {
    "stage-masked-not-counted": [("(res, noisy.size, design)", f"(res, {CODED}, design)")]
}

PATCHES = {
    "model.py": MODEL,
    "oracle/stages.py": STAGES,
    "training/objective.py": OBJECTIVE,
    "oracle/stages_coding.py": STAGES_CODING,
}
