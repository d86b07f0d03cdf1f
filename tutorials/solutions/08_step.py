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
# **08.2** What is shared receives the sum over its uses: $\bar u = 4s(1-s)\sum_g Q_{0,g}\,\bar q_g$
# with $s = \sigma(2u)$, here $0.75\cdot 0.75 = 0.5625$. Each group votes with the weight of its
# $Q_0$, and a group alone cannot become finer. On the floor no group moves $u$, so $\bar u = 0$.

# %%
Q_0 = np.array([0.25, 0.01, 0.01, 0.1])
q_bar = np.array([[1.0, -10, 20, 4]])


def shared(u):
    return step.forward(np.full((1, 1), u), [np.ones((1, 4))], [np.zeros(4)], Q_0)


rng = np.random.default_rng(8)
answer_2 = []
for u in (-0.5 * np.log(3), -5.0):
    _, saved = shared(u)
    u_bar = step.backward(saved, q_bar)["h"].sum()
    _ = lessons.adjoint(rng, shared, {"u": u}, q_bar, {"u": u_bar})
    answer_2.append(u_bar)
lessons.check_number("08.2", answer_2, [0.75 * (Q_0 @ q_bar[0]), 0])


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
