# %% [markdown]
# # Eq. (13), Eq. (14) and Eq. (17): the rate
#
# **Promise.** After this tutorial you can add up the bits of a model, with masked Gaussians left
# out, and explain which gradient every parameter receives from the rate. **Before it:**
# `09_hash_grid`, `10_prior_and_likelihood`. **Takes** four seconds of machine time on two cores, 25
# minutes of reading and 40 of exercises.
#
# **Files:** Eq. (13) [anchor_rate.py](../p4dgs_ref/equations/anchor_rate.py), Eq. (14)
# [hash_rate.py](../p4dgs_ref/equations/hash_rate.py), Eq. (17)
# [rate_loss.py](../p4dgs_ref/equations/rate_loss.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, panels, show, tour

plt = figures.pyplot()
architecture.show("11_rate")
rng = np.random.default_rng(11)

# %% [markdown]
# ## What fails without it
# A picture does not say how many bits it cost. Training that sees only pictures therefore spends
# bits wherever they help at all. It saves bits only if the loss contains their sum, whose gradient
# reaches every number.
#
# Both files below were trained on `bouncing` in the same way, one of them without the rate. Without
# the rate, the numbers and signs take 3.5 times as many bytes, and the test views gain only 0.2 dB.

# %%
from p4dgs_ref.equations import likelihood
from p4dgs_ref.report.inspect import components, float_context, ledger, symbol_bits

IN_13 = ("features", "scales", "offset_scales", "offsets")
COUNTED = (*IN_13, "hash_grid")
rated, free = (components(data) for data in (tour.DATA, tour.place_of("no rate").read_bytes()))
more = sum(free[name] for name in COUNTED) / sum(rated[name] for name in COUNTED)
print(f"{more:.2f} times as many bytes")
assert 3.45 < more < 3.55

# %%
figure, ax = plt.subplots(figsize=(9, 4), layout="constrained")
for sizes, color, height in ((free, show.PALE, 0.8), (rated, show.RATE, 0.4)):
    ax.barh(COUNTED, [sizes[name] for name in COUNTED], height, color=color)
ax.invert_yaxis()
ax.set(xlabel="bytes in the file", title="pale: trained without the rate, pink: with it")
figures.show(figure, "11_without_rate")

# %% [markdown]
# ## Claim
# Independent symbols cost the sum of their bits. For the anchors this sum is
# $$R_{\rm anchor} = \sum_a (-\log_2 p(\tilde{f}_a) - \log_2 p(\tilde{\mathbf{O}}_a)
# - \log_2 p(\tilde{l}_a) - \log_2 p(\tilde{s}_a)). \tag{13}$$
# Of the grid's $N$ entries, $N_+$ are $+1$ and $N_-$ are $-1$. All of them share one probability,
# which is given by their counts, $p_\pm = N_\pm/N$:
# $$R_{\rm hash} = N_+(-\log_2(p_+)) + N_-(-\log_2(p_-)) \tag{14}$$
# $$\mathcal{L}_{\rm rate} = R_{\rm anchor} + R_{\rm hash} \tag{17}$$
# Training minimises the loss of the pictures, $\mathcal{L}_{\rm render}$, plus this rate times a
# weight, $\lambda_{\rm rate}$: the price of a bit, in units of the loss. This sum is Eq. (15), the
# subject of `12_rate_distortion`.

# %% [markdown]
# ## By hand
# Take a grid of 8 entries, 6 of them positive. Each positive entry costs $\log_2\frac{8}{6} =
# 0.415$ bits, and each negative one $\log_2\frac{8}{2} = 2$ bits. Together they cost 6.490 bits,
# whereas the plain signs would take 8 bits.

# %%
by_hand = 6 * np.log2(8 / 6) + 2 * np.log2(8 / 2)
print(f"{by_hand:.3f} bits")

# %% [markdown]
# ## In code
# `anchor_rate` receives the bits of Eq. (11) in four arrays and the mask of the children, `[A, k]`.
# Children that are hardly ever visible are masked for good (choice `Q15`). Their offsets are not in
# the file, so they cost nothing.

# %%
from p4dgs_ref.equations import anchor_rate, hash_rate, rate_loss
from p4dgs_ref.lessons import close, inner, random_like, shift

# paper, Sec. 3.3: the sum of the bits of f, O, l and s over all anchors, and those of the grid
# silent: Q12, divided by the number of parameters; Q15, masked offsets cost nothing
A, k, d = 5, 4, 7
bits = {
    "bits_f": rng.gamma(2, size=(A, d)),
    "bits_s": rng.gamma(2, size=(A, 3)),
    "bits_l": rng.gamma(2, size=(A, 3)),
    "bits_O": rng.gamma(2, size=(A, k, 3)),
}
mask = rng.random((A, k)) < 0.7
R_anchor, anchor_saved = anchor_rate.forward(**bits, mask=mask)
one_by_one = 0
for a in range(A):
    one_by_one += bits["bits_f"][a].sum() + bits["bits_s"][a].sum() + bits["bits_l"][a].sum()
    for j in range(k):
        if mask[a, j]:
            one_by_one += bits["bits_O"][a, j].sum()
assert not mask.all()
assert close(R_anchor, one_by_one)

# %% [markdown]
# `hash_rate` receives the levels as a list of arrays `[T, F]` and counts over all of them together.
# A parameter of 0 counts as $+1$. `rate_loss` adds the two rates. It also divides their sum by the
# number of parameters of all anchors, $A(d + 6 + 3k)$ (choice `Q12`).

# %%
grids = [np.array([[0.0, -0.4], [0.9, 0.2], [1.7, 0.1]]), np.array([[0.6, -1.3]])]
(R_hash, n_pos, n_neg), _ = hash_rate.forward(grids)
assert (n_pos, n_neg) == (6, 2)
assert close(R_hash, by_hand)

n_parameters = A * (d + 6 + 3 * k)
(total_bits, L_rate), rate_saved = rate_loss.forward(R_anchor, R_hash, n_parameters)
assert total_bits == R_anchor + R_hash
assert L_rate == total_bits / n_parameters

# %% [markdown]
# **Why divide?** The rendering loss is a mean over pixels, but the rate is a sum over anchors. With
# the same $\lambda_{\rm rate}$, a scene of twice as many anchors would give the rate twice the
# weight. The number of bits per parameter does not grow with the scene, so one list of values of
# $\lambda_{\rm rate}$ works for all scenes.
#
# **Why divide by all parameters, and not by those in the file?** Suppose that masking removes
# offsets that cost fewer bits than the average parameter. The file gets shorter, but the mean over
# the remaining parameters rises. The loss would then punish a change that saves bits.

# %%
cheap = {**bits, "bits_O": np.full((A, k, 3), 0.5)}
all_children = np.ones((A, k), bool)
without_last = np.tile(np.arange(k) < k - 1, (A, 1))
before, _ = anchor_rate.forward(**cheap, mask=all_children)
after, _ = anchor_rate.forward(**cheap, mask=without_last)
in_file = A * (d + 6 + 3 * (k - 1))
assert after < before
assert after / in_file > before / n_parameters
assert after / n_parameters < before / n_parameters

# %% [markdown]
# ## Backward by hand
# Eq. (17) and Eq. (13) are sums. Every number of bits that is counted receives the cotangent of the
# sum, and a masked one receives 0. Let $\overline{total}$ be the cotangent of $R_{\rm anchor} +
# R_{\rm hash}$ before dividing, and $m$ a mask that is 0 for masked offsets and 1 for all other
# numbers. Then
# $$\bar R_{\rm anchor} = \bar R_{\rm hash}
# = \frac{\bar{\mathcal{L}}_{\rm rate}}{A(d + 6 + 3k)} + \overline{total}, \qquad
# \overline{bits}_{aj} = m_{aj}\,\bar R_{\rm anchor}.$$

# %%
top = rate_loss.backward(rate_saved, bits_bar=np.float64(0.3), L_rate_bar=np.float64(-2.0))
R_anchor_bar = top["R_anchor"]
assert R_anchor_bar == top["R_hash"] == 0.3 - 2.0 / n_parameters

ours = anchor_rate.backward(anchor_saved, R_anchor_bar)
assert (ours["bits_O"][mask] == R_anchor_bar).all()
assert (ours["bits_O"][~mask] == 0).all()
move = random_like(rng, bits)
moved, _ = anchor_rate.forward(**shift(bits, move, 1), mask=mask)  # linear: any step
change = R_anchor_bar * (moved - R_anchor)
assert close(change, inner(ours, move), 1e-10)

# %% [markdown]
# For Eq. (14), we treat the rate as a function of $N_+$ alone, with $N_- = N - N_+$ and
# $R = N_+\log_2\frac{N}{N_+} + N_-\log_2\frac{N}{N_-}$:
# $$\frac{dR}{dN_+} = \log_2\frac{N}{N_+} - \frac{1}{\ln 2} - \log_2\frac{N}{N_-} + \frac{1}{\ln 2}
# = \log_2\frac{N_-}{N_+}$$
# One more $+1$ makes every $+1$ cheaper and every $-1$ more expensive. To first order these two
# changes, $\mp\frac{1}{\ln 2}$, cancel.
#
# An entry's sign $B$ contributes $\frac{1}{2}(1 + B)$ to $N_+$, which is 0 for $-1$ and 1 for $+1$.
# Each entry therefore gets half of this slope. From $B$ to the parameter $\theta$ the gradient goes
# straight through, as in Eq. (9):
# $$\bar\theta = \tfrac{1}{2}\log_2\frac{N_-}{N_+}\;\bar R_{\rm hash}
# \quad\text{where } |\theta| \le 1, \text{ otherwise } 0$$


# %%
def rate_of(n_pos, N=8):
    """Return Eq. (14) for a number of positive entries that need not be an integer."""
    n_neg = N - n_pos
    return n_pos * np.log2(N / n_pos) + n_neg * np.log2(N / n_neg)


difference = (rate_of(6 + 1e-5) - rate_of(6 - 1e-5)) / 2e-5
assert close(difference, np.log2(2 / 6), 1e-8)


def hash_gradients(grids, R_hash_bar):
    """Return the gradients of the grids by the equation's own backward."""
    _, saved = hash_rate.forward(grids)
    return hash_rate.backward(saved, R_hash_bar)["grids"]


ours = hash_gradients(grids, 1.7)
for gradient, grid in zip(ours, grids):
    inside = np.abs(grid) <= 1
    assert close(gradient[inside], 0.5 * difference * 1.7, 1e-7)
    assert not gradient[~inside].any()

# %% [markdown]
# All entries within $\pm 1$ feel the same pull, towards the sign of the *majority*. In the cell
# below, the rate alone trains a grid until all signs are equal, which costs 0 bits. At this point
# the slope is infinite, and the code returns 0. In a real model, different signs survive because
# $h$ has to tell anchors apart.

# %%
theta = rng.uniform(-0.3, 0.5, (200, 1))
positive = []
for _ in range(300):
    theta = theta - 0.003 * hash_gradients([theta], 1.0)[0]
    positive.append(np.count_nonzero(theta >= 0))
assert positive == sorted(positive)
assert positive[-1] == 200
(R_of_equal_signs, _, _), _ = hash_rate.forward([theta])
assert R_of_equal_signs == 0
assert not hash_gradients([theta], 1.0)[0].any()

# %% [markdown]
# The two panels on the left show the mean cost of a sign and the slope that all signs feel; they
# have different units. The slope is infinite at both ends, so its axis is cut. The dot is the grid
# of the demo's file. The panel on the right shows what anchor 29 adds to Eq. (13), number by
# number. The gap is where the offsets of its masked child would be. Together with the anchor's
# position, three times 16 bits, these are some 24 bytes.

# %%
thread = figures.THREAD
bits_29 = symbol_bits(tour.FILE)[thread.index]
of_groups = dict(zip(IN_13, np.split(bits_29, np.cumsum(tour.DESIGN.widths)[:-1])))
for name, group in of_groups.items():
    print(f"{name}: {group.sum():.1f} bits")
print(f"{thread.name}: {bits_29.sum():.1f} bits, {bits_29.sum() / 8:.1f} bytes")
positive_share = np.mean(np.concatenate(tour.MODEL.grids) >= 0)

# %%
panels.bits_of_signs_and_anchor(positive_share, of_groups)

# %% [markdown]
# ## Break it
# Suppose we apply the mask by multiplying, `bits_O * mask`. The result is the same until a masked
# child lies so far from its mean that its bits are infinite, which happens if Eq. (11) is computed
# as printed. Zero times infinity is NaN, and so is the whole rate. Masked values are not even read
# by the selection `np.where(mask[:, :, None], bits_O, 0)`.


# %%
def multiplied(bits_f, bits_O, bits_l, bits_s, mask):
    of_children = (bits_O * mask[:, :, None]).sum()
    return bits_f.sum() + of_children + bits_l.sum() + bits_s.sum()


assert close(multiplied(**bits, mask=mask), R_anchor)
with np.errstate(invalid="ignore"):
    lessons.check_mistake(multiplied, "anchor_rate", "infinite_behind_the_mask")

# %% [markdown]
# ## What a codec does with it
# The rate is an estimate; what counts is the file. In the demo's file, each section is 5 to 13
# bytes longer than the equations say, because it also holds the last state of the coder and a short
# header, and ends with a whole byte. Positions, masks and networks are in no equation. [See it
# move](viewer/demo.html#step=bits): the bits of each anchor in colour, and what fewer would cost.

# %%
for section in ledger(tour.DATA):
    if section["name"] in COUNTED:
        estimate, actual = section["estimate_bytes"], section["bytes"]
        print(f"{section['name']}: {estimate:.1f} bytes by the equation, {actual} in the file")
        assert 5 < actual - estimate < 13
counted = sum(rated[name] for name in COUNTED)
print(f"Eq. (17) describes {100 * counted / len(tour.DATA):.0f} % of this file of 199 anchors")

# %% [markdown]
# Between the estimate of training and the bytes lie four stages. Training adds noise, the file
# rounds; the coder uses integer tables; each stream ends in whole words of the coder; each section
# has a header. The first two change the sum by less than a percent, the other two by a few bytes
# for each stream, which weighs less in a larger file.

# %%
sections = [section for section in ledger(tour.DATA) if section["name"] in IN_13]
context, widths = float_context(tour.MODEL), tour.DESIGN.widths
q = np.repeat(context.q, widths, axis=1)
u = rng.random(q.shape) - 0.5
noisy = (tour.FILE.symbols + u) * q
with_noise, _ = likelihood.forward(noisy, context.mu, context.sigma, q)
stages = {"with noise": with_noise[tour.FILE.kept].sum() / 8}
columns = {"rounded": "estimate", "integer tables": "integer", "coded": "payload"}
for stage, column in columns.items():
    stages[stage] = sum(section[f"{column}_bytes"] for section in sections)
stages["sections"] = sum(section["bytes"] for section in sections)
print(", ".join(f"{stage}: {size:.1f}" for stage, size in stages.items()), "bytes")
ratios = np.array([*stages.values()]) / stages["rounded"]
assert (np.abs(ratios - 1) < (0.01, 1e-9, 0.001, 0.02, 0.02)).all()

# %% [markdown]
# ## What this idea buys
# With twenty times the price $\lambda_{\rm rate}$ of a bit, our anchors take 2,538 bytes instead of
# 4,569. The paper also shows T-Rex at two prices, without their values (Table 4): there the anchors
# take 0.224 and 0.596 MB, positions included. Only the parts that Eq. (17) counts become smaller.
# Positions and networks stay as they are, and they are nearly all of our file and four fifths of
# the paper's smaller one.

# %%
from tutorials import gains

rows = {"price 0.01": "p4dgs lambda_rate=0.01", "price 0.0005": "p4dgs"}
sizes = [round(gains.mean(label, "gaussians_bytes", "curve")) for label in rows.values()]
assert sizes == [2538, 4569]
paper = {"low rate": (0.224, "of 0.506 MB"), "high rate": (0.596, "of 0.857 MB")}
gains.show("11_rate", rows, paper, "curve")

# %% [markdown]
# **In short**
# - The rate is a sum of bits: those of every coded number by Eq. (11), and those of the grid's
#   signs by their counts.
# - Every bit has the same price, whichever number it belongs to. A masked offset costs nothing.
# - Divided by the number of parameters, the rate has the same weight in small and large scenes.
#
# **Often misunderstood**
# - *Eq. (17) is the size of the file.* Positions, masks, networks and headers are not in it.
# - *Masks are the paper's.* It says only that children with low opacity are dropped; a mask in the
#   file is this project's choice `Q15`.
# - *A grid of equal signs would be the best.* It costs 0 bits, but it no longer tells anchors
#   apart.

# %% [markdown]
# ## Exercises
# **11.1** ●● A hundred anchors have $d = 4$ and $k = 5$, each of their numbers costs 3 bits, and
# $R_{hash} = 0$. Then one child of each anchor is masked. Give a list of four numbers:
# $\mathcal{L}_{rate}$ before and after, then its slope in the bits of one number that is not
# masked, before and after.
#
# **11.2** ●● Write the backward of Eq. (14). All levels have the same slope, which depends on the
# signs of all levels.
#
# **11.3** ●● Suppose that every level of the grid gets a $p_+$ of its own. What changes in the
# gradient? Two levels have $8$ signs each; the first has $2$ positive signs and the second $6$, and
# all $|\theta| < 1$. Give the slopes `[2, 2]` of $R_{hash}$ in a $\theta$ of the first and of the
# second level: in the first row with one $p_+$ for both levels, in the second row with two.
#
# **11.4** ●● Write the whole rate, Eqs. (11), (13), (14) and (17), with `likelihood` of
# `p4dgs_ref.equations`.
#
# **Predict, then run.** Every parameter of the hash grid changes its sign. What happens to
# $R_{hash}$, and what to its gradient?

# %%
answer_1 = ...
answer_3 = ...


def my_hash_backward(inputs, cotangents):
    """Return {"grids": list of gradients [T, F]}; they are 0 if all signs agree.

    inputs["grids"] are the parameters, and cotangents["R_hash_bar"] is a number.
    """
    raise NotImplementedError


def my_rate(noisy, mu, sigma, q, mask, grids, d, k):
    """Return {"bits", "L_rate"}.

    noisy, mu and sigma are [A, n] with the columns f, s, l, O; q is [A, 4], mask [A, k], and grids
    is a list of arrays [T, F]. A sign is +1 where the entry is >= 0. Masked offsets cost no bits.
    L_rate is bits divided by the count of all numbers, the masked ones included.
    """
    raise NotImplementedError


lessons.check_number("11.1", answer_1)
lessons.check_backward("11.2", my_hash_backward, "hash_rate")
lessons.check_number("11.3", answer_3)
lessons.check_forward("11.4", my_rate, "rate_stage")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only anchor_rate`, `--only hash_rate` and `--only rate_loss` compare
# what a port wrote. The usual mistakes are one $p_+$ for each level instead of one for all, a
# forgotten factor $\frac{1}{2}$, and the logarithm of $p_+ = 0$ if all signs agree.


# %%
lessons.passes("anchor_rate", "hash_rate", "rate_loss")
