# %% [markdown]
# # Desync: one ulp, and where decoding dies
#
# **Promise.** After this you know why one wrong digit, the last one of a float, can destroy a
# picture, and why integers prevent this. **Before it:** `10_prior_and_likelihood`,
# `21_intervals_to_rans`. **Takes** two seconds on two cores, 25 minutes of reading and 35 of
# exercises.
#
# **Files:** [context.py](../p4dgs_ref/codec/context.py),
# [container.py](../p4dgs_ref/codec/container.py).

# %%
import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("22_desync", "hash_grid", "prior", "entropy_coder")

# %% [markdown]
# ## What fails without it
# The decoder computes the deviation $\sigma$ of every symbol itself, and rounds $\log_2\sigma$ to
# multiples of $\frac{1}{16}$, its *units*. If a single deviation is one unit too large, by 4
# percent, the symbols that follow are read from wrong places, and nearly all are wrong.
#
# The cell decodes the features of `demo.p4dgs` by rANS, once as they are and twice with one
# deviation too large: of *anchor 29* (purple), and of anchor 0. A decoder that checks nothing goes
# on reading zeros after the last word. The numbers are means over the ten test views.

# %%
from p4dgs_ref import evaluate, load_scene
from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.gaussian_table import gaussian_model

thread, quantised, model = figures.THREAD, tour.FILE, tour.MODEL
design, d = model.design, model.design.d
sections = read_container(tour.DATA)


def decode(x, words, tables, bits):
    """The symbols and the last state. Like many decoders, it reads zeros after the data.

    A table is its first symbol and where the slots of each symbol begin.
    """
    words, symbols = list(words), []
    for first, starts in tables:
        slot = x % 2**bits
        i = int(starts.searchsorted(slot, "right")) - 1
        start, end = starts[i : i + 2].tolist()
        x = (x >> bits) * (end - start) + slot - start
        if x < 2**31:
            x = x << 32 | (words.pop(0) if words else 0)
        symbols.append(first + i)
    return np.array(symbols), x


def features(sigma_units):
    """The symbols [A, d] in the section of features, decoded with other deviations."""
    of = gaussian_model(quantised.context.mu_units[:, :d].ravel(), sigma_units.ravel())
    low, high, *words = np.frombuffer(sections["features"], "<u4", offset=1).tolist()
    keys = [of.keys[n : n + 2 + m] - of.keys[n] for n, m in zip(of.first, of.blocks)]
    tables = [(lowest, keys[table]) for lowest, table in zip(of.lowest, of.table)]
    return decode(high << 32 | low, words, tables, 24)[0].reshape(-1, d)


shown = {}
for name, anchor in (("the same context", None), (thread.name, thread.index), ("anchor 0", 0)):
    sigma_units = quantised.context.sigma_units[:, :d].copy()
    if anchor is not None:
        sigma_units[anchor, 0] += 1
        name = f"σ of {name} + 1 unit"
    symbols = features(sigma_units)
    wrong = (symbols != quantised.symbols[:, :d]).any(axis=1)
    f_a = symbols * quantised.context.q[:, :1]
    decoded = replace(model, anchors=model.anchors._replace(f_a=f_a))
    quality = evaluate(decoded, load_scene("bouncing"))[0]["psnr_db"]
    shown[f"{name}\n{wrong.sum()} anchors wrong, {quality:.1f} dB"] = decoded
print(*shown, sep="\n")
assert wrong.sum() == 199

# %%
show.compared("22_one_unit", shown, tour.CAMERA, tour.T, tour.VIEW)

# %% [markdown]
# ## Claim
# The decoder must build the probability table of each symbol itself, from Eq. (9) and Eq. (12):
# $$h = \mathcal{H}(x_a) \tag{9}$$
# $$(\mu, \sigma) = \psi_p(h) \tag{12}$$
# The file contains the networks to the last bit. It does not contain the *order* in which a
# machine adds numbers. The sum of floats depends on this order in its last place (by one *ulp*, a
# unit in the last place). A table can then differ by one count, and **everything after the symbol
# with the wrong table is lost**.

# %% [markdown]
# ## By hand
# In a table of 16 slots, symbol $A$ has 9 slots and $B$ has 7. Suppose that the decoder computes
# 10 and 6 instead. The state is 888, which is slot 8 after 55 whole rounds. Both tables say $A$,
# so nothing looks wrong. But the two states are now $55\cdot 9 + 8 = 503$ and
# $55\cdot 10 + 8 = 558$. Their slots are 7 and 14, which means $A$ for one table and $B$ for the
# other. The damage is never repaired, because the two states have nothing in common any more.

# %%
rounds, slot = divmod(888, 16)
right = rounds * 9 + slot
wrong = rounds * 10 + slot
assert slot < 9 and slot < 10  # A in both tables
assert right % 16 < 9
assert not wrong % 16 < 10

# %% [markdown]
# ## In code
# We write a codec as one would write it at first. It computes $\mu$ and $\sigma$ in `float32`. Of
# the $2^{16}$ counts of a table with $n$ symbols, it distributes $2^{16} - n$ by placing a
# boundary at $\lfloor(2^{16} - n)\,\Phi\rfloor$, and then gives every symbol one count more. All
# 6658 attributes of a trained model go into one message, anchor by anchor.

# %%
BITS = 16


def table_of(mu, sigma, q):
    """The first symbol of a table and its cumulative counts, 12 deviations to either side."""
    reach = math.ceil(12 * sigma / q) + 1
    first = round(mu / q) - reach
    n = 2 * reach + 1
    one_each = np.arange(n + 1)
    edges = (first + one_each - 0.5) * q
    cumulative = ndtr((edges - mu) / sigma)
    cumulative[0] = 0
    cumulative[-1] = 1
    shared = np.floor(cumulative * (2**BITS - n)).astype(int)
    return first, shared + one_each


def encode(symbols, tables):
    x = 2**31
    stack = []
    for symbol, (first, counts) in zip(reversed(symbols.tolist()), reversed(tables)):
        start, end = counts[symbol - first : symbol - first + 2].tolist()
        freq = end - start
        if x >= freq << 63 - BITS:
            stack.append(x % 2**32)
            x >>= 32
        x = (x // freq << BITS) + x % freq + start
    return x, stack[::-1]


# %%
from p4dgs_ref.codec import context
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS, quantised_of
from p4dgs_ref.report import inspect
from p4dgs_ref.training.objective import psnr

kept = quantised.kept
sent = quantised.symbols[kept]
q = np.repeat(quantised.context.q, design.widths, axis=1)[kept]
exact = inspect.float_context(model)
mu = exact.mu[kept].astype(np.float32)
sigma = exact.sigma[kept].astype(np.float32)


def build(mu, sigma):
    return [table_of(*row) for row in zip(mu.tolist(), sigma.tolist(), q.tolist())]


tables = build(mu, sigma)
message = encode(sent, tables)
received, last = decode(*message, tables, BITS)
assert len(sent) == 6658
assert np.array_equal(received, sent)
assert last == 2**31  # the state with which the encoder began

# %% [markdown]
# **One ulp.** Now one deviation of the decoder, that of symbol 2230, is too large by one unit in
# the last place. This is less than one part in eight million. Most errors of this size change no
# count of a table, but this one does. The symbol itself is decoded correctly. The next one is
# wrong, and so are 3820 of the 4427 symbols that follow.

# %%
victim = 2230
nudged = sigma.copy()
nudged[victim] = np.nextafter(nudged[victim], np.float32(np.inf))
received, last = decode(*message, build(mu, nudged), BITS)
wrong = np.flatnonzero(received != sent)
following = len(sent) - victim - 1
assert 0 < nudged[victim] / sigma[victim] - 1 < 1 / 8e6
assert wrong[0] == victim + 1
assert (len(wrong), following) == (3820, 4427)
assert last != 2**31

# %% [markdown]
# What does the result look like? The wrong symbols are not white noise. A random state that is
# read through the tables produces each symbol with its own probability, so the rest of the
# picture is *a random sample from the prior*: plausible blobs in wrong places. The number of bits
# that these symbols cost under the tables is about the same as for the true symbols, so it does
# not reveal the error either. Only the last state does, at the very end.


# %%
from p4dgs_ref.codec.quantise import dequantise


def price(symbols):
    """The bits of the last symbols of the message under the right tables."""
    total = 0
    for symbol, (first, counts) in zip(symbols, tables[-len(symbols) :]):
        width = counts[symbol - first + 1] - counts[symbol - first]
        total += BITS - math.log2(width)
    return total


def received_model(symbols):
    all_symbols = np.zeros(kept.shape, int)
    all_symbols[kept] = symbols
    f, s, l, O = dequantise(all_symbols, quantised.context, design)
    return replace(model, anchors=model.anchors._replace(f_a=f, s_a=s, l_a=l, O_a=O))


true = price(sent[victim + 1 :]) / following
broken = price(received[victim + 1 :]) / following
print(f"bits per symbol after the error: sent {true:.2f}, received {broken:.2f}")
assert abs(broken / true - 1) < 0.1
pair = [received_model(symbols) for symbols in (sent, received)]
before, after = (m.render(tour.CAMERA, tour.T).clip(0, 1) for m in pair)
print(f"PSNR {psnr(after, before):.1f} dB")

# %%
figure, (left, middle, errors) = plt.subplots(
    1, 3, figsize=(12, 4.2), layout="constrained", width_ratios=(1, 1, 1.1)
)
for ax, m, title in zip((left, middle), pair, ("What was sent", "One ulp later")):
    show.picture(ax, show.frame(m, tour.CAMERA, tour.T, 4), tour.CAMERA, **tour.VIEW, title=title)
errors.plot(np.abs(received - sent), ".", ms=3, color=figures.COLORS[1])
errors.axvline(victim, color=figures.COLORS[0], label=f"one ulp in σ\nof symbol {victim}")
figures.finish(
    errors,
    yscale="symlog",
    ylim=(-0.3, 2000),
    xlabel="symbol in the message",
    ylabel="|received − sent| (steps q)",
    title="All symbols are right,\nthen nearly all are wrong",
)
figures.label(errors, (victim + 150, 450))
figures.show(figure, "22_desync")

# %% [markdown]
# **Such differences occur by themselves.** Take the same `float32` network and add its products
# from first to last, or from last to first, as another library, GPU or batch size may do. More than
# half of the deviations then differ by a few ulps. Symbol 121 is the first one that is decoded
# wrongly, so decoding fails within the first fiftieth of the message.


# %%
from p4dgs_ref.equations import hash_grid, prior


def network(h, weights, biases, order):
    """psi_p in float32, with every sum in a given order."""
    for layer, (W, b) in enumerate(zip(weights, biases)):
        y = np.zeros((len(h), W.shape[1]), np.float32)
        for i in range(len(W))[::order]:
            y = y + h[:, i : i + 1] * W[i].astype(np.float32)
        h = y + b.astype(np.float32)
        if layer < len(weights) - 1:
            h = np.maximum(h, 0)
    return h


lo, hi = (corner.astype(float) for corner in model.box)
table_sizes = [T for T, _ in design.levels()]
located = hash_grid.locate(model.anchors.x_a, lo, hi, design.grid, table_sizes)
h = hash_grid.query(located, model.grids)[0].astype(np.float32)
mu_columns, raw_columns = prior.layout(design.widths)


def predicted(order):
    """Means and deviations of all coded numbers, as a machine that adds in this order has them."""
    y = network(h, *model.networks["psi_p"], order)
    deviations = np.exp(y[:, raw_columns].astype(float)).astype(np.float32)
    return y[:, mu_columns][kept], deviations[kept]


forwards, backwards = predicted(1), predicted(-1)
differ = (forwards[1] != backwards[1]).mean()
largest = np.abs(forwards[1] / backwards[1] - 1).max()
received, _ = decode(*encode(sent, build(*forwards)), build(*backwards), BITS)
first_wrong = np.flatnonzero(received != sent)[0]
print(f"{differ:.0%} of the deviations differ, at most by {largest:.1e} of their value")
assert 0.5 < differ < 0.6
assert first_wrong == 121

# %% [markdown]
# ## How often an ulp matters
# A derivative tells how often an ulp changes a table. A boundary of a table lies at
# $C = 2^{16}\,\Phi(z)$ with $z = ((K - \frac12)q - \mu)/\sigma$. If $\sigma$ grows by the relative
# amount $\varepsilon$, the boundary moves by $-2^{16}\,\phi(z)\,z\,\varepsilon$. The count changes
# if there is an integer between the old and the new position. For one ulp the probability of this
# is at most $0.242\cdot 2^{16}\cdot 2^{-23}$, one in 529.


# %%
def phi(z):
    return np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)


z = np.linspace(0, 5, 50001)
worst = (z * phi(z)).max()
assert round(worst, 3) == 0.242
assert round(1 / (worst * 2.0 ** (BITS - 23))) == 529

up = np.nextafter(sigma, np.float32(np.inf))
growth = up.astype(float) / sigma - 1
expected = 0.0
changed = 0
numbers = np.stack([mu, sigma, q, growth], axis=1).astype(float)
for number, (first, counts), (_, moved) in zip(numbers, tables, build(mu, up)):
    m, s, step, relative = number
    boundaries = (first + np.arange(1, len(counts) - 1) - 0.5) * step
    z = (boundaries - m) / s
    hits = 2**BITS * phi(z) * np.abs(z) * relative
    expected += hits.sum()
    if len(counts) == len(moved):
        changed += (counts != moved).sum()
print(f"boundaries moved by one ulp in every deviation: {changed} counted, {expected:.0f} expected")
assert abs(changed - expected) < 4 * math.sqrt(expected)

# %% [markdown]
# ## Break it
# A plausible remedy is to round $\log_2\sigma$ to multiples of $\frac1{16}$ before the table is
# made, so that ulps disappear. Indeed the two orders above now agree in all 6658 deviations. But
# the problem has only moved to the boundaries between the multiples. A value next to such a
# boundary is rounded up by one machine and down by another, and the deviations then differ by
# four percent instead of one ulp. In a file of two million symbols, about four such cases are to be
# expected.


# %%
def snap(deviation):
    """log2 of a deviation in units of 1/16, rounded."""
    return np.rint(16 * np.log2(deviation.astype(float)))


assert np.array_equal(snap(forwards[1]), snap(backwards[1]))
edge = np.float32(2.0 ** (-40.5 / 16))
above = np.nextafter(edge, np.float32(1))
while snap(edge) == snap(above):
    towards = np.float32(1) if snap(edge) < -40 else np.float32(0)
    edge = np.nextafter(edge, towards)
    above = np.nextafter(edge, np.float32(1))
assert snap(above) - snap(edge) == 1  # neighbouring floats, rounded to different multiples
ratio = forwards[1].astype(float) / backwards[1]
distance = 16 * np.abs(np.log2(ratio))
crossings = 2e6 * distance.mean()
print(f"{crossings:.2f} cases in two million symbols")
assert 3.5 < crossings < 4.5

# %% [markdown]
# ## What a codec does with it
# Video coding has had this problem. `MPEG-2` specified its inverse transform in floats within a
# tolerance, and pictures drifted apart; `H.264` specifies it in integers. `codec/context.py` does
# the same for everything between positions and tables. Sums of integers below $2^{53}$ are exact
# in a double, in any order and with any library. Below, 20 random orders of summation give
# identical sums. [Break it yourself](viewer/demo.html#step=break): a file with one weight changed.

# %%
rng = np.random.default_rng(21)


def shuffled(x, W):
    """x W with the terms of every sum in a random order."""
    y = np.zeros((len(x), W.shape[1]))
    for i in rng.permutation(len(W)):
        y = y + x[:, i : i + 1] * W[i]
    return y


h_units = rng.integers(-(2**24), 2**24, (60, 20)).astype(float)
W_units = rng.integers(-(2**11), 2**11, (20, 50)).astype(float)
for _ in range(20):
    assert np.array_equal(shuffled(h_units, W_units), h_units @ W_units)
rows = [row for row in inspect.ledger(tour.DATA) if row["name"] in ATTRIBUTE_SECTIONS]
by_tables = sum(row["integer_bytes"] for row in rows)
by_floats = sum(row["estimate_bytes"] for row in rows)
print(f"integer tables change the bits by {by_tables / by_floats - 1:+.3%}")
assert abs(by_tables / by_floats - 1) < 0.001

# %% [markdown]
# ## What this idea buys
# Integers buy that every machine decodes the same scene. Without them, two machines that add
# in different orders already disagree within the first fiftieth of the message, and after the first
# wrong deviation nearly nothing is right: one of 199 anchors spoils 170 in the first figure. The
# price is next to nothing: the cell above prints by how much the bits change, less than a tenth of
# a percent. The paper does not say
# how its encoder and decoder agree.
#
# **In short**
# - The decoder computes every table, so it must compute what the encoder computed, to the last bit.
# - After one wrong table the states have nothing in common, and all that follows is noise from the
#   prior.
# - Sums of integers below $2^{53}$ are exact in doubles, in any order.
#
# **Often misunderstood**
# - *A small error has a small effect.* That holds for pictures, not for the state of a coder.
# - *Rounding to a coarse grid removes the problem.* It makes it rarer and larger.
# - *The same library gives the same sums.* Another batch size or processor can change them.

# %% [markdown]
# ## Exercises
# **22.1** ● Pop the state $1001$ from the table of "By hand". Which two states follow, with $9$ and
# with $10$ slots for $A$?
#
# **22.2** ●● Write `my_network`. A layer has `W`, `b` and `s` and computes $y = xW + b$. A hidden
# layer then returns $\max(0, \lfloor(y + \lfloor 2^s/2\rfloor)/2^s\rfloor)$.
#
# **22.3** ●● Write the computation of $\log_2(\sigma/q)$ in units of $\frac1{16}$, for a step
# $q = D\,2^{p-39}$. All logarithms that it needs are in units of $2^{-16}$. With
# $l = \lfloor(94548\,raw + 2^{15})/2^{16}\rfloor$, where $94548$ stands for $2^{16}\log_2 e$, it
# is $\lfloor(l - \log_2 D - (p - 39)\,2^{16} + 2^{11})/2^{12}\rfloor$, clipped to the range from
# $-128$ to $319$. The stream `full` is the test.
#
# **Predict, then run.** A port sums the integers of $xW$ in float32. From which size of the sums
# on may it be wrong? Are the sums of the stream `full` that large?

# %%
from p4dgs_ref.oracle import streams

answer_1 = answer_2 = answer_3 = ...


def my_network(x, layers):
    """Return the outputs y (A, J) of the last layer, integers, for the inputs x (A, I)."""
    raise NotImplementedError


def my_sigma_units(raw, log2_D, p):
    """Return sigma_units. All arguments are integers (A, n).

    `raw`, which is ln(sigma), and `log2_D` are in units of 2^-16; `raw` is already clipped. `p` is
    the exponent of Q_0.
    """
    raise NotImplementedError


row = next(row for row in streams.read_rows()["good"] if row["name"] == "full")
stored = {array["name"]: streams.read_expected(row, array) for array in row["arrays"]}
stream = (streams.STREAMS / "full.p4dgs").read_bytes()
full = quantised_of(read_container(stream)).model
widths = full.design.widths
layers = context.integer_layers(*full.networks["psi_p"])
h = stored["h"].astype(float)
y = context.run_network(h, layers)
of_sigma = y[:, prior.layout(widths)[1]]
raw = context.rescale(of_sigma, layers[-1].bits, 16, 2**24)
raw = np.clip(raw, -14 << 16, 6 << 16)
fraction, p = np.frexp(full.design.Q_0)
D = np.floor(fraction * 2**24).astype(int) * stored["q_units"]
log2_D = np.repeat(context.log2(D), widths, axis=1)
exponents = np.repeat(p.astype(int), widths)
with suppress(NotImplementedError):
    answer_2 = my_network(h, layers)
with suppress(NotImplementedError):
    answer_3 = my_sigma_units(raw, log2_D, exponents)
lessons.check_number("22.1", answer_1)
lessons.check_number("22.2", answer_2, y, digits=15)
lessons.check_number("22.3", answer_3, stored["sigma_units"], digits=15)

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only codec` compares `h`, `q_units`, `mu_units` and `sigma_units`
# bit for bit and in this order, so the first difference names the step that is wrong. Typical
# mistakes of ports are products in `float32`, a division that rounds towards zero where a floor
# is meant, a fused multiply-add in `x_a`, and a table computed with the machine's own `exp`. The
# end of `20_file_byte_by_byte` says how to run this check from Python.
