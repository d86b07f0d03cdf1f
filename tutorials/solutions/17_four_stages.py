# %% [markdown]
# # Solutions to the four stages of training

# %%
import numpy as np

from p4dgs_ref import PRESETS
from p4dgs_ref.equations import likelihood
from p4dgs_ref.school import lessons
from p4dgs_ref.training.trainer import LEARNING_RATES

# %% [markdown]
# **17.1** Real scenes end their stages after 3000, 4000, 10000 and 20000 iterations; stage 3 lasts 6000 of 20000: 30 percent.

# %%
ends = PRESETS["paper_real"].stage_ends
assert ends == (3000, 4000, 10000, 20000) and ends[2] - ends[1] == 6000
lessons.number("17.1", 30, 100 * (ends[2] - ends[1]) / ends[3])

# %% [markdown]
# **17.2** Anchors and their four networks learn from the start, $\psi_d$ from stage 3, everything of the context from stage 4.
# Noise is no parameter: stage 2 moves what stage 1 moved. In the paper's presets x_a never moves.

# %%
first = {"psi_d": 3, "psi_p": 4, "psi_q": 4, "grid": 4}
want = [1, 1, 1, 1, 1, 1, 1, 1, 1, 3, 4, 4, 4]
assert len(want) == len(LEARNING_RATES) and PRESETS["paper_real"].lr_x == (0, 0)
lessons.number("17.2", [first.get(stem, 1) for stem in LEARNING_RATES], want)

# %% [markdown]
# **17.3** `L_rate` is `bits` over the count of all numbers, masked ones too, so both cotangents meet in one factor. Offsets of a
# masked child cost nothing and receive nothing. Each of the four steps serves a group: its gradients add up over the columns.


# %%
def my_backward(inputs, cotangents):
    d, k, noisy, mask = (inputs[name] for name in ("d", "k", "noisy", "mask"))
    widths = (d, 3, 3, 3 * k)
    res = likelihood.forward(
        noisy, inputs["mu"], inputs["sigma"], np.repeat(inputs["q"], widths, axis=1)
    )[1]
    factor = cotangents["bits_bar"] + cotangents["L_rate_bar"] / noisy.size
    coded = np.concatenate([np.ones((len(mask), d + 6), bool), np.repeat(mask, 3, axis=1)], axis=1)
    bars = likelihood.backward(res, np.where(coded, factor, 0).astype(noisy.dtype))
    return {
        "noisy": bars["f_noisy"],
        "q": np.add.reduceat(bars["q"], np.cumsum((0, *widths[:3])), axis=1),
    }


lessons.backward("17.3", my_backward, "rate_stage", "noisy", "q")
