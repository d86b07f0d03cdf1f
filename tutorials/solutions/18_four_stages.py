# %% [markdown]
# # Solutions to the four stages of training

# %%
from dataclasses import replace

import numpy as np

from p4dgs_ref import PRESETS, lessons
from p4dgs_ref.equations import hash_grid, likelihood
from p4dgs_ref.model import context
from p4dgs_ref.oracle import published
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.trainer import LEARNING_RATES

# %% [markdown]
# **18.1** For real scenes the stages end after 3000, 4000, 10000 and 20000 iterations. Stage 3
# therefore lasts 6000 of 20000 iterations, which is 30 percent.

# %%
ends = PRESETS["paper_real"].stage_ends
assert ends == (3000, 4000, 10000, 20000)
lessons.check_number("18.1", 30, 100 * (ends[2] - ends[1]) / ends[3])

# %% [markdown]
# **18.2** The anchors and their four networks are trained from the start, $\psi_d$ from stage 3
# on, and everything that belongs to the context from stage 4 on. The noise is not a parameter, so
# stage 2 moves the same arrays as stage 1. In the paper's presets x_a never moves.

# %%
late = {
    "psi_d": 3,
    "psi_p": 4,
    "psi_q": 4,
    "grid": 4,
}
first = [late.get(stem, 1) for stem in LEARNING_RATES]
assert PRESETS["paper_real"].lr_x == (0, 0)
lessons.check_number("18.2", first, 9 * [1] + [3, 4, 4, 4])

# %% [markdown]
# **18.3** `L_rate` is `bits` divided by a constant, so the two cotangents can be combined into
# one factor. The offsets of a masked child cost nothing and receive no gradient. Each of the four
# steps serves a whole group of columns, so its gradients are added up over these columns.


# %%
def my_backward(inputs, cotangents):
    noisy = inputs["noisy"]
    mask = inputs["mask"]
    widths = (inputs["d"], 3, 3, 3 * inputs["k"])
    columns = np.repeat(inputs["q"], widths, axis=1)
    _, saved = likelihood.forward(noisy, inputs["mu"], inputs["sigma"], columns)

    factor = cotangents["bits_bar"] + cotangents["L_rate_bar"] / noisy.size
    always = np.ones((len(mask), inputs["d"] + 6), bool)
    offsets = np.repeat(mask, 3, axis=1)
    coded = np.concatenate([always, offsets], axis=1)
    bits_bar = np.where(coded, factor, 0).astype(noisy.dtype)

    bars = likelihood.backward(saved, bits_bar)
    starts = np.cumsum((0, *widths[:3]))
    return {
        "noisy": bars["f_noisy"],
        "q": np.add.reduceat(bars["q"], starts, axis=1),
    }


lessons.check_backward("18.3", my_backward, "rate_stage", "noisy", "q")

# %% [markdown]
# **Predict, then run.** The picture sees the steps through the noise $u\,q$, so $\psi_q$ gets a
# gradient, and through it the grid. Means and deviations occur in the rate only: $\psi_p$ gets
# none.

# %%
given = published.cases("context_stage")[0].inputs()
design = design_of(PRESETS["tiny"], MODEL_EFFECTS)
design = replace(design, d=given["d"], k=given["k"], Q_0=tuple(given["Q_0"]))
tables = [len(grid) for grid in given["grids"]]
located = hash_grid.locate(
    given["x_a"],
    given["lo"],
    given["hi"],
    given["resolutions"],
    tables,
)
networks = {
    name: (given[f"{name}_weights"], given[f"{name}_biases"]) for name in ("psi_q", "psi_p")
}
ctx, back = context(design, networks, given["grids"], located)
none = np.zeros_like(ctx.mu)
of_grids, of_networks = back(np.ones_like(ctx.q), none, none)
assert any(grid.any() for grid in of_grids)
assert any(W.any() for W in of_networks["psi_q"]["weights"])
assert not any(W.any() for W in of_networks["psi_p"]["weights"])
