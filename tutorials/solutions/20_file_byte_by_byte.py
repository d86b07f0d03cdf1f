# %% [markdown]
# # Solutions to the file, byte by byte

# %%
import struct
import zlib

import numpy as np

from p4dgs_ref import lessons, oracle
from p4dgs_ref.codec import container
from p4dgs_ref.oracle import streams

# %% [markdown]
# **20.1** The section holds a box of six `float32`, then three `uint16` for each anchor.

# %%
lessons.check_number("20.1", 6 * 4 + 400 * 3 * 2, 24 + 6 * 400)


# %% [markdown]
# **20.3** comes first because it opens the file. The order of the checks matters: nothing may be
# read before it is known to exist. Section ids must rise, so that no section occurs twice. Bytes
# that are missing or left over at the end are an error too.


# %%
def my_container(data):
    if len(data) < 18 or data[:8] != b"\x89P4D\r\n\x1a\n" or data[8] != 1:
        raise ValueError("the magic number or the version is wrong")
    count, total = struct.unpack_from("<BI", data, 9)
    end = 14 + 9 * count
    if total != len(data) or end + 4 > total:
        raise ValueError("the length is wrong")
    if zlib.crc32(data[:end]) != int.from_bytes(data[end : end + 4], "little"):
        raise ValueError("the table is damaged")
    sections = {}
    start = end + 4
    last = 0
    for row in range(14, end, 9):
        number, length, crc = struct.unpack_from("<BII", data, row)
        body = data[start : start + length]
        if not last < number <= 11:
            raise ValueError(f"section {number} is unknown or out of order")
        if len(body) != length or zlib.crc32(body) != crc:
            raise ValueError(f"section {number} is damaged")
        sections[container.SECTIONS[number - 1]] = body
        start += length
        last = number
    if start != total:
        raise ValueError("there are bytes after the last section")
    return sections


def refuses(read, data):
    try:
        read(data)
    except ValueError:
        return True
    return False


def stored(kind):
    return [(streams.STREAMS / row["file"]).read_bytes() for row in streams.read_rows()[kind]]


good = stored("good")
bad_frames = [bad for bad in stored("bad") if refuses(container.read_container, bad)]
read = sum(my_container(whole) == container.read_container(whole) for whole in good)
refusals = sum(refuses(my_container, bad) for bad in bad_frames)
lessons.check_number("20.3", [read, refusals], [len(good), len(bad_frames)])

# %% [markdown]
# **20.2** The box is stored in `float32`, but the arithmetic is done in doubles: divide the
# extent by $65535$, multiply, add.

# %%
body = my_container((oracle.path() / "model.p4dgs").read_bytes())["positions"]
box = np.array(struct.unpack_from("<6f", body))
n = np.array(struct.unpack_from("<3H", body, 24 + 6 * 17))
lo, hi = box[:3], box[3:]
anchor_17 = lessons.golden("frames/front_000")["in.x_a"][17]
lessons.check_number("20.2", lo + n * ((hi - lo) / 65535), anchor_17, digits=15)

# %% [markdown]
# **Predict, then run.** No. A checksum that is itself damaged no longer agrees with its bytes, and
# a CRC-32 notices every single flipped bit.

# %%
whole = (oracle.path() / "model.p4dgs").read_bytes()
for place in np.random.default_rng(19).integers(0, 8 * len(whole), 100):
    damaged = bytearray(whole)
    damaged[place // 8] ^= 1 << place % 8
    assert refuses(my_container, bytes(damaged))
