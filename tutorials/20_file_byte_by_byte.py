# %% [markdown]
# # The file, byte by byte
#
# **Promise.** After this you can open a `.p4dgs` file with nothing but `struct`, and say of each
# byte what it is for. **Before it:** `07_noise_and_rounding`, `10_prior_and_likelihood`. **Takes**
# ten seconds on two cores, 25 minutes of reading and 40 of exercises.
#
# **Files:** [container.py](../p4dgs_ref/codec/container.py),
# [header.py](../p4dgs_ref/codec/header.py), [file.py](../p4dgs_ref/codec/file.py),
# [streams.py](../p4dgs_ref/codec/streams.py).

# %%
import json
import struct
import zlib
from contextlib import suppress

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show("20_file_byte_by_byte", "rounding", "entropy_coder", "file")

# %% [markdown]
# ## What fails without it
# A disk or a network changes a bit now and then. A file that is nothing but its numbers, one after
# another, opens all the same and shows another scene.
#
# The cell makes three copies of `demo.p4dgs`, flips one bit in each of them, and makes the
# checksums right again, as if there were none. The decoder accepts all three. The numbers are means
# over the ten test views, and *anchor 29*, which leads through the tutorials, is purple; in the
# last picture it is above the frame.

# %%
import p4dgs_ref as p4
from p4dgs_ref.codec import container

scene, thread = p4.load_scene("bouncing"), figures.THREAD
demo = container.read_container(tour.DATA)


def flipped(message, bit):
    changed = bytearray(message)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def forged(sections, name, bit):
    """The file in which one bit of a section is wrong and all checksums are right."""
    return container.write_container({**sections, name: flipped(sections[name], bit)})


places = {  # section and bit
    "weight of the motion network": ("deformation_mlp", 16 * 6671 + 14),  # the one of the tour
    "weight of a prediction network": ("anchor_mlps", 108302),
    "corner of the bounding box": ("positions", 8 * 23),
}
opened = {what: p4.decode(forged(demo, name, bit)) for what, (name, bit) in places.items()}
opened = {"no bit is wrong": tour.MODEL} | opened
quality = {what: p4.evaluate(model, scene)[0]["psnr_db"] for what, model in opened.items()}
print({what: f"{db:.1f} dB" for what, db in quality.items()})
assert max([*quality.values()][1:]) < 25

# %%
shown = {f"{what}\n{quality[what]:.1f} dB": model for what, model in opened.items()}
show.compared("20_one_bit", shown, tour.CAMERA, tour.T, tour.VIEW)

# %% [markdown]
# The coded sections protect themselves: the entropy coder notices at the end of a section that its
# state is wrong (`21_intervals_to_rans`). This reaches further than one might think. A position
# that is wrong by more than a little is looked up elsewhere in the hash grid and gives the anchor
# other probabilities, so its features can no longer be decoded. The cell flips each of the 48 bits
# of the position of anchor 29. The 12 flips that pass unnoticed move it by a thousandth of the box
# at most, which nobody sees.


# %%
def refused(read, *arguments):
    try:
        read(*arguments)
    except p4.BitstreamError:
        return True
    return False


first = 8 * (24 + 6 * thread.index)  # after the box and the anchors before it
noticed = [refused(p4.decode, forged(demo, "positions", first + bit)) for bit in range(48)]
unnoticed = [f"{'xyz'[bit // 16]} bit {bit % 16}" for bit in range(48) if not noticed[bit]]
print(f"{sum(noticed)} of 48 flips are noticed, but not: {', '.join(unnoticed)}")
assert sum(noticed) == 36

# %% [markdown]
# ## Claim
# Eq. (13) and Eq. (14) count bits. A file must hold these bits and everything that the equations
# leave out: the positions, the networks, and a description of how to read the rest. It consists
# of a frame, a table of $S$ sections, and the sections themselves. Every byte belongs to exactly
# one of these parts:
# $$bytes = \underbrace{14}_{frame} + \underbrace{9\,S}_{table} + \underbrace{4}_{checksum}
#   + \sum_i bytes_i$$

# %%
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
# Anchor 29 of the demo is read in the same way. Its position takes six bytes, from 24 + 6 · 29 on.

# %%
box = np.frombuffer(demo["positions"], "<f4", 6).reshape(2, 3).astype(float)
n = np.frombuffer(demo["positions"], "<u2", 3, 24 + 6 * thread.index)
place = box[0] + n * ((box[1] - box[0]) / 65535)
assert np.array_equal(place, tour.MODEL.anchors.x_a[thread.index])
print(n.astype("<u2").tobytes().hex(" "), "is at", place.round(3))

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
    1, 2, figsize=(10, 6), layout="constrained", width_ratios=(1, 1.35)
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
# ## Break it
# Flip any bit of the file, and the reader refuses it, for all 7840 bits. The plausible mistake is
# a reader that skips the checksums. Half of this file consists of weights, and a damaged weight
# is still a weight, so the file opens without a warning.


# %%
for bit in range(8 * len(data)):
    assert refused(container.read_container, flipped(data, bit))
opened, tried = 0, 0
for name, body in sections.items():
    for bit in range(3, 8 * len(body), 89):
        opened += not refused(p4.decode, forged(sections, name, bit))
        tried += 1
print(f"without checksums, {opened} of {tried} flipped bits are not noticed")
assert opened > tried / 2

# %% [markdown]
# ## What a codec does with it
# A video stream has the same structure: a start code, units with a type and a length, parameter
# sets first, then coded symbols. In the demo's file, the four sections that prediction and
# context modelling act on have 3,333 of 38,683 bytes, and most of the rest are networks. The scenes
# of the paper have many more anchors, so their attributes weigh more and the frame hardly counts.
# [See it move](viewer/demo.html#step=bits): the demo's file as a strip of bytes.
#
# ## What this idea buys
# Frame, table and checksums are 117 bytes, 0.3 percent of the file. For this price a reader refuses
# every file in which a single bit is wrong, instead of showing one of the pictures at the
# beginning. The paper does not describe a file format, so the price is that of our choice.

# %%
from p4dgs_ref.report import inspect

for row in inspect.ledger(tour.DATA):
    estimate_bytes = row["estimate_bytes"]
    print(f"{row['name']:16s} {row['bytes']:5d} bytes, estimate {estimate_bytes:8.1f}")
sizes = dict(container.layout(tour.DATA))
attributes = sum(sizes[name] for name in ("features", "scales", "offset_scales", "offsets"))
frame = len(tour.DATA) - sum(len(body) for body in demo.values())
assert (attributes, frame, len(tour.DATA)) == (3333, 117, 38_683)

# %% [markdown]
# **In short**
# - Every byte belongs to the frame, the table or one section, and every section has a checksum.
# - Positions and networks are plain numbers; attributes, masks and grid are entropy coded.
# - The length of a file has no slope: it changes only where a symbol does. Training follows the
#   smooth estimate of Eq. (11) instead.
#
# **Often misunderstood**
# - *A wrong bit breaks the decoder.* In plain numbers it gives another valid number.
# - *Entropy coding makes most of the file smaller.* It acts on a tenth of this file; the networks
#   are stored as they are.
# - *The file needs a list of steps and probabilities.* The decoder computes both.

# %% [markdown]
# ## Exercises
# **20.1** ● How many bytes do the positions of $400$ anchors take?
#
# **20.2** ●● Where is anchor $17$ of the published model `golden`? Use `struct`.
#
# **20.3** ●●● Write `my_container(data)`, which returns `{name: bytes}` or raises `ValueError`. It
# is tried on all published streams, both valid and damaged: 23 must be read, and among
# the damaged ones 14 have a bad frame and must be refused.
#
# **Predict, then run.** One bit of a file flips on the disk. Can a flipped bit stay unnoticed by
# `my_container`, for example one in a checksum itself?

# %%
from p4dgs_ref import oracle
from p4dgs_ref.oracle import streams

golden = (oracle.path() / "model.p4dgs").read_bytes()
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
