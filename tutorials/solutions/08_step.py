# %% [markdown]
# # Solutions to Eq. (8)

# %%
import numpy as np
from scipy.special import expit

from p4dgs_ref.equations import mlp, step
from p4dgs_ref.school import lessons

# %% [markdown]
# **08.1** $1 + \tanh u = \frac{1}{2}$, so $\tanh u = -\frac{1}{2}$. By the sigmoid: $e^{-2u} = 3$, $u = -\frac{1}{2}\ln 3$.

# %%
lessons.number("08.1", -0.5 * np.log(3), np.arctanh(-0.5))


# %% [markdown]
# **08.2** The floor is a maximum over the share, so that $Q_0$ multiplies once.


# %%
def my_forward(h, weights, biases, Q_0):
    u = mlp.forward(h, weights, biases)[0].y
    return 2 * Q_0 * np.maximum(expit(2 * u), step.FLOOR / 2)


lessons.forward("08.2", my_forward, "step")


# %% [markdown]
# **08.3** The slope of the head, with $1 - s$ written as the sigmoid of $-2u$; then the network's backward.


# %%
def my_backward(inputs, cotangents):
    y, res = mlp.forward(inputs["h"], inputs["weights"], inputs["biases"])
    s = expit(2 * y.y)
    slope = np.where(s > step.FLOOR / 2, 4 * inputs["Q_0"] * s * expit(-2 * y.y), 0)
    bars = mlp.backward(res, cotangents["q_bar"] * slope)
    return {"h": bars["x"], "weights": bars["weights"], "biases": bars["biases"]}


lessons.backward("08.3", my_backward, "step")
