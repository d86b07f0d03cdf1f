# %% [markdown]
# # Entropy coding, from intervals to rANS
#
# **Promise.** After this you can turn symbols with probabilities into bytes and back, first with
# fractions and then exactly as the file does. **Before it:** `10_prior_and_likelihood`;
# `19_file_byte_by_byte` helps. **Takes** four seconds on two cores, 30 minutes of reading and 40 of
# exercises.
#
# **Files:** [rans.py](../p4dgs_ref/codec/rans.py),
# [gaussian_table.py](../p4dgs_ref/codec/gaussian_table.py),
# [streams.py](../p4dgs_ref/codec/streams.py).

# %%
import math
from contextlib import suppress
from fractions import Fraction

import imageio.v3 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from p4dgs_ref import oracle
from p4dgs_ref.codec import container, rans
from p4dgs_ref.codec import streams as sections
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.codec.gaussian_table import gaussian_model
from p4dgs_ref.lab.school import lessons
from p4dgs_ref.report import inspect

plt = lessons.begin("20_intervals_to_rans")
data = (oracle.path() / "model.p4dgs").read_bytes()  # a trained model of 60 anchors
model = quantised_of(container.open_container(data))

# %% [markdown]
# ## Claim
# Eq. (11) gives a symbol the price $b = -\log_2 p$, which may be a fraction of a bit, and Eq.
# (13) adds the prices up. An entropy coder makes these prices real: a message of total
# probability $P = p_1 p_2 \cdots p_n$ becomes about $-\log_2 P$ bits, even if each symbol has a
# probability table of its own. The coder requires only that the decoder has exactly the same
# tables.

# %% [markdown]
# ## By hand
# Take three symbols with $p(a) = \frac{1}{2}$ and $p(b) = p(c) = \frac{1}{4}$, and the message
# $a\,c\,a\,b$. We begin with the interval from 0 to 1. Each symbol owns a part of whatever
# interval is left: $a$ the lower half, $b$ the third quarter and $c$ the last quarter. Coding a
# symbol means keeping its part:
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
# of the message. Any number inside the final interval identifies the message, so 6 bits suffice,
# and 26 is `011010`. With two bits for every symbol we would need 8. The decoder looks up in
# whose part the number lies, which gives the symbol, and stretches this part to the whole
# interval by $(v - start)/p$.


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
# Now we code six features of one anchor of a trained model. Each feature has a Gaussian of its
# own and therefore parts of its own. The project's tables hold their widths as multiples of
# $2^{-24}$. Every interval that is at least $2^{-b}$ wide contains a multiple of $2^{-b}$, so the
# number of bits is rounded up only once, at the end of the message.

# %%
symbols = model.symbols[7, :6]
tables = gaussian_model(model.context.mu_units[7, :6], model.context.sigma_units[7, :6])


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
# The next cell draws this as an animation, which zooms into the chosen part after each symbol.
#
# ![Every symbol narrows the interval](pictures/intervals.gif)

# %%
CHOSEN, EVEN, ODD = lessons.COLORS[1], lessons.COLORS[0], lessons.COLORS[5]


def frame(canvas, i, lower, upper, text):
    """One picture: the parts of interval i, as far as they lie between lower and upper."""
    canvas.figure.clear()
    axes = canvas.figure.add_axes([0.09, 0.3, 0.82, 0.45])
    low, width = (float(v) for v in way[i])
    for n, (name, (start, p)) in enumerate(parts[i].items()):
        edges = low + width * np.array([float(start), float(start + p)])
        left, right = np.clip(edges, lower, upper)
        chosen = name == symbols[i]
        color = CHOSEN if chosen else (EVEN, ODD)[n % 2]
        axes.axvspan(left, right, color=color, alpha=1 if chosen else 0.55, lw=0)
        if right - left > 0.035 * (upper - lower):
            axes.text((left + right) / 2, 0.5, str(name), ha="center", va="center", fontsize=15)
    axes.set(
        xlim=(lower, upper),
        ylim=(0, 1),
        yticks=[],
        xticks=[lower, upper],
        xticklabels=[f"{lower:.9f}", f"{upper:.9f}"],
    )
    canvas.figure.text(0.5, 0.86, text, ha="center", fontsize=14)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


canvas = FigureCanvasAgg(Figure(figsize=(8, 2.4), dpi=80))
frames, milliseconds = [], []
for i in range(6):
    low, width = (float(v) for v in way[i])
    inner, part = (float(v) for v in way[i + 1])
    p = part / width
    text = f"feature {i + 1} of 6: symbol {symbols[i]}, p = {p:.3f}, "
    text += f"{-math.log2(p):.2f} bits; so far {-math.log2(part):.2f} bits"
    for step in range(9):  # the width shrinks by the same factor in each step
        share = p ** (step / 8)
        left = low + (inner - low) * (1 - share) / (1 - p)
        frames.append(frame(canvas, i, left, left + width * share, text))
        last = i == 5 and step == 8
        milliseconds.append(1500 if step == 0 or last else 90)
target = lessons.out() / "20_intervals_to_rans.gif"
imageio.imwrite(target, frames, duration=milliseconds, loop=0)

# %% [markdown]
# **The disadvantage of intervals.** The fractions grow without limit. Practical coders therefore
# send leading digits as soon as these are certain, and must handle carries that run back into
# digits already sent. rANS (Duda) keeps *a single integer* $x$ instead. Colour all integers:
# among every $M$ consecutive ones, $f_s$ have the colour of symbol $s$, beginning at position
# $c_s$. In our example $M = 4$.
#
# **Push** a symbol $s$: go to the integer of colour $s$ that has exactly $x$ integers of this
# colour before it. Since one in $M/f_s$ integers has this colour, the new $x$ is about $x M/f_s$,
# so it grows by $-\log_2 p_s$ bits. **Pop**: the colour of $x$ is the symbol, and the number of
# integers of this colour below it is the old $x$. The last symbol pushed is the first one popped.
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
# The right panel of the next figure pushes six features of all anchors. Python's integers have no
# size limit, so the state may simply grow, and it grows by as many bits as the prior promised.

# %%
coded = model.symbols[:, :6].ravel()
mu_units = model.context.mu_units[:, :6].ravel()
sigma_units = model.context.sigma_units[:, :6].ravel()
every = gaussian_model(mu_units, sigma_units)
entries = every.first[every.table] + coded - every.lowest
starts = (every.keys[entries] % 2**24).tolist()
freqs = np.diff(every.keys)[entries].tolist()
x = 2**31
reached = []
for start, freq in zip(reversed(starts), reversed(freqs)):
    x = x // freq * 2**24 + x % freq + start
    reached.append(math.log2(x) - 31)
promised = sections.ideal_bits_gaussian(coded, mu_units, sigma_units)[::-1].cumsum()
assert abs(reached[-1] - promised[-1]) < 0.001

# %%
figure, (shares, grid, growing) = plt.subplots(1, 3, figsize=(18, 5.5), layout="constrained")
tint = {"a": lessons.COLORS[0], "b": lessons.COLORS[4], "c": lessons.COLORS[2]}
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
lessons.finish(
    growing,
    xlabel="features pushed",
    ylabel="bits",
    title="The state grows by what the prior promised",
    legend={},
)
lessons.show(figure, "20_intervals_to_rans")

# %% [markdown]
# **A state of limited size.** The file uses $M = 2^{24}$ and keeps $x$ between $2^{31}$ and
# $2^{63}$. Before a push that would exceed this range, which is the case if $x \ge f\,2^{39}$,
# the 32 lowest bits of $x$ are moved to a stack. After a pop that falls below the range, 32 bits
# return from the stack. A message consists of one byte for the number of lanes and the size of
# $x$, then $x$, then the stack. The example in the docstring of `rans.py`, the message $0\,1\,0$
# with the probabilities $\frac34$ and $\frac14$, takes 9 bytes.


# %%
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


three_quarters, one_quarter = 3 << 22, 1 << 22
example = encode([0, three_quarters, 0], [three_quarters, one_quarter, three_quarters])
assert example.hex(" ") == "80 00 00 40 8e 03 00 00 00"
assert encode(starts, freqs) == container.read_container(data)["features"]

# %% [markdown]
# ## Backward by hand
# A coder has no gradient; training uses $-\log_2 p$ in its place. Instead, a coder has an exact
# inverse. Write $r = x \bmod f$, so that $x' = \lfloor x/f\rfloor M + r + c$. Since
# $0 \le r + c < M$, we have $\lfloor x'/M\rfloor = \lfloor x/f\rfloor$ and $x' \bmod M = r + c$.
# The condition $c \le r + c < c + f$ determines the symbol, and then
# $x = \lfloor x/f\rfloor f + r$ is known:
# $$x = \lfloor x'/M\rfloor\, f + (x' \bmod M) - c$$
# All of this is exact integer arithmetic, so pushing and popping lose nothing. The moves of words
# are inverse to each other as well: a push leaves $x' < 2^{63}$, and the pop falls below $2^{31}$
# exactly if the push had moved a word to the stack.

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
# Push from the first symbol to the last, in the order in which one writes. If all symbols share
# one table, as in the masks, everything seems to work: the length is right, the counts are right,
# and even the final state is right. Only the order is wrong, because the message is decoded
# backwards. If each symbol has its own table, the decoder uses the wrong one at once. Two checks
# detect this: the words run out, or the last state is not the one with which the encoder began.

# %%
bits = model.model.anchors.mask.ravel()
p_one = sections.probability_of_one(bits.sum(), bits.size)
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
# interval by one binary decision after another and adapts its probabilities on the way. Here the
# probabilities come from the positions by Eq. (12), so no symbol depends on another, and the
# lanes of `rans.py` can decode many symbols in parallel. The coder adds less than 8 bytes per
# section to the ideal length:

# %%
for row in inspect.ledger(data):
    if row["name"] in ("features", "scales", "offset_scales", "offsets", "masks", "hash_grid"):
        ideal, coded_bytes = row["integer_bytes"], row["payload_bytes"]
        print(f"{row['name']:14s} ideal {ideal:6.1f}, coded {coded_bytes} bytes")
        assert 0 < coded_bytes - ideal < 8

# %% [markdown]
# ## Exercises
# **20.1** ● How many bits does $b\,c\,c\,a$ take with the parts of "By hand"?
#
# **20.2** ●● Write `my_encode(entries, keys)`, which returns the bytes of one lane for symbols that
# share one table. It must reproduce the masks of the file.
#
# **20.3** ●● Write `my_decode(message, count, keys)`. It must decode the signs of the hash grid.
#
# **Predict, then run.** One sign in a hundred is negative, but the encoder's table says one in
# two. How many bits a sign does `my_encode` write with this table, and how many with the right
# one?

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


masks = container.read_container(data)["masks"]
grid = container.read_container(data)["hash_grid"]
p_plus = int.from_bytes(grid[:4], "little")
sign_keys = np.array([0, 2**24 - p_plus, 2**24])
signs = np.concatenate([level.ravel() for level in model.model.grids]) > 0
with suppress(NotImplementedError):
    answer_2 = np.frombuffer(my_encode(bits.astype(int), bit_keys), np.uint8)
with suppress(NotImplementedError):
    answer_3 = my_decode(grid[4:], len(signs), sign_keys)
lessons.number("20.1", answer_1)
lessons.number("20.2", answer_2, np.frombuffer(masks[4:], np.uint8))
lessons.number("20.3", answer_3, signs)

# %% [markdown]
# ## Check your port
# Run `p4dgs-ref oracle check DIR --only codec`. The stream `lanes` has several lanes, and
# `raw_bits` and `escapes` contain symbols outside all tables. Typical mistakes of ports are a
# state in a double, which is exact only up to 53 bits (JavaScript needs BigInt), words that
# return from the stack in the wrong order, and tables whose frequencies do not add up to
# $2^{24}$.

# %%
assert float(2**53) == float(2**53 + 1)  # a double cannot hold such a state
