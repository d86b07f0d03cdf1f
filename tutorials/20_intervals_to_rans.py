# %% [markdown]
# # Entropy coding, from intervals to rANS
#
# **Promise.** After this you can turn symbols with probabilities into bytes and back, by fractions and as the file does.
# **Before it:** `10_prior_and_likelihood`; `19_file_byte_by_byte` helps. **Takes** four seconds on two cores, an hour of yours.

# %%
import math
from contextlib import suppress
from fractions import Fraction
from types import SimpleNamespace

import imageio.v3 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from p4dgs_ref import oracle
from p4dgs_ref.codec import container, inspect, rans
from p4dgs_ref.codec import streams as sections
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.codec.gaussian_table import gaussian_model
from p4dgs_ref.oracle import streams
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
data = (oracle.path() / "model.p4dgs").read_bytes()  # a trained model of 60 anchors
model = quantised_of(container.open_container(data))

# %% [markdown]
# ## Claim
# Eq. (11) gives a symbol the price $b = -\log_2 p$, a fraction of a bit sometimes, and Eq. (13) adds the prices up. A coder makes
# that true: a whole message of probability $P = p_1 p_2 \cdots p_n$ becomes about $-\log_2 P$ bits, and each symbol has a
# table of its own. The only thing it asks for is that the decoder has the same tables, to the last digit.

# %% [markdown]
# ## By hand
# Three symbols, $p(a) = \frac{1}{2}$, $p(b) = p(c) = \frac{1}{4}$, message $a\,c\,a\,b$. Begin with all from 0 to 1.
# Each symbol keeps its part of what is left: $a$ the lower half, $b$ the third quarter, $c$ the last.
# $$[0, 1) \to [0, \tfrac12) \to [\tfrac38, \tfrac12) \to [\tfrac38, \tfrac7{16}) \to [\tfrac{26}{64}, \tfrac{27}{64})$$

# %%
P = {
    "a": (Fraction(0), Fraction(1, 2)),
    "b": (Fraction(1, 2), Fraction(1, 4)),
    "c": (Fraction(3, 4), Fraction(1, 4)),
}


def narrow(message, parts):
    """Every interval (low, width) on the way, the first from 0 to 1; parts: one {symbol: (start, probability)} a symbol."""
    way = [(Fraction(0), Fraction(1))]
    for symbol, part in zip(message, parts):
        (low, width), (start, p) = way[-1], part[symbol]
        way.append((low + width * start, width * p))
    return way


way = narrow("acab", 4 * [P])
assert way[0] == (0, 1) and [low for low, _ in way[1:]] == [
    0,
    Fraction(3, 8),
    Fraction(3, 8),
    Fraction(26, 64),
]

# %% [markdown]
# The width is $\frac12\cdot\frac14\cdot\frac12\cdot\frac14 = \frac1{64}$, the message's probability. Any number inside names it:
# 6 bits will do, and 26 is `011010`. With two bits for every symbol it would be 8. The decoder looks which part the
# number lies in, that is the symbol, and stretches that part to a whole: $(v - start)/p$.

# %%
assert (
    way[-1][1] == Fraction(1, 64)
    and -math.log2(way[-1][1]) == 6
    and f"{26:06b}" == "011010"
    and 4 * 2 == 8
)
v, found = Fraction(26, 64), ""
for _ in range(4):
    symbol = max(s for s in P if P[s][0] <= v)
    found, v = found + symbol, (v - P[symbol][0]) / P[symbol][1]
assert found == "acab"

# %% [markdown]
# ## In code
# Now six features of one anchor of a trained model. Each has its own Gaussian, so its own parts; the project's tables hold
# them as whole numbers of $2^{24}$. Any interval as wide as $2^{-b}$ holds a multiple of $2^{-b}$: bits are rounded up, once.

# %%
symbols = model.symbols[7, :6]
tables = gaussian_model(model.context.mu_units[7, :6], model.context.sigma_units[7, :6])


def parts_of(i):
    """{symbol: (start, probability)} of the i-th feature, and what is beyond its table as None."""
    first, n = tables.first[tables.table[i]], tables.blocks[tables.table[i]]
    cum = [*(int(key) % 2**24 for key in tables.keys[first : first + n + 1]), 2**24]
    names = [*range(tables.lowest[i], tables.lowest[i] + n), None]
    return {
        name: (Fraction(low, 2**24), Fraction(high - low, 2**24))
        for name, low, high in zip(names, cum, cum[1:])
    }


way = narrow(symbols.tolist(), [parts_of(i) for i in range(6)])
low, width = way[-1]
bits = math.ceil(-math.log2(width))
number = math.ceil(low * 2**bits)  # the first binary fraction of that length inside
assert low <= Fraction(number, 2**bits) < low + width
print(
    f"symbols {symbols.tolist()}: probability {float(width):.3g}, {-math.log2(width):.2f} bits, sent as {number:0{bits}b}"
)


# %%
def frame(canvas, i, lower, upper, text):
    """One picture of the animation: the parts of the i-th interval, seen through the window lower ... upper."""
    canvas.figure.clear()
    axes = canvas.figure.add_axes([0.09, 0.3, 0.82, 0.45])
    low, width = (float(v) for v in way[i])
    for n, (name, (start, p)) in enumerate(parts_of(i).items()):
        left, right = (
            float(np.clip(low + width * float(edge), lower, upper)) for edge in (start, start + p)
        )
        chosen = name == symbols[i]
        axes.axvspan(
            left,
            right,
            color=lessons.COLORS[1 if chosen else (0, 5)[n % 2]],
            alpha=1 if chosen else 0.55,
            lw=0,
        )
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


canvas, frames, milliseconds = FigureCanvasAgg(Figure(figsize=(8, 2.4), dpi=80)), [], []
for i in range(6):
    low, width, inner, part = (float(v) for v in (*way[i], *way[i + 1]))
    p, total = part / width, -math.log2(part)
    text = f"feature {i + 1} of 6: symbol {symbols[i]}, p = {p:.3f}, {-math.log2(p):.2f} bits; so far {total:.2f} bits"
    for step in range(9):  # zoom: the width shrinks evenly in bits
        share = (part / width) ** (step / 8)
        left = low + (inner - low) * (1 - share) / (1 - part / width)
        frames.append(frame(canvas, i, left, left + width * share, text))
        milliseconds.append(1500 if step == 0 or i + step == 13 else 90)
imageio.imwrite(lessons.out() / "20_intervals_to_rans.gif", frames, duration=milliseconds, loop=0)

# %% [markdown]
# **What is wrong with intervals.** The fractions grow without end; real coders send leading digits as soon as they are certain
# and must handle a carry that runs back through what was sent. rANS (Duda) keeps *one whole number* $x$ instead.
# Colour all whole numbers: of every $M$ in a row, $f_s$ have the colour of symbol $s$, from $c_s$ on; here $M = 4$.

# %% [markdown]
# **Push** $s$: go to the number of colour $s$ that has exactly $x$ numbers of that colour before it. As one in $M/f_s$ has that
# colour, $x$ becomes about $x M/f_s$: it grows by $-\log_2 p_s$ bits. **Pop**: the colour of $x$ is the symbol, and how many
# of that colour came before is the old $x$. The last symbol in is the first one out.
# $$x' = \lfloor x / f_s\rfloor M + (x \bmod f_s) + c_s$$

# %%
M, f, c = 4, {"a": 2, "b": 1, "c": 1}, {"a": 0, "b": 2, "c": 3}
colour = lambda x: "aabc"[x % M]
push = lambda x, s: x // f[s] * M + x % f[s] + c[s]
for x in range(200):
    for s in "abc":
        assert colour(push(x, s)) == s and sum(colour(y) == s for y in range(push(x, s))) == x
path = [1]
for s in reversed("acab"):
    path.append(push(path[-1], s))
print(
    "states:",
    path,
    f"so {math.log2(path[-1] / path[0]):.2f} bits, not 6: while x is small, rounding counts",
)

# %%
figure, axes = plt.subplots(1, 3, figsize=(18, 5.5), layout="constrained")
tint = dict(zip("abc", (lessons.COLORS[0], lessons.COLORS[4], lessons.COLORS[2])))
for row, (low, width) in enumerate(narrow("acab", 4 * [P])[:-1]):
    for s, (start, p) in P.items():
        left, wide = float(low + width * start), float(width * p)
        axes[0].barh(
            row,
            wide,
            left=left,
            color=tint[s],
            alpha=1 if s == "acab"[row] else 0.3,
            height=0.8,
            lw=0,
        )
        if wide > 0.06:
            axes[0].text(left + wide / 2, row, s, ha="center", va="center", fontsize=14)
axes[0].set(
    xlim=(0, 1),
    ylim=(3.6, -0.6),
    yticks=range(4),
    yticklabels=list("acab"),
    xlabel="from 0 to 1",
    ylabel="symbol coded",
    title="Intervals: each symbol keeps its share",
)
for x in range(56):
    axes[1].add_patch(
        plt.Rectangle(
            (x % 8, x // 8), 0.94, 0.94, color=tint[colour(x)], alpha=0.75 if x in path else 0.3
        )
    )
    axes[1].text(
        x % 8 + 0.47,
        x // 8 + 0.5,
        x,
        ha="center",
        va="center",
        fontsize=13,
        weight="bold" if x in path else None,
    )
for old, new, s in zip(path, path[1:4], "bac"):
    axes[1].annotate(
        "",
        (new % 8 + 0.47, new // 8 + 0.5),
        (old % 8 + 0.47, old // 8 + 0.5),
        arrowprops=dict(
            arrowstyle="->", lw=2.5, shrinkA=14, shrinkB=14, connectionstyle="arc3,rad=0.3"
        ),
    )
axes[1].set(
    xlim=(0, 8),
    ylim=(7, 0),
    xticks=[],
    yticks=[],
    title="rANS: push b, a, c: " + " → ".join(map(str, path[:4])),
)
args = [
    a[:, :6].ravel() for a in (model.symbols, model.context.mu_units, model.context.sigma_units)
]
every = gaussian_model(*args[1:])
entries = every.first[every.table] + args[0] - every.lowest
x, reached = 2**31, []
for start, freq in zip(
    (every.keys[entries] % 2**24)[::-1].tolist(), np.diff(every.keys)[entries][::-1].tolist()
):
    x = x // freq * 2**24 + x % freq + start  # no renormalising: Python's integers are long enough
    reached.append(math.log2(x) - 31)
ideal = sections.ideal_bits_gaussian(*args)[::-1].cumsum()
axes[2].plot(ideal, lw=7, alpha=0.35, label=r"$\sum -\log_2 p$")
axes[2].plot(reached, "--", color="k", label=r"growth of $\log_2 x$")
axes[2].set(
    xlabel="features pushed", ylabel="bits", title="The state grows by what the prior promised"
)
axes[2].legend()
assert abs(reached[-1] - ideal[-1]) < 0.001
lessons.show(figure, "20_intervals_to_rans")

# %% [markdown]
# **The state must not grow for ever.** Here $M = 2^{24}$, and $x$ is kept from $2^{31}$ to below $2^{63}$: before a push that
# would go beyond, $x \ge f\,2^{39}$, the 32 low bits go to a stack; after a pop that falls below, they return. The message of
# `rans.py`: probabilities $\frac34$ and $\frac14$, message $0\,1\,0$, 9 bytes: one for lanes and size, then $x$.


# %%
def encode(starts, freqs):
    """Bytes of one lane: what rans.py calls push, from the last symbol to the first."""
    x, stack = 2**31, []
    for start, freq in zip(reversed(starts), reversed(freqs)):
        if x >= freq << 39:
            stack.append(x % 2**32)
            x >>= 32
        x = x // freq * 2**24 + x % freq + start
    words = [x % 2**32, *([x >> 32] if x >> 32 else []), *stack[::-1]]
    return bytes([0x80 if x >> 32 else 0]) + np.array(words, "<u4").tobytes()


worked = encode([0, 12582912, 0], [12582912, 4194304, 12582912])
assert 12582912 / 2**24 == 3 / 4 and len(worked) == 9 and 2**32 - 1 == int(32 * "1", 2)
assert worked.hex(" ") == "80 00 00 40 8e 03 00 00 00"
mine = encode((every.keys[entries] % 2**24).tolist(), np.diff(every.keys)[entries].tolist())
assert mine == container.read_container(data)["features"]  # the whole section of the file

# %% [markdown]
# ## Backward by hand
# A coder has no gradient; training uses $-\log_2 p$ in its place. What it has is an exact inverse. With $r = x \bmod f$ and
# $x' = \lfloor x/f\rfloor M + r + c$: as $0 \le r + c < M$, $\lfloor x'/M\rfloor = \lfloor x/f\rfloor$ and $x' \bmod M = r + c$.
# $c \le r + c < c + f$ finds the symbol, and $x = \lfloor x/f\rfloor f + r$ is then known:

# %% [markdown]
# $$x = \lfloor x'/M\rfloor\, f + (x' \bmod M) - c$$
# No rounding anywhere: pushing and popping cost nothing but time. Also the word moves undo each other: a push leaves
# $x' < 2^{63}$; the pop falls below $2^{31}$ exactly if the push had put a word away.

# %%
rng = np.random.default_rng(20)
for _ in range(2000):
    freq = int(rng.integers(1, 2**24))
    start, x = int(rng.integers(0, 2**24 - freq + 1)), int(rng.integers(2**31, 2**63))
    full = x >= freq << 39
    y = x >> 32 if full else x
    pushed = y // freq * 2**24 + y % freq + start
    popped = (pushed // 2**24) * freq + pushed % 2**24 - start
    assert (
        2**31 <= pushed < 2**63
        and start <= pushed % 2**24 < start + freq
        and popped == y
        and (popped < 2**31) == full
    )

# %% [markdown]
# ## Break it
# Push from the first symbol to the last, as one writes. With one table for all, as the masks have, all looks fine: the length,
# the counts, even the state at the end. Only the order is wrong: it comes out backwards. With a table for each symbol the
# decoder asks the wrong one at once. Two checks see it: the words run out, or the last state is not the encoder's first.

# %%
bits = model.model.anchors.mask.ravel()
bit_keys = np.array([0, 2**24 - sections.probability_of_one(bits.sum(), bits.size), 2**24])
right, wrong = (rans.encode(way.astype(int), bit_keys) for way in (bits, bits[::-1]))
backwards = rans.decode(wrong, np.zeros(len(bits), int), bit_keys)[0]
assert (
    len(right) == len(wrong)
    and np.array_equal(backwards[::-1], bits)
    and not np.array_equal(backwards, bits)
)
try:
    rans.decode(rans.encode(entries[::-1], every.keys), every.table, every.keys)
    raise AssertionError("a reversed message was taken")
except container.BitstreamError as error:
    print(error)

# %% [markdown]
# ## What a codec does with it
# CABAC, of video and in the paper's introduction, narrows an interval by one binary decision after the other and learns its
# probabilities as it goes. Here they come from positions, Eq. (12): no symbol needs another, and the lanes of `rans.py`
# decode many in step. What the coder adds to the ideal is under 8 bytes a section:

# %%
for row in inspect.ledger(data):
    if row["name"] in ("features", "scales", "offset_scales", "offsets", "masks", "hash_grid"):
        print(
            f"{row['name']:14s} ideal {row['integer_bytes']:6.1f}, coded {row['payload_bytes']} bytes"
        )
        assert 0 < row["payload_bytes"] - row["integer_bytes"] < 8

# %% [markdown]
# ## Exercises
# **20.1** How many bits is $b\,c\,c\,a$, with the parts above? **20.2** Write `my_encode(entries, keys)`: the bytes of one lane,
# for one table. It must give the masks of the file. **20.3** Write `my_decode(message, count, keys)`, for a hash grid's signs.

# %%
answer_1 = ...


def my_encode(entries, keys):
    """bytes: lane byte, x (low word, high word if there is one), the stack, its top first; entry i is keys[i] ... keys[i+1]."""
    raise NotImplementedError


def my_decode(message, count, keys):
    """The entries, as many as `count`, of what my_encode made; at the end x is 2^31 and no word is left."""
    raise NotImplementedError


grid, answer_2, answer_3 = container.read_container(data)["hash_grid"], ..., ...
signs = np.concatenate([level.ravel() for level in model.model.grids]) > 0
with suppress(NotImplementedError):
    answer_2 = np.frombuffer(my_encode(bits.astype(int), bit_keys), np.uint8)
with suppress(NotImplementedError):
    answer_3 = my_decode(
        grid[4:], len(signs), np.array([0, 2**24 - int.from_bytes(grid[:4], "little"), 2**24])
    )
lessons.number("20.1", answer_1, 7)
lessons.number(
    "20.2", answer_2, np.frombuffer(container.read_container(data)["masks"][4:], np.uint8)
)
lessons.number("20.3", answer_3, signs)

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only codec`; stream `lanes` has several lanes, `raw_bits` and `escapes` what no table holds.
# What goes wrong: a state in a double, which is exact to 53 bits only (JavaScript wants BigInt), words put back in the
# order in which they were put away, and a table whose frequencies do not add up to $2^{24}$.


# %%
def decode(name, stream):
    try:
        return streams.decoded(stream), None
    except container.BitstreamError as error:
        return None, str(error)


report = oracle.check_port(SimpleNamespace(decode=decode, strangers=list), only="codec")
print(report)
assert report.ok and float(2**53) == float(2**53 + 1)
