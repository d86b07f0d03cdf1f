# %% [markdown]
# # Entropy coding, from intervals to rANS
#
# **Promise.** After this tutorial you can turn symbols with probabilities into bytes and back,
# first with fractions and then exactly as in the file, and say what this saves. **Before it:**
# `10_prior_and_likelihood`; `20_file_byte_by_byte` helps. **Takes** six seconds on two cores, 30
# minutes of reading and 40 of exercises.
#
# **Files:** [rans.py](../p4dgs_ref/codec/rans.py),
# [gaussian_table.py](../p4dgs_ref/codec/gaussian_table.py),
# [streams.py](../p4dgs_ref/codec/streams.py).

# %%
import math
from contextlib import suppress
from fractions import Fraction

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("21_intervals_to_rans", "likelihood", "entropy_coder", "file")

# %% [markdown]
# ## What fails without it
# Tutorial 10 predicts how probable each integer is, and counts $-\log_2 p$ bits for it. A file that
# stores every integer in a fixed number of bits gains nothing from this prediction, and a code with
# a whole number of bits for each symbol wastes half a bit on average.
#
# The left side shows the 16 feature symbols of *anchor 29* (purple) in the trained scene of
# `demo.p4dgs`, and the mean and deviation that the context predicts for each (bars). The right side
# shows the bytes of all features of the scene, coded in four ways.

# %%
from p4dgs_ref.codec.streams import ideal_bits_gaussian

file, thread = tour.FILE, figures.THREAD
d = file.model.design.d
features = file.symbols[:, :d]
mu, sigma = file.context.mu_units[:, :d], file.context.sigma_units[:, :d]
predicted = ideal_bits_gaussian(features.ravel(), mu.ravel(), sigma.ravel())
values, counts = np.unique(features, return_counts=True)
ways = {
    "fixed width": features.size * math.ceil(math.log2(np.ptp(values) + 1)),
    "one table": -counts @ np.log2(counts / features.size),
    "context, whole bits": np.ceil(predicted).sum(),
    "context": predicted.sum(),
}
ways = {way: bits / 8 for way, bits in ways.items()}
assert np.allclose([*ways.values()], [1990, 1440, 1204, 1005], atol=1)
print({way: f"{size:.0f} bytes" for way, size in ways.items()})

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
own = mu[thread.index] / 1024, 2.0 ** (sigma[thread.index] / 16)
left.errorbar(range(d), *own, fmt="none", ecolor=show.CONTEXT, lw=5, alpha=0.5)
left.plot(features[thread.index], "o", color=thread.color)
left.set(xlabel="feature of anchor 29", ylabel="symbol", title="dots: symbols, bars: μ ± σ")
bars = right.barh([*ways], ways.values(), color=show.RATE)
right.bar_label(bars, fmt=" %.0f bytes")
right.set(title="all 3,184 features of the scene", xticks=())
right.margins(x=0.25)
right.invert_yaxis()
right.grid(False)
figures.show(figure, "21_ways")

# %% [markdown]
# ## Claim
# By Eq. (11) a symbol costs $b = -\log_2 p$ bits, for example 0.4, and Eq. (13) adds up these
# costs. But how do you write 0.4 bits to a file? An entropy coder does not write single symbols,
# but the whole message at once. For a message of probability $P = p_1 p_2 \cdots p_n$ it needs
# about $-\log_2 P$ bits, even if every symbol has its own table of probabilities. The decoder must
# have exactly the same tables.

# %% [markdown]
# ## By hand
# Take three symbols with $p(a) = \frac{1}{2}$ and $p(b) = p(c) = \frac{1}{4}$, and the message
# $a\,c\,a\,b$. We start with the interval from 0 to 1. Each symbol owns a part of the current
# interval: $a$ the lower half, $b$ the third quarter and $c$ the last quarter. To code a symbol,
# keep its part of the interval and discard the rest:
# $$[0, 1) \to [0, \tfrac12) \to [\tfrac38, \tfrac12) \to [\tfrac38, \tfrac7{16})
#   \to [\tfrac{26}{64}, \tfrac{27}{64})$$

# %%
half, quarter = Fraction(1, 2), Fraction(1, 4)
P = {
    "a": (Fraction(0), half),  # where the part of a symbol starts, and its probability
    "b": (half, quarter),
    "c": (half + quarter, quarter),
}


def narrow(message, parts):
    """All intervals (low, width) on the way, starting with [0, 1).

    `parts` holds one {symbol: (start, probability)} for each symbol of the message.
    """
    way = [(Fraction(0), Fraction(1))]
    for symbol, part in zip(message, parts):
        low, width = way[-1]
        start, p = part[symbol]
        way.append((low + width * start, width * p))
    return way


way = narrow("acab", 4 * [P])
lows = [low for low, _ in way]
assert lows == [0, 0, Fraction(3, 8), Fraction(3, 8), Fraction(26, 64)]
assert way[-1][1] == Fraction(1, 64)

# %% [markdown]
# The final width is $\frac12\cdot\frac14\cdot\frac12\cdot\frac14 = \frac1{64}$, the probability
# of the message. Any number inside the final interval identifies the message, so 6 bits are enough:
# $\frac{26}{64}$ is `011010`. With two bits for every symbol we would need 8. To decode, find the
# part in which the number $v$ lies; its owner is the first symbol. Then stretch this part to the
# whole interval, $v \to (v - start)/p$, and repeat.


# %%
def owner(v):
    """The symbol in whose part v lies."""
    return max(symbol for symbol in P if P[symbol][0] <= v)


v = Fraction(0b011010, 64)
found = ""
for _ in range(4):
    symbol = owner(v)
    start, p = P[symbol]
    found += symbol
    v = (v - start) / p
assert found == "acab"

# %% [markdown]
# ## In code
# Now we code the first six features of anchor 29. Each feature has its own Gaussian, so
# the parts are different for each. Their widths are multiples of $2^{-24}$, as in the file. An
# interval that is at least $2^{-b}$ wide contains a multiple of $2^{-b}$. We therefore round up to
# whole bits only once, at the end of the message.

# %%
from p4dgs_ref.codec.gaussian_table import gaussian_model

symbols = features[thread.index, :6]
tables = gaussian_model(mu[thread.index, :6], sigma[thread.index, :6])


def parts_of(i):
    """{symbol: (start, probability)} of feature i; the part outside its table belongs to None."""
    first = tables.first[tables.table[i]]
    n = tables.blocks[tables.table[i]]
    keys = tables.keys[first : first + n + 1].tolist()
    edges = [Fraction(key % 2**24, 2**24) for key in keys] + [Fraction(1)]
    names = [*range(tables.lowest[i], tables.lowest[i] + n), None]
    parts = {name: (low, high - low) for name, low, high in zip(names, edges, edges[1:])}
    return parts


parts = [parts_of(i) for i in range(6)]
way = narrow(symbols.tolist(), parts)
low, width = way[-1]
ideal = -math.log2(width)
bits = math.ceil(ideal)
number = math.ceil(low * 2**bits)  # the first multiple of 2^-bits inside the interval
assert low <= Fraction(number, 2**bits) < low + width
print(f"symbols {symbols.tolist()} have the probability {float(width):.3g}")
print(f"they cost {ideal:.2f} bits and are sent as {number:0{bits}b}")

# %% [markdown]
# **The problem with intervals.** The fractions get longer and longer. Practical interval coders
# therefore output leading digits as soon as they are certain, and must handle carries into digits
# that they have already written. rANS (Duda) keeps *a single integer* $x$ instead. Every integer
# gets a colour: in each block of $M$ integers, $f_s$ of them have the colour of symbol $s$,
# starting at position $c_s$. In our example $M = 4$, and the colours repeat as $a\,a\,b\,c$.
#
# To **push** a symbol $s$, replace $x$ by the integer of colour $s$ that has exactly $x$ integers
# of this colour below it. Since one in $M/f_s$ integers has this colour, the new $x$ is about
# $x M/f_s$, which is $-\log_2 p_s$ bits longer. To **pop**, read the colour of $x$, which is the
# symbol, and count the integers of this colour below $x$; their number is the old $x$. The last
# symbol in is the first one out.
# $$x' = \lfloor x / f_s\rfloor M + (x \bmod f_s) + c_s$$

# %%
M = 4
f = {"a": 2, "b": 1, "c": 1}
c = {"a": 0, "b": 2, "c": 3}


def colour(x):
    return "aabc"[x % M]


def push(x, s):
    return x // f[s] * M + x % f[s] + c[s]


for x in range(200):
    for s in "abc":
        before = [y for y in range(push(x, s)) if colour(y) == s]
        assert colour(push(x, s)) == s
        assert len(before) == x
path = [1]
for s in reversed("acab"):
    path.append(push(path[-1], s))
growth = math.log2(path[-1] / path[0])
print("states:", path)
print(f"x grows by {growth:.2f} bits instead of 6, because rounding matters while x is small")

# %% [markdown]
# Now we push all 3,184 features of the scene. Python's integers have no size limit, so we simply
# let the state grow. The right panel of the next figure shows that the state grows by as many bits
# as the prior predicted.

# %%
every = gaussian_model(mu.ravel(), sigma.ravel())
entries = every.first[every.table] + features.ravel() - every.lowest
starts = (every.keys[entries] % 2**24).tolist()
freqs = np.diff(every.keys)[entries].tolist()
x = 2**31
reached = []
for start, freq in zip(reversed(starts), reversed(freqs)):
    x = x // freq * 2**24 + x % freq + start
    reached.append(math.log2(x) - 31)
promised = predicted[::-1].cumsum()
assert abs(reached[-1] - promised[-1]) < 0.01

# %%
figure, (shares, grid, growing) = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
tint = {"a": figures.COLORS[0], "b": figures.COLORS[4], "c": figures.COLORS[2]}
for row, (low, width) in enumerate(narrow("acab", 4 * [P])[:-1]):
    for s, (start, p) in P.items():
        left, wide = float(low + width * start), float(width * p)
        shares.barh(
            row,
            wide,
            left=left,
            color=tint[s],
            alpha=1 if s == "acab"[row] else 0.3,
            height=0.8,
            lw=0,
        )
        if wide > 0.06:
            shares.text(left + wide / 2, row, s, ha="center", va="center", fontsize=14)
shares.set(
    xlim=(0, 1),
    ylim=(3.6, -0.6),
    yticks=range(4),
    yticklabels=list("acab"),
    xlabel="from 0 to 1",
    ylabel="symbol coded",
    title="Intervals: each symbol keeps its part",
)


def place(x):
    """Where the integer x is drawn."""
    return x % 8 + 0.47, x // 8 + 0.47


for x in range(56):
    used = x in path
    corner = x % 8, x // 8
    square = plt.Rectangle(corner, 0.94, 0.94, color=tint[colour(x)], alpha=0.75 if used else 0.3)
    weight = "bold" if used else None
    grid.add_patch(square)
    grid.text(*place(x), x, ha="center", va="center", fontsize=13, weight=weight)
for old, new in zip(path[:3], path[1:4]):
    arrow = dict(
        arrowstyle="->",
        lw=2.5,
        shrinkA=14,
        shrinkB=14,
        connectionstyle="arc3,rad=0.3",
    )
    grid.annotate("", place(new), place(old), arrowprops=arrow)
grid.set(
    xlim=(0, 8),
    ylim=(7, 0),
    xticks=[],
    yticks=[],
    title="rANS: push b, a, c: " + " → ".join(map(str, path[:4])),
)
growing.plot(promised, lw=7, alpha=0.35, label=r"$\sum -\log_2 p$")
growing.plot(reached, "--", color="k", label=r"growth of $\log_2 x$")
figures.finish(
    growing,
    xlabel="features pushed",
    ylabel="bits",
    title="The state grows as predicted",
)
figures.label(growing, (1700, 3500), (300, 6000))
figures.show(figure, "21_intervals_to_rans")

# %% [markdown]
# **A state that fits into 64 bits.** The file uses $M = 2^{24}$ and keeps $x$ between $2^{31}$ and
# $2^{63}$. If a push would make $x$ too large, which happens if $x \ge f\,2^{39}$, we first move
# the 32 lowest bits of $x$ to a stack. If a pop makes $x$ too small, we take 32 bits back from the
# stack. A message consists of one byte for the number of lanes and the size of $x$, then $x$, then
# the stack. The example in the docstring of `rans.py`, the message $0\,1\,0$ with the probabilities
# $\frac34$ and $\frac14$, takes 9 bytes.


# %%
from p4dgs_ref.codec import container


def encode(starts, freqs):
    """The bytes of one lane; symbols are pushed from the last to the first."""
    x = 2**31
    stack = []
    for start, freq in zip(reversed(starts), reversed(freqs)):
        if x >= freq << 39:
            stack.append(x % 2**32)
            x >>= 32
        x = x // freq * 2**24 + x % freq + start
    words = [x % 2**32]
    if x >> 32:
        words.append(x >> 32)
    words += reversed(stack)
    size = 0x80 if x >> 32 else 0
    return bytes([size]) + np.array(words, "<u4").tobytes()


sections = container.read_container(tour.DATA)
three_quarters, one_quarter = 3 << 22, 1 << 22
example = encode([0, three_quarters, 0], [three_quarters, one_quarter, three_quarters])
assert example.hex(" ") == "80 00 00 40 8e 03 00 00 00"
assert encode(starts, freqs) == sections["features"]

# %% [markdown]
# ## The decoder
# A coder has no gradient; training uses $-\log_2 p$ in its place. What a coder needs is an exact
# inverse. Write $r = x \bmod f$, so that
# $x' = \lfloor x/f\rfloor M + r + c$. Since $0 \le r + c < M$, we have
# $\lfloor x'/M\rfloor = \lfloor x/f\rfloor$ and $x' \bmod M = r + c$. The condition
# $c \le r + c < c + f$ determines the symbol, and then $x = \lfloor x/f\rfloor f + r$ is known:
# $$x = \lfloor x'/M\rfloor\, f + (x' \bmod M) - c$$
# All of this is exact integer arithmetic, so pushing and popping lose nothing. The operations on
# the stack are also undone exactly: a push leaves $x' < 2^{63}$, and the pop falls below $2^{31}$
# if and only if the push had moved 32 bits to the stack.

# %%
rng = np.random.default_rng(20)
for _ in range(2000):
    freq = int(rng.integers(1, 2**24))
    start = int(rng.integers(0, 2**24 - freq + 1))
    x = int(rng.integers(2**31, 2**63))
    full = x >= freq << 39
    if full:
        x >>= 32
    pushed = x // freq * 2**24 + x % freq + start
    slot = pushed % 2**24
    popped = pushed // 2**24 * freq + slot - start
    assert 2**31 <= pushed < 2**63
    assert start <= slot < start + freq
    assert popped == x
    assert (popped < 2**31) == full

# %% [markdown]
# ## Break it
# Suppose we push the symbols in reading order, the first one first. If all symbols share one table,
# as in the masks, everything seems to work: the length is right, the counts are right, and even the
# final state is right. But the decoder returns the symbols in the opposite order. If each symbol
# has its own table, the decoder uses wrong tables from the start. Two checks detect this: the stack
# runs out, or the last state is not the one with which the encoder began.

# %%
from p4dgs_ref.codec import rans, streams

bits = file.model.anchors.mask.ravel()
p_one = streams.probability_of_one(bits.sum(), bits.size)
bit_keys = np.array([0, 2**24 - p_one, 2**24])
right = rans.encode(bits.astype(int), bit_keys)
wrong = rans.encode(bits[::-1].astype(int), bit_keys)
backwards = rans.decode(wrong, np.zeros(len(bits), int), bit_keys)[0]
assert len(right) == len(wrong)
assert np.array_equal(backwards[::-1], bits)
assert not np.array_equal(backwards, bits)
reversed_features = rans.encode(entries[::-1], every.keys)
try:
    rans.decode(reversed_features, every.table, every.keys)
    raise AssertionError("the decoder accepted a reversed message")
except container.BitstreamError as error:
    print(error)

# %% [markdown]
# ## What a codec does with it
# CABAC, the coder of video standards that the introduction of the paper mentions, narrows an
# interval bit by bit and adapts its probabilities on the way, so each bit has to wait for the
# previous one. Here the probabilities depend only on the positions, by Eq. (12). No symbol has to
# wait for another, and `rans.py` can decode many symbols in parallel, in *lanes*.
#
# ## What this idea buys
# The coder adds less than 8 bytes to the ideal length of a section, as the cell shows. All it can
# gain is in the first figure: the features take 1,005 bytes under the context's tables and 1,990 in
# fixed width. The paper counts prediction, quantisation and coding together in its Table 3
# (`10_prior_and_likelihood` shows its bars), and has no number for the coder alone.

# %%
from p4dgs_ref.report import inspect

for row in inspect.ledger(tour.DATA):
    if row["name"] in ("features", "scales", "offset_scales", "offsets", "masks", "hash_grid"):
        ideal, coded_bytes = row["integer_bytes"], row["payload_bytes"]
        print(f"{row['name']:14s} ideal {ideal:6.1f}, coded {coded_bytes} bytes")
        assert 0 < coded_bytes - ideal < 8

# %% [markdown]
# **In short**
# - A message of probability $P$ takes $-\log_2 P$ bits, and one rounding at its end.
# - rANS keeps one integer: pushing a symbol makes it $-\log_2 p$ bits longer.
# - The decoder pops in the opposite order, and needs the same tables.
#
# **Often misunderstood**
# - *The coder compresses.* The prediction does; the coder reaches what it promises, and no more.
# - *A symbol that costs 0.4 bits is somewhere in the file.* No bit belongs to one symbol alone.
# - *The table is in the file.* Both sides compute it from the context.

# %% [markdown]
# ## Exercises
# **21.1** ● How many bits does $b\,c\,c\,a$ take with the parts of "By hand"?
#
# **21.2** ●● Write `my_encode(entries, keys)`, which returns the bytes of one lane for symbols that
# share one table. It must reproduce the masks of the file.
#
# **21.3** ●● Write `my_decode(message, count, keys)`. It must decode the signs of the hash grid.
#
# **Predict, then run.** One sign in a hundred is negative, but according to the encoder's table it
# is one in two. How many bits per sign does `my_encode` write with this table, and how many with
# the right one?

# %%
answer_1 = answer_2 = answer_3 = ...


def my_encode(entries, keys):
    """Return the lane byte, x (low word, and high word if there is one), and the stack, top first.

    Entry i occupies the slots from keys[i] to keys[i + 1].
    """
    raise NotImplementedError


def my_decode(message, count, keys):
    """Return the `count` entries of a message of my_encode.

    At the end x must be 2^31 and no word may be left.
    """
    raise NotImplementedError


masks, grid = sections["masks"], sections["hash_grid"]
p_plus = int.from_bytes(grid[:4], "little")
sign_keys = np.array([0, 2**24 - p_plus, 2**24])
signs = np.concatenate([level.ravel() for level in file.model.grids]) > 0
with suppress(NotImplementedError):
    answer_2 = np.frombuffer(my_encode(bits.astype(int), bit_keys), np.uint8)
with suppress(NotImplementedError):
    answer_3 = my_decode(grid[4:], len(signs), sign_keys)
lessons.check_number("21.1", answer_1)
lessons.check_number("21.2", answer_2, np.frombuffer(masks[4:], np.uint8))
lessons.check_number("21.3", answer_3, signs)

# %% [markdown]
# ## Check your port
# Run `p4dgs-ref oracle check DIR --only codec`. The stream `lanes` has several lanes, and
# `raw_bits` and `escapes` contain symbols outside all tables. Ports typically make one of three
# mistakes: they keep the state in a double, which is exact only up to 53 bits (JavaScript needs
# BigInt); they take words from the stack in the wrong order; or the frequencies of their tables do
# not add up to $2^{24}$.

# %%
assert float(2**53) == float(2**53 + 1)  # a double cannot hold such a state
