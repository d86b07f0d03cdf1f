# %% [markdown]
# # Solutions to one training step

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import deformation, deformed, render_loss
from p4dgs_ref.training.parameters import Adam, Parameters

# %% [markdown]
# **19.1** The magnitude is $(1 - \lambda_{SSIM})/(3HW) = 0.8 / 12288$ whatever the error is,
# because L1 pulls at a nearly correct pixel as hard as at a wrong one.

# %%
image, truth = np.random.default_rng(18).random((2, 64, 64, 3))
_, saved = render_loss.forward(image, truth, 0.2)
image_bar = render_loss.backward(saved, 0.0, L1_bar=0.8)["image"]
lessons.check_number("19.1", 0.8 / 12288, np.abs(image_bar).max())

# %% [markdown]
# **19.2** At the first step, the corrected quotient $m/\sqrt v$ is $g/|g|$, so Adam uses only the
# sign of the gradient. The parameter moves by the learning rate, +0.015.

# %%
parameter = Parameters({"w": np.zeros(1)}, np.float64)
gradient = parameter.zeros()
gradient["w"][0] = -3e-5
Adam(parameter).step(parameter, gradient, lambda name: 0.015)
lessons.check_number("19.2", 0.015, parameter["w"][0])

# %% [markdown]
# **19.3** Because no gradient flows through $\mathcal{E}(x)$, the network needs no backward pass
# for x, s and r. Only Eq. (6) matters: the gradients of x and s pass unchanged, and the gradient
# of r goes through the normalisation. If the scene has no rotation, the quaternion's gradient
# passes unchanged too.


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
    _, saved = deformed.forward(inputs["x"], inputs["s"], inputs["r"], *delta)
    return deformed.backward(saved, **cotangents)


lessons.check_backward("19.3", my_backward, "temporal_prediction", "x", "s", "r")

# %% [markdown]
# **Predict, then run.** They do not: Adam divides the mean of the gradients by the root of the
# mean of their squares, and the factor cancels. Only $\epsilon = 10^{-15}$ is now smaller in
# comparison. A weight of one term relative to another, such as $\lambda_{rate}$, does change the
# steps.

# %%
ends = []
for factor in (1, 1000):
    parameter = Parameters({"w": np.zeros(1)}, np.float64)
    adam = Adam(parameter)
    for slope in (-3e-5, 2e-5, -7e-5):
        gradient = parameter.zeros()
        gradient["w"][0] = factor * slope
        adam.step(parameter, gradient, lambda name: 0.015)
    ends.append(parameter["w"][0])
assert np.isclose(ends[0], ends[1], rtol=1e-6)
