# %% [markdown]
# # Solutions to entropy coding, from intervals to rANS

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.codec import container, streams
from p4dgs_ref.codec.file import quantised_of

lessons.find_tools()
from tutorials.tools import tour

sections = container.read_container(tour.DATA)
model = quantised_of(sections).model

# %% [markdown]
# **21.1** The symbols $b$ and $c$ have the probability $\frac14$ and cost two bits each; $a$ has
# $\frac12$ and costs one bit. The final interval is $\frac1{128}$ wide.

# %%
lessons.check_number("21.1", 2 + 2 + 2 + 1, 7)


# %% [markdown]
# **21.2** Push from the last entry to the first. The test before a push determines whether $x$
# would reach $2^{63}$: $\lfloor x/f\rfloor 2^{24} < 2^{63}$ holds exactly if $x < f\,2^{39}$.


# %%
def my_encode(entries, keys):
    x = 2**31
    stack = []
    for entry in reversed(entries.tolist()):
        start = int(keys[entry])
        freq = int(keys[entry + 1]) - start
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


mask = model.anchors.mask.ravel()
p_one = streams.probability_of_one(mask.sum(), mask.size)
mask_keys = np.array([0, 2**24 - p_one, 2**24])
mine = np.frombuffer(my_encode(mask.astype(int), mask_keys), np.uint8)
lessons.check_number("21.2", mine, np.frombuffer(sections["masks"][4:], np.uint8))


# %% [markdown]
# **21.3** The same steps in reverse. The message stores the words of the stack in the order in
# which the decoder needs them, so it reads them one after another.


# %%
def my_decode(message, count, keys):
    words = np.frombuffer(message, "<u4", offset=1).tolist()
    x = words.pop(0)
    if message[0] & 0x80:
        x |= words.pop(0) << 32
    entries = []
    for _ in range(count):
        slot = x % 2**24
        entry = int(np.searchsorted(keys, slot, "right")) - 1
        start = int(keys[entry])
        freq = int(keys[entry + 1]) - start
        x = x // 2**24 * freq + slot - start
        if x < 2**31:
            x = x << 32 | words.pop(0)
        entries.append(entry)
    assert x == 2**31 and not words
    return np.array(entries)


grid = sections["hash_grid"]
p_plus = int.from_bytes(grid[:4], "little")
sign_keys = np.array([0, 2**24 - p_plus, 2**24])
signs = np.concatenate([level.ravel() for level in model.grids]) > 0
lessons.check_number("21.3", my_decode(grid[4:], len(signs), sign_keys), signs)

# %% [markdown]
# **Predict, then run.** The wrong table gives both signs the probability one half, so each of them
# costs one bit. With the right table, a sign costs the entropy, $0.081$ bits. The message is
# decoded correctly with either table, if the decoder has the same one.

# %%
entries = (np.random.default_rng(20).random(10_000) < 0.01).astype(int)
sizes = []
for p_one in (2**23, int(entries.mean() * 2**24)):
    table = np.array([0, 2**24 - p_one, 2**24])
    message = my_encode(entries, table)
    assert np.array_equal(my_decode(message, len(entries), table), entries)
    sizes.append(8 * len(message) / len(entries))
p = entries.mean()
entropy = -p * np.log2(p) - (1 - p) * np.log2(1 - p)
assert np.allclose(sizes, [1, entropy], atol=0.01)
