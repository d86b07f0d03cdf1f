# %% [markdown]
# # Solutions to Eq. (8)

# %%
import numpy as np
from scipy.special import expit as sigmoid

from p4dgs_ref import lessons
from p4dgs_ref.equations import mlp, step

# %% [markdown]
# **08.1** From $1 + \tanh u = \frac{1}{2}$ follows $\tanh u = -\frac{1}{2}$. In the sigmoid form,
# $e^{-2u} = 3$, so $u = -\frac{1}{2}\ln 3$.

# %%
lessons.check_number("08.1", -0.5 * np.log(3), np.arctanh(-0.5))


# %% [markdown]
# **08.2** The floor is a maximum that is taken before multiplying by $Q_0$.


# %%
def my_forward(h, weights, biases, Q_0):
    u, _ = mlp.forward(h, weights, biases)
    return Q_0 * np.maximum(2 * sigmoid(2 * u), step.SMALLEST)


lessons.check_forward("08.2", my_forward, "step")


# %% [markdown]
# **08.3** First the slope of the formula, with $1 - s$ written as the sigmoid of $-2u$, then the
# backward of the network.


# %%
def my_backward(inputs, cotangents):
    u, saved = mlp.forward(inputs["h"], inputs["weights"], inputs["biases"])
    s = sigmoid(2 * u)
    slope = 4 * inputs["Q_0"] * s * sigmoid(-2 * u)
    slope = np.where(2 * s > step.SMALLEST, slope, 0)
    gradients = mlp.backward(saved, cotangents["q_bar"] * slope)
    return {"h": gradients["x"], "weights": gradients["weights"], "biases": gradients["biases"]}


lessons.check_backward("08.3", my_backward, "step")

# %% [markdown]
# **Predict, then run.** Just above $-1$, numbers in float16 are $2^{-11} = 0.00049$ apart. At $-4$
# the result is one such step, 27 % too small; at $-5$ it is 0. The sigmoid has no such step.

# %%
u = np.array([-4, -5], np.float16)
assert (1 + np.tanh(u)).tolist() == [2**-11, 0]
assert np.allclose(2 * sigmoid(2 * u), 1 + np.tanh(u.astype(float)), rtol=2e-3)
