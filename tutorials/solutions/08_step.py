# %% [markdown]
# # Solutions to Eq. (8)

# %%
import numpy as np
from scipy.special import expit as sigmoid

from p4dgs_ref import lessons
from p4dgs_ref.equations import mlp, step

# %% [markdown]
# **08.1** From $1 + \tanh\psi_q = \frac{1}{2}$ follows $\tanh\psi_q = -\frac{1}{2}$. In the sigmoid
# form, $e^{-2\psi_q} = 3$, so $\psi_q = -\frac{1}{2}\ln 3$.

# %%
lessons.check_number("08.1", -0.5 * np.log(3), np.arctanh(-0.5))


# %% [markdown]
# **08.2** A shared output receives the sum over its uses:
# $$\bar\psi_q = 4g(1-g)\sum_i Q_{0,i}\,\bar q_i, \qquad g = \mathrm{sigmoid}(2\psi_q) = 0.25,
# \qquad 4g(1-g) = 0.75.$$
# Each group $i$ contributes with the weight of its $Q_0$, and no group can become finer without the
# others. On the floor no group moves $\psi_q$, so $\bar\psi_q = 0$.

# %%
Q_0 = np.array([0.25, 0.01, 0.01, 0.1])
q_bar = np.array([[1.0, -10, 20, 4]])


def shared(psi):
    return step.forward(np.full((1, 1), psi), [np.ones((1, 4))], [np.zeros(4)], Q_0)


rng = np.random.default_rng(8)
answer_2 = []
for psi in (-0.5 * np.log(3), -5.0):
    _, saved = shared(psi)
    psi_bar = step.backward(saved, q_bar)["h"].sum()
    _ = lessons.adjoint(rng, shared, {"psi": psi}, q_bar, {"psi": psi_bar})
    answer_2.append(psi_bar)
lessons.check_number("08.2", answer_2, [0.75 * (Q_0 @ q_bar[0]), 0])


# %% [markdown]
# **08.3** First the slope of the formula, with $1 - g$ written as the sigmoid of $-2\psi_q$, then
# the backward of the network.


# %%
def my_backward(inputs, cotangents):
    psi_q, saved = mlp.forward(inputs["h"], inputs["weights"], inputs["biases"])
    g = sigmoid(2 * psi_q)
    slope = 4 * inputs["Q_0"] * g * sigmoid(-2 * psi_q)
    slope = np.where(2 * g > step.SMALLEST, slope, 0)
    gradients = mlp.backward(saved, cotangents["q_bar"] * slope)
    return {"h": gradients["x"], "weights": gradients["weights"], "biases": gradients["biases"]}


lessons.check_backward("08.3", my_backward, "step")

# %% [markdown]
# **Predict, then run.** Just above $-1$, numbers in float16 are $2^{-11} = 0.00049$ apart. At $-4$
# the result is one such step, 27 % too small; at $-5$ it is 0. The sigmoid has no such step.

# %%
psi_q = np.array([-4, -5], np.float16)
assert (1 + np.tanh(psi_q)).tolist() == [2**-11, 0]
assert np.allclose(2 * sigmoid(2 * psi_q), 1 + np.tanh(psi_q.astype(float)), rtol=2e-3)
