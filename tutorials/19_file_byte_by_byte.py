# %% [markdown]
# # The file, byte by byte
#
# **Promise.** After this you can open a `.p4dgs` file with nothing but `struct` and say of each byte what it is for.
# **Before it:** `07_noise_and_rounding`, `10_prior_and_likelihood`. **Takes** four seconds on two cores, an hour of yours.

# %%
import json
import struct
import zlib
from dataclasses import replace

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref import oracle
from p4dgs_ref.codec import container, inspect, published
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.codec.gaussian_table import gaussian_model
from p4dgs_ref.codec.streams import ideal_bits_gaussian
from p4dgs_ref.equations import likelihood
from p4dgs_ref.oracle import streams
from p4dgs_ref.school import lessons

plt = lessons.pyplot()
data = (
    published.FOLDER / "one_anchor.p4dgs"
).read_bytes()  # the smallest model there is: one anchor, one child

# %% [markdown]
# ## Claim
# Eq. (13) and Eq. (14) count bits. A file must hold those bits and all that the equations leave out: positions, networks, and
# how to read the rest. Here it is a frame, a table of $S$ sections, and the sections; no byte is without an owner:
# $$bytes = \underbrace{14}_{frame} + \underbrace{9\,S}_{table} + \underbrace{4}_{checksum} + \sum_i bytes_i$$

# %%
parts = container.layout(data)
S = len(parts) - 2
assert len(data) == 14 + 9 * S + 4 + sum(n for _, n in parts[2:]) == sum(n for _, n in parts)
print(len(data), "bytes:", ", ".join(f"{name} {n}" for name, n in parts))

# %% [markdown]
# ## By hand
# The smallest file worth writing has one section, number 7 (masks), with the bytes `01 02 03`: 30 bytes in all.
# All integers are little-endian, the lowest byte first: the length 30 is `1e 00 00 00`.

# %%
head = b"\x89P4D\r\n\x1a\n" + struct.pack(
    "<BBI", 1, 1, 30
)  # magic, version, number of sections, total length
head += struct.pack(
    "<BII", 7, 3, zlib.crc32(b"\1\2\3")
)  # one row of the table: id, length, checksum
smallest = head + struct.pack("<I", zlib.crc32(head)) + b"\1\2\3"
assert (
    len(smallest) == 30
    and smallest[10:14].hex(" ") == "1e 00 00 00"
    and container.SECTIONS[7 - 1] == "masks"
)
assert container.read_container(smallest) == {"masks": b"\1\2\3"}

# %% [markdown]
# The magic is chosen to break early. A copy that keeps seven bits of a byte damages its first byte, a copy in text mode its
# line ends. PNG begins in the same way, for the same reason.

# %%
assert container.MAGIC[0] >> 7 == 1
for spoilt in (
    bytes(b & 127 for b in data),
    data.replace(b"\r\n", b"\n"),
    data.replace(b"\n", b"\r\n"),
):
    assert spoilt[:8] != container.MAGIC

# %% [markdown]
# The checksum is the `CRC-32` of zlib: the message as one long polynomial over bits, divided by a fixed one, the remainder kept.
# Bit by bit it is six lines. It finds every single wrong bit and every burst of up to 32 bits.


# %%
def crc32(message):
    c = 0xFFFFFFFF
    for byte in message:
        c ^= byte
        for _ in range(8):
            c = c >> 1 ^ (
                0xEDB88320 if c & 1 else 0
            )  # subtract the divisor where the top term is there
    return c ^ 0xFFFFFFFF


assert crc32(b"\1\2\3") == zlib.crc32(b"\1\2\3") == 0x55BC801D
rng = np.random.default_rng(19)
for _ in range(500):
    burst, at = (1 << 31) + int(rng.integers(2**31)), int(rng.integers(8 * len(data) - 31))
    assert burst.bit_length() == 32  # 32 bits, right and wrong ones at random
    spoilt = int.from_bytes(data, "little") ^ burst << at
    assert zlib.crc32(spoilt.to_bytes(len(data), "little")) != zlib.crc32(data)

# %% [markdown]
# ## In code
# Now the real file. Fourteen bytes of frame, then a row for each section. Every checksum is asked before a byte is believed.

# %%
magic, version, count, total = struct.unpack_from("<8sBBI", data)
assert magic == container.MAGIC and version == 1 and total == len(data)
start, sections = 14 + 9 * count + 4, {}
assert zlib.crc32(data[: start - 4]) == struct.unpack_from("<I", data, start - 4)[0]
for row in range(count):
    number, length, crc = struct.unpack_from("<BII", data, 14 + 9 * row)
    body = data[start : start + length]
    assert zlib.crc32(body) == crc
    sections[container.SECTIONS[number - 1]] = body
    start += length
assert start == total and sections == container.read_container(data)
print(sections["header"].decode())

# %% [markdown]
# **The header** is JSON: widths of the networks, levels of the grid, base steps $Q_0$. With it every other length is known.
# **Positions** are a box, six `float32`, and three `uint16` an anchor: $x_a = lo + n\,(hi - lo)/65535$, 6 bytes an anchor.
# **Networks** are `float16` as they are: no prior is learnt for weights, so each costs all of its bits.

# %%
header = json.loads(sections["header"])
box, n = (
    struct.unpack_from("<6f", sections["positions"]),
    struct.unpack_from("<3H", sections["positions"], 24),
)
x_a = [lo + i * ((hi - lo) / 65535) for lo, hi, i in zip(box[:3], box[3:], n)]
assert len(sections["positions"]) == 24 + 6 * header["anchors"]
weights = {
    name: np.frombuffer(sections[name], "<f2")
    for name in sections
    if name.endswith("mlps") or name.endswith("mlp")
}
assert (len(weights["context_mlps"]) * 2, x_a) == (
    len(sections["context_mlps"]),
    [-1.5, -1.0, 0.25],
)

# %% [markdown]
# **Masks and hash grid** are bits with one common probability: four bytes say $p_+\cdot 2^{24}$, then a message follows, unless
# all bits are equal. Here the mask is one bit that is certain. The grid has 4 signs, $p_+ = \frac{3}{4}$; the message is one
# integer $x$, whose *slot* $x \bmod 2^{24}$ names the sign: below $2^{22}$ it is $-1$. (Why: `20_intervals_to_rans`.)

# %%
f = int.from_bytes(sections["masks"], "little")
assert f == 2**24 and len(sections["masks"]) == 4  # probability one: no message follows
(f,) = struct.unpack_from("<I", sections["hash_grid"])
x, signs = int.from_bytes(sections["hash_grid"][5:13], "little"), []  # byte 4: size of x
for _ in range(4):
    slot = x % 2**24
    begin, wide = (0, 2**24 - f) if slot < 2**24 - f else (2**24 - f, f)
    signs.append(-1 if begin == 0 else 1)
    x = x // 2**24 * wide + slot - begin
assert (
    f / 2**24 == 3 / 4 and 2**24 - f == 2**22 and signs == [1, 1, 1, -1] and x == 2**31
)  # where it began

# %% [markdown]
# **Features, scales, offsets** are whole numbers $\lfloor f/q\rceil$, each with a table of its own, made from the integers that
# stand for $\mu/q$ and $\log_2(\sigma/q)$. For the one feature here they are 2331, in units of $1/1024$, and -56, in units of
# $1/16$: mean 2.28, deviation 0.09 steps. The message is `x = 0x80c0d682`; its slot lies in the symbol 2's block: $f = 2q$.

# %%
q = quantised_of(sections)
mu_units, sigma_units = int(q.context.mu_units[0, 0]), int(q.context.sigma_units[0, 0])
assert (mu_units, sigma_units) == (2331, -56) and (
    round(2331 / 1024, 2),
    round(2 ** (-56 / 16), 2),
) == (2.28, 0.09)
table = gaussian_model(np.array([mu_units]), np.array([sigma_units]))
x = int.from_bytes(sections["features"][1:], "little")
place = int(np.searchsorted(table.keys, x % 2**24, "right")) - 1
assert (
    x == 0x80C0D682
    and table.lowest[0] + place == 2
    and q.model.anchors.f_a[0, 0] == 2 * q.context.q[0, 0]
)
print(
    "the feature's table:",
    dict(zip(range(table.lowest[0], table.lowest[0] + 5), np.diff(table.keys)[:5].tolist())),
)

# %%
owners = np.repeat(np.arange(len(parts)), [n for _, n in parts])
shade = lambda i: (
    *plt.matplotlib.colors.to_rgb(lessons.COLORS[i % 6]),
    0.28 if i < 6 else 0.62 if i < 12 else 0.12,
)
figure, axes = plt.subplots(figsize=(16, 9))
for i, byte in enumerate(data):
    row, column = divmod(i, 32)
    axes.add_patch(plt.Rectangle((column, row), 1, 1, color=shade(owners[i]), lw=0))
    axes.text(
        column + 0.5,
        row + 0.54,
        f"{byte:02x}",
        ha="center",
        va="center",
        family="monospace",
        fontsize=9.5,
    )
at = 0
for i, (name, size) in enumerate(parts):
    axes.add_patch(plt.Rectangle((33.2, 2.2 * i + 1), 1.4, 1.4, color=shade(i), lw=0))
    axes.text(35, 2.2 * i + 1.75, f"{at:3d}  {name}, {size} bytes", va="center", fontsize=13)
    at += size
axes.set(
    frame_on=False,
    xlim=(0, 46),
    ylim=(31, 0),
    xticks=np.arange(0, 32, 8) + 0.5,
    xticklabels=range(0, 32, 8),
    yticks=np.arange(31) + 0.5,
    yticklabels=range(0, 31 * 32, 32),
    ylabel="address (bytes)",
    title="A whole model in 980 bytes: what entropy coding acts on is the thin stripe in the middle",
)
axes.grid(False)
assert (
    len(data) == 980
    and sum(size for name, size in parts if name.endswith("mlp") or name.endswith("mlps"))
    > 980 / 2 - 3
)
lessons.show(figure, "19_file_byte_by_byte")

# %% [markdown]
# ## Backward by hand
# A file has no backward. Move one feature: its symbol changes at ties only, so the bytes are constant almost everywhere and
# their gradient is 0 or does not exist. What training follows is the smooth estimate of Eq. (11), below beside the truth.
# Here a trained model of 60 anchors: all features of one anchor moved together, step by step, the file written anew each time.
# Far out the stairs stay below: a table gives a rare symbol one count of $2^{24}$, so 24 bits, where Eq. (11) asks for more.

# %%
golden = (oracle.path() / "model.p4dgs").read_bytes()
g = quantised_of(container.open_container(golden))
prior, d = inspect.float_context(g.model), g.model.design.d
step, units = g.context.q[7, 0], (g.context.mu_units[7, :d], g.context.sigma_units[7, :d])
steps_up = np.linspace(-6, 12, 73) + 0.003  # never on a tie
moved = g.model.anchors.f_a[7] + steps_up[:, None] * step  # (73, d)
lengths, integer = [], []
for values in moved:
    f_a = g.model.anchors.f_a.copy()
    f_a[7] = values
    lengths.append(len(p4.encode(replace(g.model, anchors=g.model.anchors._replace(f_a=f_a)))))
    integer.append(ideal_bits_gaussian(np.rint(values / step).astype(int), *units).sum())
estimate, res = likelihood.forward(
    moved, *(np.tile(a[7, :d], (73, 1)) for a in (prior.mu, prior.sigma)), np.full((73, d), step)
)
slope = likelihood.backward(res, np.ones((73, d)))["f_noisy"].sum(axis=1)
assert len(g.positions) == 60 and 1 < len(set(lengths)) < len(set(integer)) < len(
    moved
) == np.count_nonzero(slope)
assert integer[-1] < 24 * d < estimate.bits[-1].sum() and set(np.diff(lengths)) <= {
    -4,
    0,
    4,
}  # words of 32 bits
figure, axes = plt.subplots(figsize=(9, 5))
axes.plot(steps_up, estimate.bits.sum(axis=1), label="estimate, Eq. (11)")
axes.step(steps_up, integer, where="mid", label="ideal bits under whole-number tables")
axes.step(
    steps_up,
    8 * (np.array(lengths) - len(golden)),
    where="mid",
    ls="--",
    label="the file against its length at 0",
)
axes.set(
    xlabel="how far the features of anchor 7 are moved (in steps q)",
    ylabel="bits",
    title="The estimate has a slope, the file has stairs",
)
axes.legend(fontsize=11)
lessons.show(figure, "19_what_no_gradient_sees")

# %% [markdown]
# ## Break it
# Flip one bit of the file, any: it is refused, all 7840 times. Now the plausible mistake: a reader that skips the checksums.
# Half of this file is weights, and a damaged weight is still a weight: the file opens, and nobody is told.


# %%
def flipped(message, bit):
    return message[: bit // 8] + bytes([message[bit // 8] ^ 1 << bit % 8]) + message[bit // 8 + 1 :]


def refused(read, *arguments):
    try:
        read(*arguments)
    except p4.BitstreamError:
        return True
    return False


assert (
    sum(refused(container.read_container, flipped(data, bit)) for bit in range(8 * len(data)))
    == 7840
)
taken, tried = 0, 0
for name, body in sections.items():
    for bit in range(3, 8 * len(body), 89):
        forged = container.write_container(
            {**sections, name: flipped(body, bit)}
        )  # with checksums that fit
        taken, tried = taken + (not refused(p4.decode, forged)), tried + 1
print(f"without checksums {taken} of {tried} flipped bits go unnoticed")
assert taken > tried / 2

# %% [markdown]
# ## What a codec does with it
# A video stream is built alike: a start code, units with a type and a length, parameter sets first, then coded symbols.
# In the trained model the four sections that prediction and context act on are 748 of 9730 bytes; networks are most of the rest.
# The paper's scenes have more anchors: there the attributes weigh more, and the frame hardly anything.

# %%
sizes = dict(container.layout(golden))
attributes = sum(sizes[name] for name in ("features", "scales", "offset_scales", "offsets"))
assert (
    attributes == 748
    and len(golden) == 9730
    and sum(sizes[n] for n in sizes if "mlp" in n) > 0.8 * len(golden)
)
for row in inspect.ledger(golden):
    print(f"{row['name']:16s} {row['bytes']:5d} bytes, estimate {row['estimate_bytes']:8.1f}")

# %% [markdown]
# ## Exercises
# **19.1** How many bytes are the positions of $400$ anchors? **19.2** Where is anchor $17$ of `golden`? Use `struct`.
# **19.3** Write `my_container(data)`: `{name: bytes}`, or `ValueError`. It is tried on all golden streams, sound and forged:
# 23 to be taken apart and, of the damaged ones, 13 whose frame is bad.

# %%
answer_1 = ...
answer_2 = ...


def my_container(data):
    """{name of container.SECTIONS: bytes}; ValueError: magic, version, lengths, checksums, ids unknown or not rising."""
    raise NotImplementedError


def grade_container(mine):
    """How many sound streams come out right, and how many bad frames are refused."""
    rows, right = streams.read_rows(), [0, 0]
    for row in rows["good"]:
        whole = (published.FOLDER / row["file"]).read_bytes()
        right[0] += mine(whole) == container.read_container(whole)
    for row in rows["bad"]:
        bad = (published.FOLDER / row["file"]).read_bytes()
        if refused(container.read_container, bad):
            try:
                mine(bad)
            except ValueError:
                right[1] += 1
    return right


try:
    answer_3 = grade_container(my_container)
except NotImplementedError:
    answer_3 = ...
lessons.number("19.1", answer_1, 24 + 6 * 400)
lessons.number("19.2", answer_2, lessons.golden("frames/front_000")["in.x_a"][17], digits=15)
lessons.number("19.3", answer_3, grade_container(container.read_container))
assert grade_container(container.read_container) == [23, 13]

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only codec` reads what a port decoded from the streams; or from Python, an object that decodes.
# What a port gets wrong here: native instead of little-endian numbers, lengths believed before they are checked, a section
# missed that may be absent, positions divided by `65536` instead of `65535`.


# %%
class Port:
    """A port as the oracle asks one: arrays of a good stream, or why a bad one is refused."""

    def decode(self, name, stream):
        try:
            return streams.decoded(stream), None
        except p4.BitstreamError as error:
            return None, str(error)

    def strangers(self):
        return []


report = oracle.check_port(Port(), only="codec")
print(report)
assert report.ok
