# %% [markdown]
# # Eq. (13), Eq. (14) and Eq. (17): the rate
#
# **Promise.** After this you can add up a model's bits, masks included, and say what the rate asks of every parameter.
# **Before it:** `09_hash_grid`, `10_prior_and_likelihood`. **Takes** two seconds on two cores, half an hour of yours.

# %%
import numpy as np

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.equations import anchor_rate, hash_rate, rate_loss
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
rng = np.random.default_rng(11)

# %% [markdown]
# ## Claim
# Independent symbols cost the sum of their prices. The anchors cost
# $$R_{\rm anchor} = \sum_a (-\log_2 p(\tilde{f}_a) - \log_2 p(\tilde{\mathbf{O}}_a) - \log_2 p(\tilde{l}_a)
# - \log_2 p(\tilde{s}_a)) \tag{13}$$

# %% [markdown]
# The grid's $N$ entries are $+1$ ($N_+$ of them) or $-1$ ($N_-$). All share one $p_+$, which they define: $p_\pm = N_\pm/N$.
# $$R_{\rm hash} = N_+(-\log_2(p_+)) + N_-(-\log_2(p_-)) \tag{14}$$
# $$\mathcal{L}_{\rm rate} = R_{\rm anchor} + R_{\rm hash} \tag{17}$$

# %% [markdown]
# ## By hand
# A grid of 8 entries, 6 of them positive: each of those costs $\log_2\frac{8}{6}$, 0.415 bits, each negative one 2 bits.
# Together 6.490 bits, where 8 bits would store the signs plainly.

# %%
assert round(np.log2(8 / 6), 3) == 0.415 and np.log2(8 / 2) == 2
by_hand = 6 * np.log2(8 / 6) + 2 * np.log2(8 / 2)
assert f"{by_hand:.3f}" == "6.490" and by_hand < 8 and abs(by_hand - 6.490) < 5e-4

# %% [markdown]
# ## In code
# `anchor_rate` takes the bits of Eq. (11) in four arrays, `bits_f (A, d)`, `bits_O (A, k, 3)`, `bits_l (A, 3)`, `bits_s (A, 3)`,
# and `mask (A, k)`: children that are hardly ever visible are masked for good (choice Q15); their offsets are not in the
# file and cost nothing.

# %%
A, k, d = 5, 4, 7
bits = dict(
    bits_f=rng.gamma(2, size=(A, d)),
    bits_O=rng.gamma(2, size=(A, k, 3)),
    bits_l=rng.gamma(2, size=(A, 3)),
    bits_s=rng.gamma(2, size=(A, 3)),
)
mask = rng.random((A, k)) < 0.7
anchors, anchors_res = anchor_rate.forward(**bits, mask=mask)
one_by_one = sum(bits[name][a].sum() for a in range(A) for name in ("bits_f", "bits_l", "bits_s"))
one_by_one += sum(bits["bits_O"][a, j].sum() for a in range(A) for j in range(k) if mask[a, j])
assert (
    np.isclose(anchors.R_anchor, one_by_one, rtol=1e-14)
    and anchors.R_anchor.shape == ()
    and not mask.all()
)

# %% [markdown]
# `hash_rate` takes the levels `[(T, F), ...]` and counts over all of them together; a parameter of 0 counts as $+1$.
# `rate_loss` adds the two, and also divides by the number of the anchors' parameters, $A(d + 6 + 3k)$ (choice Q12).

# %%
grids = [np.array([[0.0, -0.4], [0.9, 0.2], [1.7, 0.1]]), np.array([[0.6, -1.3]])]
grid, grid_res = hash_rate.forward(grids)
assert grid.n_pos == 6 and grid.n_neg == 2 and np.isclose(grid.R_hash, by_hand, rtol=1e-15)
assert hash_rate.forward([np.zeros((1, 1))])[0].n_pos == 1  # a parameter of 0
total, total_res = rate_loss.forward(anchors.R_anchor, grid.R_hash, A * (d + 6 + 3 * k))
assert total.bits == anchors.R_anchor + grid.R_hash and total.L_rate == total.bits / (
    A * (d + 6 + 3 * k)
)

# %% [markdown]
# **Why divide?** The rendering loss is a mean over pixels, the rate a sum over anchors. Under one $\lambda_{\rm rate}$ a scene
# of twice the anchors would feel twice the pressure. Bits per parameter do not grow with the scene, so one list of
# $\lambda_{\rm rate}$ serves all.

# %%
twice = anchor_rate.forward(
    **{n: np.concatenate([b, b]) for n, b in bits.items()}, mask=np.concatenate([mask, mask])
)[0]
assert np.isclose(twice.R_anchor, 2 * anchors.R_anchor, rtol=1e-14)
per_number = [
    rate_loss.forward(R, np.float64(0), a * (d + 6 + 3 * k))[0].L_rate
    for R, a in ((anchors.R_anchor, A), (twice.R_anchor, 2 * A))
]
assert np.isclose(*per_number, rtol=1e-14)

# %% [markdown]
# **All anchors, masked offsets counted.** Divide by the *coded* numbers instead, and masking children whose offsets cost less
# than the mean would raise the loss, though it shortens the file.

# %%
cheap = {**bits, "bits_O": np.full((A, k, 3), 0.5)}
before, after = (
    anchor_rate.forward(**cheap, mask=np.arange(k) < kept + np.zeros((A, 1)))[0].R_anchor
    for kept in (k, k - 1)
)
assert after < before  # fewer bits
assert after / (A * (d + 6 + 3 * (k - 1))) > before / (
    A * (d + 6 + 3 * k)
)  # over coded numbers: a higher loss
assert after / (A * (d + 6 + 3 * k)) < before / (
    A * (d + 6 + 3 * k)
)  # over all numbers: a lower one

# %% [markdown]
# ## Backward by hand
# Eq. (17) and Eq. (13) are sums: every kept number of bits receives what the sum receives, a masked one receives 0. With
# $n$ parameters, $bits$ for the undivided output, and $m$ the mask, $1$ for all that are no offsets:
# $$\bar R_{\rm anchor} = \bar R_{\rm hash} = \frac{\bar{\mathcal L}_{\rm rate}}{n} + \overline{bits}, \qquad
# \bar b_{aj} = m_{aj}\,\bar R_{\rm anchor}$$

# %% [markdown]
# In code: `np.full(shape, R_anchor_bar)`, then `bars["bits_O"][~res.mask] = 0`. The function is linear: any step checks it.

# %%
n = A * (d + 6 + 3 * k)
top = rate_loss.backward(total_res, bits_bar=np.float64(0.3), L_rate_bar=np.float64(-2.0))
assert top["R_anchor"] == top["R_hash"] == 0.3 - 2.0 / n
bars = anchor_rate.backward(anchors_res, top["R_anchor"])
assert (bars["bits_f"] == top["R_anchor"]).all() and bars["bits_f"].shape == (A, d)
assert (bars["bits_O"][mask] == top["R_anchor"]).all() and (bars["bits_O"][~mask] == 0).all()
move = {name: rng.normal(size=b.shape) for name, b in bits.items()}
change = (
    anchor_rate.forward(**{m: b + move[m] for m, b in bits.items()}, mask=mask)[0].R_anchor
    - anchors.R_anchor
)
assert np.isclose(
    top["R_anchor"] * change, sum((bars[m] * move[m]).sum() for m in bits), rtol=1e-10
)  # linear

# %% [markdown]
# Eq. (14), as a function of $N_+$ alone, with $N_- = N - N_+$ and $R = N_+\log_2\frac{N}{N_+} + N_-\log_2\frac{N}{N_-}$:
# $$\frac{dR}{dN_+} = \log_2\frac{N}{N_+} - \frac{1}{\ln 2} - \log_2\frac{N}{N_-} + \frac{1}{\ln 2} = \log_2\frac{N_-}{N_+}$$
# One more $+1$ makes all $+1$ cheaper and all $-1$ dearer; to first order the two changes, $\mp\frac{1}{\ln 2}$, cancel.

# %%
R = lambda n_pos, N=8: n_pos * np.log2(N / n_pos) + (N - n_pos) * np.log2(N / (N - n_pos))
assert np.isclose((R(6 + 1e-5) - R(6 - 1e-5)) / 2e-5, np.log2(2 / 6), rtol=1e-8)

# %% [markdown]
# Each entry is counted in $N_+$ by its sign $b$: $N_+ = \sum \frac{1}{2}(1 + b)$, since the way from $-1$ to $+1$ is 2 long and
# counts one. So each entry gets half the slope; and from $b$ to $\theta$ it goes straight through, as in Eq. (9):
# $$\bar\theta = \tfrac{1}{2}\log_2\frac{N_-}{N_+}\;\bar R_{\rm hash} \quad\text{where } |\theta| \le 1, \text{ else } 0$$

# %%
R_hash_bar = 1.7
grid_bars = hash_rate.backward(grid_res, R_hash_bar)["grids"]
slope = 0.5 * np.log2(2 / 6) * R_hash_bar
for bar, g in zip(grid_bars, grids):
    assert np.allclose(bar, slope * (np.abs(g) <= 1), rtol=1e-14)
assert 1 - -1 == 2 and all((bar[np.abs(g) > 1] == 0).all() for bar, g in zip(grid_bars, grids))
smooth, move = hash_rate.surrogate(grids), [rng.normal(size=g.shape) for g in grids]
up, down = (smooth([g + s * 1e-6 * e for g, e in zip(grids, move)]).R_hash for s in (1, -1))
assert np.isclose(
    R_hash_bar * (up - down) / 2e-6, sum((b * e).sum() for b, e in zip(grid_bars, move)), rtol=1e-7
)

# %% [markdown]
# All entries within $\pm 1$ feel the same pull, toward the sign of the *majority*. Below, the rate alone makes all signs equal,
# for 0 bits. There the slope is infinite, and the code returns 0. What keeps signs apart is that $h$ must predict something.

# %%
theta, majority = rng.uniform(-0.3, 0.5, (200, 1)), []
for _ in range(300):
    out, res = hash_rate.forward([theta])
    theta = theta - 0.003 * hash_rate.backward(res, 1.0)["grids"][0]
    majority.append(int(out.n_pos))
assert majority == sorted(majority) and majority[-1] == 200 and out.R_hash == 0
assert (hash_rate.backward(hash_rate.forward([theta])[1], 1.0)["grids"][0] == 0).all()

# %% [markdown]
# The picture: left, the mean price of a sign and the slope that all signs feel; right, a real file (bars) beside the sum (black
# marks). The model is that of the golden vectors, whose numbers were drawn, not trained.

# %%
from p4dgs_ref.codec.inspect import ledger

IN_13, IN_14 = ("features", "scales", "offset_scales", "offsets"), ("hash_grid",)
rows = ledger((oracle.path() / "model.p4dgs").read_bytes())
share = np.linspace(0.005, 0.995, 199)
price = -share * np.log2(share) - (1 - share) * np.log2(1 - share)
figure, axes = plt.subplots(1, 2, figsize=(13.5, 5), layout="constrained", width_ratios=(1, 1.15))
axes[0].plot(share, price, color=lessons.COLORS[0], label="bits per entry, $R_{hash}/N$")
axes[0].plot(
    share,
    0.5 * np.log2((1 - share) / share),
    "--",
    color=lessons.COLORS[1],
    label=r"slope in $\theta$ (bits)",
)
axes[0].plot(6 / 8, by_hand / 8, "ko", ms=9, label="by hand: 6 of 8")
axes[0].axhline(0, color="0.4", lw=1)
axes[0].set(
    xlabel="share of positive entries $p_+$",
    ylabel="bits",
    ylim=(-2.6, 2.6),
    title="Descent drives signs to the majority",
)
axes[0].legend(loc="lower left", fontsize=11)
for y, row in enumerate(reversed(rows)):
    color = lessons.COLORS[0 if row["name"] in IN_13 else 4 if row["name"] in IN_14 else 5]
    axes[1].barh(y, row["bytes"], color=color, alpha=1 if color != lessons.COLORS[5] else 0.5)
    if row["name"] in IN_13 + IN_14:
        axes[1].plot(row["estimate_bytes"], y, "k|", ms=16, mew=3)
for color, alpha, label in (
    (0, 1, "in Eq. (13)"),
    (4, 1, "in Eq. (14)"),
    (5, 0.5, "in the file, in no equation"),
):
    axes[1].barh(0, 0, color=lessons.COLORS[color], alpha=alpha, label=label)
axes[1].plot([], [], "k|", ms=14, mew=3, ls="", label="by the equation")
axes[1].set(
    xscale="log",
    xlim=(20, 6000),
    xlabel="bytes (log scale)",
    title="What the rate sees, and what it does not",
)
axes[1].set_yticks(range(len(rows)), [row["name"] for row in reversed(rows)])
axes[1].legend(loc="upper right", fontsize=11)
lessons.show(figure, "11_rate")

# %% [markdown]
# ## Break it
# Apply the mask by multiplying: `bits_O * mask`. It looks the same, and is, until a masked child far from its mean costs infinite
# bits, as Eq. (11) does when computed as printed: 0 times infinity is no number, and the whole rate is gone.
# The selection `np.where(mask[:, :, None], bits_O, 0)` never asks.


# %%
def multiplied(bits_f, bits_O, bits_l, bits_s, mask):
    return bits_f.sum() + (bits_O * mask[:, :, None]).sum() + bits_l.sum() + bits_s.sum()


assert np.isclose(multiplied(**bits, mask=mask), anchors.R_anchor, rtol=1e-14)
with np.errstate(invalid="ignore"):
    assert np.isnan(0 * np.inf)
    report = oracle.check(multiplied, "anchor_rate")
assert not report.ok and report.first.id == "anchor_rate/infinite_behind_the_mask"
print(report.first.id, "fails:", report.first.explanation)

# %% [markdown]
# ## What a codec does with it
# The sum is an estimate; a file is what counts. Here the coded sections are longer than their equations say by 5 to 10 bytes
# each: the coder's last state, a short header, whole bytes. Positions, masks and networks are in no equation.

# %%
coded = {row["name"]: row for row in rows if row["name"] in IN_13 + IN_14}
extra = [row["bytes"] - row["estimate_bytes"] for row in coded.values()]
assert 5 < min(extra) and max(extra) < 10
print(
    {
        name: f"{row['estimate_bytes']:.1f} by equation, {row['bytes']} in the file"
        for name, row in coded.items()
    }
)
seen = sum(row["bytes"] for row in coded.values()) / sum(row["bytes"] for row in rows)
print(
    f"{100 * seen:.0f} % of this file is in Eq. (17); it has 60 anchors, so its networks outweigh them"
)

# %% [markdown]
# ## Exercises
# **11.1** The backward of Eq. (13). **11.2** The backward of Eq. (14): one slope for all levels, from the signs of all.
# **11.3** Eq. (17): the bits, and the bits per parameter; where there are no parameters, the loss is $0$.


# %%
def my_anchor_backward(inputs, cotangents):
    """{"bits_f", "bits_O", "bits_l", "bits_s"}, from inputs["mask"] (A, k) and cotangents["R_anchor_bar"] ()."""
    raise NotImplementedError


def my_hash_backward(inputs, cotangents):
    """{"grids": [(T, F), ...]}, from inputs["grids"] and cotangents["R_hash_bar"] (); 0 where all signs agree."""
    raise NotImplementedError


def my_rate(R_anchor, R_hash, n_parameters):
    """All () -> bits, L_rate, in this order."""
    raise NotImplementedError


lessons.backward("11.1", my_anchor_backward, "anchor_rate")
lessons.backward("11.2", my_hash_backward, "hash_rate")
lessons.forward("11.3", my_rate, "rate_loss")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only anchor_rate`, `--only hash_rate`, `--only rate_loss`. What goes wrong: one $p_+$ for each
# level instead of one for all, the factor $\frac{1}{2}$ forgotten, and a logarithm of $p_+ = 0$ where all signs agree.

# %%
for key in ("anchor_rate", "hash_rate", "rate_loss"):
    equation = EQUATIONS[key]
    report = oracle.check(
        lambda **i: equation(**i),
        key,
        lambda i, c: equation.backward(equation.forward(**i)[1], **c),
    )
    print(key, report)
    assert report.ok
