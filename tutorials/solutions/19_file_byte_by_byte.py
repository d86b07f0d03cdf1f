# %% [markdown]
# # Solutions to the file, byte by byte

# %%
import struct
import zlib

import numpy as np

from p4dgs_ref import oracle
from p4dgs_ref.codec import container, published
from p4dgs_ref.oracle import streams
from p4dgs_ref.school import lessons

# %% [markdown]
# **19.1** A box of six `float32`, then three `uint16` an anchor.

# %%
lessons.number("19.1", 6 * 4 + 400 * 3 * 2, 24 + 6 * 400)


# %% [markdown]
# **19.3** first, for it opens the file. The order of the checks matters: nothing is read before it is known to be there, and
# ids must rise, so that no section comes twice. What is left over, or missing, at the end is an error too.


# %%
def my_container(data):
    if len(data) < 18 or data[:8] != b"\x89P4D\r\n\x1a\n" or data[8] != 1:
        raise ValueError("not such a file")
    count, total = struct.unpack_from("<BI", data, 9)
    end = 14 + 9 * count
    if (
        total != len(data)
        or end + 4 > total
        or zlib.crc32(data[:end]) != int.from_bytes(data[end : end + 4], "little")
    ):
        raise ValueError("frame or table damaged")
    sections, start, last = {}, end + 4, 0
    for row in range(14, end, 9):
        number, length, crc = struct.unpack_from("<BII", data, row)
        body = data[start : start + length]
        if not last < number <= 11 or len(body) != length or zlib.crc32(body) != crc:
            raise ValueError(f"section {number} damaged")
        sections[container.SECTIONS[number - 1]] = body
        start, last = start + length, number
    if start != total:
        raise ValueError("bytes left over")
    return sections


def refuses(read, data):
    try:
        read(data)
    except ValueError:
        return True
    return False


rows = streams.read_rows()
stored = lambda key: [(published.FOLDER / row["file"]).read_bytes() for row in rows[key]]
sound = sum(my_container(whole) == container.read_container(whole) for whole in stored("good"))
framed = [bad for bad in stored("bad") if refuses(container.read_container, bad)]
lessons.number(
    "19.3",
    [sound, sum(refuses(my_container, bad) for bad in framed)],
    [len(rows["good"]), len(framed)],
)

# %% [markdown]
# **19.2** The box is `float32`, but the arithmetic is that of doubles: divide the extent by $65535$, multiply, add.

# %%
body = my_container((oracle.path() / "model.p4dgs").read_bytes())["positions"]
lo, hi = np.frombuffer(body, "<f4", 6).astype(float).reshape(2, 3)
n = np.frombuffer(body, "<u2", 3, 24 + 6 * 17)
lessons.number(
    "19.2",
    lo + n * ((hi - lo) / 65535),
    lessons.golden("frames/front_000")["in.x_a"][17],
    digits=15,
)
