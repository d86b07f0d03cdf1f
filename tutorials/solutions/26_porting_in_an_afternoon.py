# %% [markdown]
# # Solutions to porting

# %%
from p4dgs_ref import lessons

# %% [markdown]
# **26.1** Ties are rounded up, which is wrong wherever the integer below the tie is even:
# $-1.5$, $0.5$ and $2.5$.

# %%
lessons.check_number("26.1", 3, sum(round(v + 0.5) != (v + 1) // 1 for v in range(-3, 3)))

# %% [markdown]
# **26.2** $2^{53}/2654435761 = 3393263.2$. The prime is odd, so the product with 3393264 is even
# and still exact, and that with 3393265 is odd.

# %%
inexact = (j for j in range(3_393_000, 3_394_000) if int(2654435761.0 * j) != 2654435761 * j)
lessons.check_number("26.2", 2**53 // 2654435761 + 2, next(inexact))

# %% [markdown]
# **Predict, then run.** None. Coordinates are below $2^{16}$, so every product is below $2^{53}$
# and exact. The oracle's case has larger coordinates, because a port may be used for more than
# today's files.

# %%
assert (2**16 - 1) * 2654435761 < 2**53
