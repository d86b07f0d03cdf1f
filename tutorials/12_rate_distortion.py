# %% [markdown]
# # Eq. (15): what training minimises
#
# **Promise.** After this tutorial you can say what the weight of the rate does to a file, to its
# steps and to one anchor, and read a rate-distortion curve. **Before it:** `11_rate`. **Takes** ten
# seconds of machine time on two cores, 20 minutes of reading and 30 of exercises.
#
# **File:** Eq. (15) [total_loss.py](../p4dgs_ref/equations/total_loss.py).

# %%
import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("12_rate_distortion")

# %% [markdown]
# ## What fails without it
# Training on pictures alone makes them good at any price: nothing says when a bit is not worth it.
# Training on the size of the file alone would make an empty file.
#
# The three files below were trained in the same way, with three prices of a bit: none, that of the
# demo, and a hundred times as much. The PSNR is that of this view.

# %%
from p4dgs_ref import decode

figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
for ax, title in zip(axes, ("no rate", "the demo", "rate times 100")):
    data = tour.DATA if title == "the demo" else tour.place_of(title).read_bytes()
    place = tour.CAMERA, tour.T, tour.TRUTH, tour.VIEW
    show.scored_picture(ax, decode(data), data, *place, title)
figures.show(figure, "12_three_prices")

# %% [markdown]
# ## Claim
# One number, $\lambda_{rate}$, says how many units of the pictures' loss a bit is worth. Training
# minimises
# $$\mathcal{L}_{total} = \lambda_{rate}\,\mathcal{L}_{rate} + \mathcal{L}_{render} \tag{15}$$
# (paper, Sec. 3.3). $\mathcal{L}_{render}$ measures how wrong a picture is; its formula, Eq. (16),
# is the subject of `16_render_loss`, and here any measure of the error would do. Every number of
# every anchor feels two pulls, one from the pictures in which the anchor is seen, and one from its
# own bits.
#
# The paper does not state its values of $\lambda_{rate}$ (choices `Q12` and `Q17`). Here
# $\mathcal{L}_{rate}$ is in bits per parameter, so that a value of $\lambda_{rate}$ means the same
# for small and large scenes. The paper's Eq. (17) is the plain sum of the bits. With it, the same
# $\lambda_{rate}$ would give the rate ten times the weight in a scene with ten times as many
# anchors, because $\mathcal{L}_{render}$ is a mean and does not grow with the scene.

# %% [markdown]
# ## By hand
# A number can be coded in three ways. A costs 6 bits and leaves an error of 0.01, B costs 3 bits
# and leaves 0.05, and C costs 1 bit and leaves 0.3. With $\lambda = 0.005$ the cheapest way is A
# ($0.005\cdot 6 + 0.01 = 0.04$), with 0.02 it is B, and with 0.2 it is C. No budget of bits is
# needed.

# %%
ways = {"A": (6, 0.01), "B": (3, 0.05), "C": (1, 0.3)}


def best_way(price):
    return min(ways, key=lambda way: price * ways[way][0] + ways[way][1])


assert [best_way(price) for price in (0.005, 0.02, 0.2)] == ["A", "B", "C"]

# %% [markdown]
# ## In code
# All three quantities are single numbers, and the forward is one line. The demo's scene was trained
# with five prices: 0, the demo's 0.0005, and 4, 16 and 100 times as much. Everything else is equal.
# Each of the five files is decoded. The next cell computes its $\mathcal{L}_{render}$ as a mean
# over the ten test views, which training has not seen, and its $\mathcal{L}_{rate}$ from the
# integers in the file.

# %%
from p4dgs_ref import load_scene
from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.equations import hash_rate, render_loss, total_loss
from p4dgs_ref.lessons import close
from p4dgs_ref.report.inspect import symbol_bits
from p4dgs_ref.training.objective import psnr

# paper, Sec. 3.3: the sum of both losses, with a weight
# silent: Q12, the unit of L_rate, and Q17, the weight
assert close(total_loss.forward(0.07, 2.4, 0.001)[0], 0.001 * 2.4 + 0.07)

DEMO = 0.0005
price_of = {"no rate": 0, "the demo": 1, "rate times 4": 4, "rate times 16": 16}
price_of = {name: DEMO * times for name, times in {**price_of, "rate times 100": 100}.items()}
views = load_scene("bouncing").test
files = {name: tour.place_of(name).read_bytes() for name in price_of if name != "the demo"}
files = {name: files.get(name, tour.DATA) for name in price_of}
decoded = {name: quantised_of(read_container(data)) for name, data in files.items()}


def losses(file):
    """Return L_rate, L_render and PSNR of a file."""
    model, R_anchor = file.model, symbol_bits(file).sum()
    (R_hash, _, _), _ = hash_rate.forward(model.grids)
    pairs = [(model.render(view.camera, view.time), view.image) for view in views]
    wrong = np.mean([render_loss.forward(*pair, 0.2)[0][0] for pair in pairs])
    return (R_anchor + R_hash) / file.symbols.size, wrong, np.mean([psnr(*p) for p in pairs])


rate, distortion, quality = np.transpose([losses(file) for file in decoded.values()])
prices = np.array([*price_of.values()])
for row in zip(prices, rate, distortion, quality, map(len, files.values())):
    print("price {:.4f}: L_rate {:5.2f}, L_render {:.4f}, {:.2f} dB, {} bytes".format(*row))

# %% [markdown]
# ## The price chooses a point
# If training does what Eq. (15) says, every file must be the best of the five at the price for
# which it was trained. The next table computes Eq. (15) of all five files at all five prices. In
# each row the smallest number is on the diagonal.

# %%
totals = total_loss.forward(distortion, rate, prices[:, None])[0]  # [price, file]
for price, row in zip(prices, totals):
    print(f"price {price:.4f}:", "  ".join(f"{total:.4f}" for total in row))
assert totals.argmin(axis=1).tolist() == [0, 1, 2, 3, 4]

# %% [markdown]
# On the left, each file is a point. Of all points, training looks for the one with the smallest
# $\lambda\,\mathcal{L}_{rate} + \mathcal{L}_{render}$. All points with the same sum lie on a line
# of slope $-\lambda$, so the best point is where the lowest such line touches. A steep line touches
# on the left, where bits are few. The curve through such points is the *rate-distortion curve*.
# Between two files its slope must lie between their prices, and it does.
#
# On the right are the bits of *anchor 29*, which is the same anchor in all five files because the
# price acts in the last stage of training only. Its fifth feature, 7 in the demo's file, is 4802
# without a price, and 2, 0 and -1 with the higher ones.

# %%
thread = figures.THREAD
of_29 = {name: symbol_bits(file)[thread.index].sum() for name, file in decoded.items()}
fifth = [int(file.symbols[thread.index, 4]) for file in decoded.values()]
print(f"{thread.name}:", ", ".join(f"{bits:.0f} bits" for bits in of_29.values()))
assert fifth == [4802, 7, 2, 0, -1]
slopes = -np.diff(distortion) / np.diff(rate)
assert ((prices[:-1] < slopes) & (slopes < prices[1:])).all()

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
left.plot(rate, distortion, "o", ms=9, color=show.RATE)
for price, x, y, dx, up in zip(prices, rate, distortion, (3, 2, 1, 1, 0.1), (8, -22, 6, 6, 6)):
    line = np.array([x - dx, x + dx])
    left.plot(line, y - price * (line - x), color=show.GREY, lw=1)
    left.annotate(rf"$\lambda$ = {price:g}", (x, y), (8, up), textcoords="offset points")
left.set(
    xlabel=r"$\mathcal{L}_{rate}$ (bits per number)",
    ylabel=r"$\mathcal{L}_{render}$, test views",
    title=r"a line of slope $-\lambda$ touches at each file",
    xlim=(0, 18),
    ylim=(0.005, 0.032),
)
right.barh([f"{price:g}" for price in prices], of_29.values(), color=thread.color)
for i, (bits, symbol) in enumerate(zip(of_29.values(), fifth)):
    right.text(bits, i, f" {bits:.0f} bits; its fifth feature is {symbol}", va="center")
right.invert_yaxis()
right.set(xlabel="bits", ylabel=r"price $\lambda_{rate}$", title="anchor 29", xlim=(0, 950))
figures.show(figure, "12_rate_distortion")

# %% [markdown]
# ## Backward by hand
# The sum is linear. $\mathcal{L}_{render}$ receives the cotangent of $\mathcal{L}_{total}$, and
# $\mathcal{L}_{rate}$ receives $\lambda_{rate}$ times as much.

# %%
_, saved = total_loss.forward(0.07, 2.4, 0.001)
assert total_loss.backward(saved, 5.0) == {"L_render": 5.0, "L_rate": 0.001 * 5}

# %% [markdown]
# **Which step does training choose?** Consider one number whose step $q$ is small compared with
# $\sigma$. Its noise costs $w q^2/12$ in the pictures (`07_noise_and_rounding`), where $w$ says how
# sensitive they are to it. Its bits are $R = c - \log_2 q$: doubling the step saves one bit
# (`10_prior_and_likelihood`). The best step is where the two derivatives cancel:
# $$\frac{wq}{6} - \frac{\lambda}{q\ln 2} = 0 \quad\Longrightarrow\quad
#   q^* = \sqrt{\frac{6\lambda}{w\ln 2}}.$$
# Four times the price therefore doubles the step, which saves one bit for every number and makes
# its squared error four times as large, 6.02 dB. And a number that matters four times as much gets
# half the step, $q^* \propto w^{-1/2}$.


# %%
def best_step(price, w):
    return np.sqrt(6 * price / (w * np.log(2)))


steps = np.linspace(0.01, 0.5, 4901)
for price in (0.001, 0.004):
    cost = 0.5 * steps**2 / 12 - price * np.log2(steps)
    assert abs(steps[cost.argmin()] - best_step(price, 0.5)) < 1e-4
assert close(best_step(0.004, 0.5), 2 * best_step(0.001, 0.5))

# %% [markdown]
# Do the trained files follow this law? From the demo's price to four times as much, the steps of
# offset scaling and offsets grow by 2.1 and 2.2. Those of features and scales cannot: they come to
# the limit $2Q_0$ of Eq. (8), which all steps reach at 16 times the price. From there on, bits can
# only be saved by numbers that move toward their prediction. If steps are at their limit, a larger
# $Q_0$ is worth a try.

# %%
mean_steps = [file.context.q.mean(axis=0) for file in decoded.values()]
shares = np.array(mean_steps) / decoded["the demo"].model.design.Q_0  # [price, group]
for price, row in zip(prices, shares):
    print(f"price {price:.4f}:", ", ".join(f"{g} {x:.3f} Q_0" for g, x in zip("fslO", row)))
growth = shares[2] / shares[1]
assert np.round(growth[2:], 1).tolist() == [2.1, 2.2]
assert (shares[3:] > 1.99).all()

# %% [markdown]
# ## Break it
# "For the best picture, set $\lambda_{rate} = 0$." The first row above shows what then happens.
# Nothing rewards a coarse step, and the steps of features and offsets shrink to the floor of Eq.
# (8), a thousandth of $Q_0$. Nothing trains $\psi_p$, whose guesses stay random. The numbers and
# signs take 3.5 times as many bytes, and the test views gain 0.2 dB. [See it
# move](viewer/demo.html#step=lambda): the demo's scene at five prices.
#
# A port may also copy the form of a weighted mean, $(1-\lambda)\,\mathcal{L}_{render} +
# \lambda\,\mathcal{L}_{rate}$. With $\lambda = 0.0005$ no training would notice, because the loss
# changes by a two-thousandth of $\mathcal{L}_{render}$. The golden vectors do notice.


# %%
def weighted_mean(L_render, L_rate, lambda_rate):
    return (1 - lambda_rate) * L_render + lambda_rate * L_rate


assert shares[0, [0, 3]].round(3).tolist() == [0.001, 0.001]
assert round(quality[0] - quality[1], 1) == 0.2
lessons.check_mistake(weighted_mean, "total_loss", "1 - lambda_rate")

# %% [markdown]
# ## What a codec does with it
# The quality setting of a video encoder is such a price. It fixes what a bit is worth, and not the
# size of the file: at the same price, a scene with more motion becomes a larger file.
#
# The price acts on the numbers of the anchors and on the signs of the grid. Positions, masks,
# networks and the header have nearly the same size at every price, and in such a small scene they
# are most of the file. The cell prints both.

# %%
from p4dgs_ref.report.inspect import components

PRICED = ("features", "scales", "offset_scales", "offsets", "hash_grid")
priced = [sum(components(data)[name] for name in PRICED) for data in files.values()]
others = [len(data) - size for data, size in zip(files.values(), priced)]
print("bytes that the price acts on:", priced)
print("all other bytes:", others)
assert max(others) - min(others) < 0.01 * min(others)
assert round(priced[0] / priced[1], 1) == 3.5

# %% [markdown]
# ## What this idea buys
# One method gives a range of files: with a price $\lambda_{rate}$ of 0.01 instead of 0.0005, our
# file has 5 percent fewer bytes and 2.3 dB less. In the paper, T-Rex has two rates, 41 percent
# apart (Table 4), and the means over its synthetic scenes go from 1.03 MB and 38.10 dB to 0.57 MB
# and 35.10 dB (its last table). Our range is narrow because networks, on which the price does not
# act, are 87 percent of the file; the paper names the same limit for its low rates.

# %%
from tutorials import gains

rows = {"price 0.01": "p4dgs lambda_rate=0.01", "price 0.0005": "p4dgs"}
low, high = (gains.mean(label, "psnr_db", "curve") for label in rows.values())
assert 2.3 < high - low < 2.4
paper = {"low rate": (0.506, ""), "high rate": (0.857, "")}
gains.show("12_rate_distortion", rows, paper, "curve")

# %% [markdown]
# Here ends the path for readers who know Gaussian splatting. You have followed an anchor from the
# picture to its bytes: what it predicts, how it moves, how it is rounded, what its numbers cost,
# and the one sum that decides all of this.
#
# **In short**
# - Training minimises the loss of the pictures plus $\lambda_{rate}$ times the bits; each value of
#   $\lambda_{rate}$ gives another file.
# - At the minimum, one bit more per number would improve $\mathcal{L}_{render}$ by
#   $\lambda_{rate}$.
# - Four times the price doubles a step, as long as the step is below its limit and small compared
#   with $\sigma$.
#
# **Often misunderstood**
# - *$\lambda_{rate}$ is a budget.* It is a price. How large a file becomes at this price depends on
#   the scene.
# - *$\lambda_{rate} = 0$ gives the best picture.* It gives a file of 47,502 bytes instead of
#   38,683, for 0.2 dB on the test views.
# - *The smaller of two files is that of the better method.* Compare two methods at equal PSNR, with
#   networks of one size, and with both sides rounded and coded alike. Most of a large factor
#   between two files may come from float32 and the size of a network.

# %% [markdown]
# ## Exercises
# **12.1** ● For the golden case printed below, with $\lambda_{rate} = 10^{-3}$, give three numbers:
# $\mathcal{L}_{total}$, $\bar{\mathcal{L}}_{render}$ and $\bar{\mathcal{L}}_{rate}$. The cotangent
# $\bar{\mathcal{L}}_{total}$ is printed as `out_bar.L_total`.
#
# **12.2** ● At which price are the ways A and B of "By hand" equally good?
#
# **12.3** ● A feature has the sensitivity $w = 2$. Which step is best at $\lambda = 0.001$?
#
# **12.4** ●●● Write the gradients in `mu` and `q` of the whole rate, Eqs. (11), (13), (14) and
# (17). Each step serves a whole group of numbers. `likelihood` is in `p4dgs_ref.equations`.
#
# **Predict, then run.** The price $\lambda$ is multiplied by $4$. What happens to the best step,
# to the bits of a number and to its squared error?

# %%
case = lessons.golden("total_loss/ordinary")
for name in ("in.L_render", "in.L_rate", "out_bar.L_total"):
    print(name, float(case[name]))
answer_1 = ...
answer_2 = ...
answer_3 = ...


def my_rate_backward(inputs, cotangents):
    """Return {"mu" [A, n], "q" [A, 4]}; the cotangents are "bits_bar" and "L_rate_bar".

    `inputs` holds noisy, mu and sigma [A, n] with the columns f, s, l, O, q [A, 4], mask [A, k],
    grids, d and k. Masked offsets cost no bits. The output bits is R_anchor + R_hash, and L_rate is
    bits divided by the count of all numbers, the masked ones included.
    """
    raise NotImplementedError


lessons.check_number("12.1", answer_1)
lessons.check_number("12.2", answer_2)
lessons.check_number("12.3", answer_3)
lessons.check_backward("12.4", my_rate_backward, "rate_stage", "mu", "q")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only total_loss` and `--only rate_stage` compare what a port wrote.
# A typical mistake is to multiply $\lambda_{rate}$ by the plain sum of bits. The resulting curve
# looks right, but every scene then needs other prices, and they differ from ours by the count of
# numbers.

# %%
lessons.passes("total_loss")
