# %% [markdown]
# # Solutions to entropy coding, from intervals to rANS

# %%
import numpy as np

from p4dgs_ref import oracle
from p4dgs_ref.codec import container, streams
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.school import lessons

sections = container.read_container((oracle.path() / "model.p4dgs").read_bytes())
model = quantised_of(sections).model

# %% [markdown]
# **20.1** $b$ and $c$ have probability $\frac14$, two bits each, $a$ has $\frac12$, one bit. Width $\frac1{128}$.

# %%
lessons.number("20.1", 2 + 2 + 2 + 1, 7)


# %% [markdown]
# **20.2** From the last entry to the first. The test before a push asks whether $x$ would reach $2^{63}$:
# $\lfloor x/f\rfloor 2^{24} < 2^{63}$ exactly if $x < f\,2^{39}$.


# %%
def my_encode(entries, keys):
    x, stack = 2**31, []
    for entry in reversed(entries.tolist()):
        start, freq = int(keys[entry]), int(keys[entry + 1] - keys[entry])
        if x >= freq << 39:
            stack.append(x % 2**32)
            x >>= 32
        x = x // freq * 2**24 + x % freq + start
    high = [x >> 32] if x >> 32 else []
    return bytes([128 if high else 0]) + np.array([x % 2**32, *high, *stack[::-1]], "<u4").tobytes()


mask = model.anchors.mask.ravel()
keys = np.array([0, 2**24 - streams.probability_of_one(mask.sum(), mask.size), 2**24])
mine = np.frombuffer(my_encode(mask.astype(int), keys), np.uint8)
lessons.number("20.2", mine, np.frombuffer(sections["masks"][4:], np.uint8))


# %% [markdown]
# **20.3** The same backwards. The words of the stack come in the order in which they are needed, so one walks through them.


# %%
def my_decode(message, count, keys):
    words = np.frombuffer(message, "<u4", offset=1).tolist()
    x, entries = words.pop(0), []
    if message[0] & 128:
        x |= words.pop(0) << 32
    for _ in range(count):
        slot = x % 2**24
        entry = int(np.searchsorted(keys, slot, "right")) - 1
        x = (x >> 24) * int(keys[entry + 1] - keys[entry]) + slot - int(keys[entry])
        if x < 2**31:
            x = x << 32 | words.pop(0)
        entries.append(entry)
    assert x == 2**31 and not words
    return np.array(entries)


grid = sections["hash_grid"]
signs = np.concatenate([level.ravel() for level in model.grids]) > 0
lessons.number(
    "20.3",
    my_decode(
        grid[4:], len(signs), np.array([0, 2**24 - int.from_bytes(grid[:4], "little"), 2**24])
    ),
    signs,
)
