# %% [markdown]
# # The file, byte by byte
#
# **Promise.** After this you can open a `.p4dgs` file with nothing but `struct`, and say of each
# byte what it is for. **Before it:** `07_noise_and_rounding`, `10_prior_and_likelihood`. **Takes**
# four seconds on two cores, 25 minutes of reading and 40 of exercises.
#
# **Files:** [container.py](../p4dgs_ref/codec/container.py),
# [header.py](../p4dgs_ref/codec/header.py), [file.py](../p4dgs_ref/codec/file.py),
# [streams.py](../p4dgs_ref/codec/streams.py).

# %%
import json
import struct
import zlib
from contextlib import suppress
from dataclasses import replace

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures

plt = figures.pyplot()
architecture.show("20_file_byte_by_byte", "rounding", "entropy_coder", "file")

# %% [markdown]
# ## Claim
# Eq. (13) and Eq. (14) count bits. A file must hold these bits and everything that the equations
# leave out: the positions, the networks, and a description of how to read the rest. It consists
# of a frame, a table of $S$ sections, and the sections themselves. Every byte belongs to exactly
# one of these parts:
# $$bytes = \underbrace{14}_{frame} + \underbrace{9\,S}_{table} + \underbrace{4}_{checksum}
#   + \sum_i bytes_i$$

# %%
from p4dgs_ref.codec import container
from p4dgs_ref.oracle.streams import STREAMS

data = (STREAMS / "one_anchor.p4dgs").read_bytes()  # one anchor with one child

parts = container.layout(data)
sizes = [size for _, size in parts]
S = len(parts) - 2
assert sum(sizes) == 14 + 9 * S + 4 + sum(sizes[2:]) == len(data)
print(len(data), "bytes:", ", ".join(f"{name} {size}" for name, size in parts))

# %% [markdown]
# ## By hand
# The smallest useful example has a single section, number 7 (the masks), with the bytes
# `01 02 03`. The whole file has 30 bytes. All integers are little-endian, which means that the
# lowest byte comes first: the length 30 is stored as `1e 00 00 00`.

# %%
body = b"\1\2\3"
head = b"\x89P4D\r\n\x1a\n"  # the magic number
head += struct.pack("<BBI", 1, 1, 30)  # version, number of sections, length of the file
head += struct.pack("<BII", 7, 3, zlib.crc32(body))  # a row of the table: id, length, checksum
smallest = head + struct.pack("<I", zlib.crc32(head)) + body
assert (len(smallest), smallest[10:14].hex(" ")) == (30, "1e 00 00 00")
assert container.read_container(smallest) == {"masks": body}

# %% [markdown]
# The magic number is chosen so that damaged copies are noticed early. A copy that keeps only
# seven bits of each byte changes its first byte, and a copy in text mode changes its line ends.
# PNG begins in the same way for the same reason.

# %%
seven_bits = bytes(byte & 127 for byte in data)
unix = data.replace(b"\r\n", b"\n")
windows = data.replace(b"\n", b"\r\n")
for damaged in (seven_bits, unix, windows):
    assert damaged[:8] != container.MAGIC

# %% [markdown]
# The checksum is the `CRC-32` of zlib. It regards the message as a long polynomial with bits as
# coefficients, divides it by a fixed polynomial, and keeps the remainder. Bit by bit this takes a
# few lines. It detects every single wrong bit, and every burst of wrong bits that is at most 32
# bits long.


# %%
def crc32(message):
    c = 0xFFFFFFFF
    for byte in message:
        c ^= byte
        for _ in range(8):
            divides = c & 1  # the leading term is in the lowest bit
            c >>= 1
            if divides:
                c ^= 0xEDB88320
    return c ^ 0xFFFFFFFF


assert crc32(body) == zlib.crc32(body)
rng = np.random.default_rng(19)
number = int.from_bytes(data, "little")
for _ in range(500):
    burst = (1 << 31) + int(rng.integers(2**31))  # 32 bits, of which random ones are wrong
    place = int(rng.integers(8 * len(data) - 31))
    damaged = (number ^ burst << place).to_bytes(len(data), "little")
    assert zlib.crc32(damaged) != zlib.crc32(data)

# %% [markdown]
# ## In code
# Now the real file: fourteen bytes of frame, then one row of the table for each section. A reader
# verifies the checksum of a part before it uses any of its bytes.

# %%
magic, version, count, total = struct.unpack_from("<8sBBI", data)
table_end = 14 + 9 * count
(table_crc,) = struct.unpack_from("<I", data, table_end)
assert magic == container.MAGIC and version == 1 and total == len(data) == 980
assert zlib.crc32(data[:table_end]) == table_crc
sections = {}
start = table_end + 4
for row in range(count):
    section, length, crc = struct.unpack_from("<BII", data, 14 + 9 * row)
    body = data[start : start + length]
    assert zlib.crc32(body) == crc
    sections[container.SECTIONS[section - 1]] = body
    start += length
assert (start, sections) == (total, container.read_container(data))
print(sections["header"].decode())

# %% [markdown]
# **The header** is JSON. It contains the widths of the networks, the levels of the grid and the
# base steps $Q_0$, from which all other lengths can be derived.
#
# **Positions** are stored as a bounding box of six `float32` and three `uint16` for each anchor,
# 6 bytes per anchor. An anchor is at $x_a = lo + n\,(hi - lo)/65535$.
#
# **Networks** are stored as `float16` without further coding. There is no learned prior for
# weights, so every weight costs its full 16 bits.

# %%
header = json.loads(sections["header"])
box = struct.unpack_from("<6f", sections["positions"])
n = struct.unpack_from("<3H", sections["positions"], 24)
x_a = [lo + i * ((hi - lo) / 65535) for lo, hi, i in zip(box[:3], box[3:], n)]
assert (x_a, len(sections["positions"])) == ([-1.5, -1.0, 0.25], 24 + 6 * header["anchors"])
weights = np.frombuffer(sections["context_mlps"], "<f2")
assert np.isfinite(weights).all()

# %% [markdown]
# **Masks and hash grid** are bits that share one probability. Four bytes hold $p_+\cdot 2^{24}$,
# and a message follows unless all bits are equal. Here the mask is a single bit of probability
# one, so no message follows. The grid has 4 signs with $p_+ = \frac{3}{4}$. Its message is one
# integer $x$. The number $x \bmod 2^{24}$ is called the *slot* and determines the sign: slots
# below $2^{22}$ stand for $-1$. (`21_intervals_to_rans` explains why.)

# %%
p_mask = int.from_bytes(sections["masks"], "little")
assert p_mask == 2**24 and len(sections["masks"]) == 4
(p_plus,) = struct.unpack_from("<I", sections["hash_grid"])
assert p_plus / 2**24 == 3 / 4
p_minus = 2**24 - p_plus
assert p_minus == 2**22
x = int.from_bytes(sections["hash_grid"][5:13], "little")  # byte 4 is the size of x
signs = []
for _ in range(4):
    slot = x % 2**24
    if slot < p_minus:
        signs.append(-1)
        x = x // 2**24 * p_minus + slot
    else:
        signs.append(1)
        x = x // 2**24 * p_plus + slot - p_minus
assert (signs, x) == ([1, 1, 1, -1], 2**31)  # and the value with which the encoder began

# %% [markdown]
# **Features, scales and offsets** are the symbols $\lfloor f/q\rceil$. Each symbol has a
# probability table of its own, which is computed from two integers that represent $\mu/q$ and
# $\log_2(\sigma/q)$. For the only feature here they are 2331, in units of $1/1024$, and -56, in
# units of $1/16$. That is a mean of 2.28 and a deviation of 0.09 steps. The message is
# `x = 0x80c0d682`. Its slot lies in the block of the symbol 2, so $f = 2q$.

# %%
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.codec.gaussian_table import gaussian_model

quantised = quantised_of(sections)
mu_units = quantised.context.mu_units[0, :1]
sigma_units = quantised.context.sigma_units[0, :1]
assert mu_units.tolist() == [2331] and round(2331 / 1024, 2) == 2.28
assert sigma_units.tolist() == [-56] and round(2 ** (-56 / 16), 2) == 0.09
table = gaussian_model(mu_units, sigma_units)
x = int.from_bytes(sections["features"][1:], "little")
assert x == 0x80C0D682
block = int(np.searchsorted(table.keys, x % 2**24, "right")) - 1
symbol = table.lowest[0] + block
assert (symbol, quantised.model.anchors.f_a[0, 0]) == (2, 2 * quantised.context.q[0, 0])
widths_of_blocks = np.diff(table.keys)[:5].tolist()
print("the feature's table:")
for i, width in enumerate(widths_of_blocks):
    print(f"    symbol {table.lowest[0] + i}: {width} of {2**24} slots")

# %%
shades = np.array([plt.matplotlib.colors.to_rgb(figures.COLORS[i % 6]) for i in range(len(parts))])
strength = np.repeat((0.35, 0.75, 0.15), 6)[: len(parts), None]
shades = 1 - strength * (1 - shades)
figure, (plan, words) = plt.subplots(
    1,
    2,
    figsize=(10, 6),
    layout="constrained",
    width_ratios=(1, 1.35),
)
plan.imshow(np.repeat(shades, sizes, axis=0).reshape(35, 28, 3), extent=(0, 28, 35, 0))
plan.set_xticks(np.arange(1, 28), [], minor=True)
plan.set_yticks(np.arange(1, 35), [], minor=True)
figures.finish(
    plan,
    xticks=[],
    yticks=np.arange(0, 35, 5),
    yticklabels=np.arange(0, 980, 140),
    ylabel="address (bytes)",
    aspect="auto",
    title="Each square is a byte",
)
plan.grid(which="both", color="white", alpha=1)
plan.tick_params(which="minor", length=0)
starts = np.cumsum([0, *sizes])
for i, (name, size) in enumerate(parts):
    first = data[starts[i] : starts[i] + min(size, 6)].hex(" ")
    words.add_patch(plt.Rectangle((0, i - 0.4), 0.7, 0.8, color=shades[i]))
    words.text(1, i, f"{name.replace('_', ' ')}, {size}", va="center", fontsize=14)
    words.text(8.3, i, first + " …" * (size > 6), va="center", family="monospace", fontsize=13)
figures.finish(
    words,
    frame_on=False,
    xlim=(0, 14.5),
    ylim=(len(parts) - 0.5, -0.5),
    xticks=[],
    yticks=[],
    title="Part, its length, and its first bytes",
)
figure.suptitle("A model in 980 bytes; entropy coding acts only on the thin stripe in the middle")
figures.show(figure, "20_file_byte_by_byte")

# %% [markdown]
# ## Backward by hand
# A file has no backward pass. If a feature is moved continuously, its symbol changes only at
# ties. The bytes are therefore constant almost everywhere, and their derivative is 0 or does not
# exist. Training follows the smooth estimate of Eq. (11) instead, and the next figure compares
# this estimate with the truth. It uses a trained model of 60 anchors. All features of one anchor
# are moved together in small steps, and the file is written again after each step. Far from the
# mean the staircase stays below the estimate, because a table gives even the rarest symbol one of
# its $2^{24}$ counts. Such a symbol costs 24 bits, whereas Eq. (11) asks for more.

# %%
import p4dgs_ref as p4
from p4dgs_ref import oracle
from p4dgs_ref.codec.streams import ideal_bits_gaussian
from p4dgs_ref.equations import likelihood
from p4dgs_ref.report import inspect

golden = (oracle.path() / "model.p4dgs").read_bytes()
trained = quantised_of(container.read_container(golden))
anchors = trained.model.anchors
prior = inspect.float_context(trained.model)
d = trained.model.design.d
step = trained.context.q[7, 0]
mu_units = trained.context.mu_units[7, :d]
sigma_units = trained.context.sigma_units[7, :d]
steps_up = np.linspace(-6, 12, 73) + 0.003  # never on a tie
moved = anchors.f_a[7] + steps_up[:, None] * step  # (73, d)


def with_features(values):
    """The model in which anchor 7 has other features."""
    f_a = anchors.f_a.copy()
    f_a[7] = values
    return replace(trained.model, anchors=anchors._replace(f_a=f_a))


lengths, table_bits = [], []
for values in moved:
    lengths.append(len(p4.encode(with_features(values))))
    symbols = np.rint(values / step).astype(int)
    table_bits.append(ideal_bits_gaussian(symbols, mu_units, sigma_units).sum())
estimate, saved = likelihood.forward(
    moved,
    np.tile(prior.mu[7, :d], (73, 1)),
    np.tile(prior.sigma[7, :d], (73, 1)),
    np.full((73, d), step),
)
slope = likelihood.backward(saved, np.ones((73, d)))["f_noisy"].sum(axis=1)
assert np.count_nonzero(slope) == len(moved)  # the estimate has a slope everywhere,
assert len(set(lengths)) < len(set(table_bits)) < len(moved)  # the others are staircases
assert set(np.diff(lengths)) <= {-4, 0, 4}  # a message consists of words of 32 bits
assert table_bits[-1] < 24 * d < estimate.sum(axis=1)[-1]

# %%
figure, axes = plt.subplots(figsize=(9, 5))
axes.plot(steps_up, estimate.sum(axis=1), label="estimate, Eq. (11)")
axes.step(steps_up, table_bits, where="mid", label="ideal bits under\nthe integer tables")
axes.step(
    steps_up,
    8 * (np.array(lengths) - len(golden)),
    where="mid",
    ls="--",
    label="length of the file, relative to the original",
)
figures.finish(
    axes,
    xlabel="how far the features of anchor 7 are moved (in steps q)",
    ylabel="bits",
    title="The estimate has a slope, the file is a staircase",
)
figures.label(
    axes,
    (5.9, 142),
    (3.2, 92),
    (-5.4, 4),
    fontsize=11,
)
figures.show(figure, "20_what_no_gradient_sees")

# %% [markdown]
# ## Break it
# Flip any bit of the file, and the reader refuses it, for all 7840 bits. The plausible mistake is
# a reader that skips the checksums. Half of this file consists of weights, and a damaged weight
# is still a weight, so the file opens without a warning.


# %%
def flipped(message, bit):
    changed = bytearray(message)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def refused(read, *arguments):
    try:
        read(*arguments)
    except p4.BitstreamError:
        return True
    return False


for bit in range(8 * len(data)):
    assert refused(container.read_container, flipped(data, bit))
opened, tried = 0, 0
for name, body in sections.items():
    for bit in range(3, 8 * len(body), 89):
        damaged = {**sections, name: flipped(body, bit)}
        forged = container.write_container(damaged)  # with checksums that fit
        opened += not refused(p4.decode, forged)
        tried += 1
print(f"without checksums, {opened} of {tried} flipped bits are not noticed")
assert opened > tried / 2

# %% [markdown]
# ## What a codec does with it
# A video stream has the same structure: a start code, units with a type and a length, parameter
# sets first, then coded symbols. In the trained model, the four sections that prediction and
# context modelling act on have 748 of 9730 bytes, and most of the rest are networks. The scenes
# of the paper have many more anchors, so their attributes weigh more and the frame hardly counts.
# [See it move](viewer/demo.html#step=bits): the demo's file as a strip of bytes.

# %%
sizes = dict(container.layout(golden))
attributes = sum(sizes[name] for name in ("features", "scales", "offset_scales", "offsets"))
networks = sum(size for name, size in sizes.items() if "mlp" in name)
assert (attributes, len(golden)) == (748, 9730)
assert networks > 0.8 * len(golden)
for row in inspect.ledger(golden):
    estimate_bytes = row["estimate_bytes"]
    print(f"{row['name']:16s} {row['bytes']:5d} bytes, estimate {estimate_bytes:8.1f}")

# %% [markdown]
# ## Exercises
# **20.1** ● How many bytes do the positions of $400$ anchors take?
#
# **20.2** ●● Where is anchor $17$ of `golden`? Use `struct`.
#
# **20.3** ●●● Write `my_container(data)`, which returns `{name: bytes}` or raises `ValueError`. It
# is tried on all published streams, both valid and damaged: 23 must be read, and among
# the damaged ones 14 have a bad frame and must be refused.
#
# **Predict, then run.** One bit of a file flips on the disk. Can a flipped bit stay unnoticed by
# `my_container`, for example one in a checksum itself?

# %%
from p4dgs_ref.oracle import streams

answer_1 = answer_2 = answer_3 = ...


def my_container(data):
    """Return {name of container.SECTIONS: bytes}.

    Raise ValueError for a wrong magic number, version, length or checksum, and for section ids that
    are unknown or not rising.
    """
    raise NotImplementedError


def published(kind):
    """The published streams of a kind, good or bad."""
    return [(streams.STREAMS / row["file"]).read_bytes() for row in streams.read_rows()[kind]]


def grade_container(mine):
    """Count the valid streams that are read correctly and the bad frames that are refused."""
    good = published("good")
    read = sum(mine(whole) == container.read_container(whole) for whole in good)
    refusals = 0
    for bad in published("bad"):
        if refused(container.read_container, bad):
            try:
                mine(bad)
            except ValueError:
                refusals += 1
    return [read, refusals]


assert grade_container(container.read_container) == [23, 14]
with suppress(NotImplementedError):
    answer_3 = grade_container(my_container)
lessons.check_number("20.1", answer_1)
lessons.check_number("20.2", answer_2, digits=15)
lessons.check_number("20.3", answer_3, [23, 14])

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only codec` reads the arrays that a port decoded from the
# published streams. In Python, `oracle.check_port(port, only="codec")` takes an object whose
# method `decode(name, stream)` returns the arrays and None, or None and the reason of a refusal.
# Typical mistakes of ports at this level are native instead of little-endian numbers, lengths that
# are used before they are checked, a section that may be absent and is expected nevertheless, and
# positions divided by `65536` instead of `65535`.

# %% [markdown]
# ## An open project
# **Code the positions better.** A position takes 6 bytes, 16 bits for each coordinate, and nothing
# predicts it. `p4dgs-ref inspect tutorials/demo.p4dgs` prints the baseline: 1,218 bytes for 199
# anchors. Of these, 24 are the box and 1,194 the coordinates.
#
# Write an encoder and a decoder, and count all bytes, those of tables too. The decoder must return
# exactly the same points; their order is free, because the other sections can follow it. That
# alone is worth $\log_2 199! = 1238$ bits: sort the points along a curve and code only the gaps.
# Fewer than 1,039 bytes are therefore a success. Then measure the file of another scene, for
# example that of `p4dgs-ref demo figure -o figure`: a coder may be tuned to a single file.
#
# Sorting alone gives nothing more, if every place is equally likely. But anchors stand in groups
# and on surfaces. You could halve the box along each axis, again and again, code which of the eight
# parts are empty, and predict this from the parts around them. `quantised.positions` has the
# integers.
