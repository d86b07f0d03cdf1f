# %% [markdown]
# # Solutions to one training step

# %%
import numpy as np

from p4dgs_ref.equations import deformation, deformed, render_loss
from p4dgs_ref.school import lessons
from p4dgs_ref.training.adam import Adam
from p4dgs_ref.training.parameters import Parameters

# %% [markdown]
# **18.1** $(1 - \lambda_{SSIM})/(3HW)$ is $0.8 / 12288$, whatever the error: L1 pulls at a nearly right
# pixel as hard as at a wrong one.

# %%
image, truth = np.random.default_rng(18).random((2, 64, 64, 3))
_, res = render_loss.forward(image, truth, 0.2)
lessons.number("18.1", 0.8 / 12288, np.abs(render_loss.backward(res, L1_bar=0.8)["image"]).max())

# %% [markdown]
# **18.2** At the first step $m/\sqrt v$, corrected, is $g/|g|$: Adam knows only the sign yet. The parameter moves by
# the rate, +0.015.

# %%
first = Parameters({"w": np.zeros(1)}, np.float64)
fresh, pull = Adam(first), first.zeros()
pull["w"][0] = -3e-5
fresh.step(first, pull, lambda name: 0.015)
assert np.isclose(first["w"][0], 0.015)
lessons.number("18.2", 0.015, first["w"][0])

# %% [markdown]
# **18.3** With no way through $\mathcal{E}(x)$, the network needs no backward at all for x, s and r: only Eq. (6) counts, and
# there x and s pass as they are. What remains is the normalisation, and a quaternion that passes where nothing turns.


# %%
def my_backward(inputs, cotangents):
    delta, _ = deformation.forward(
        inputs["x"],
        inputs["t"],
        inputs["psi_d_weights"],
        inputs["psi_d_biases"],
        inputs["L_x"],
        inputs["L_t"],
    )
    _, res = deformed.forward(inputs["x"], inputs["s"], inputs["r"], *delta)
    return deformed.backward(res, **cotangents)


lessons.backward("18.3", my_backward, "temporal_prediction", "x", "s", "r")
