# %% [markdown]
# # Solutions to Eq. (6)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import deformed
from p4dgs_ref.equations.numerics import normalise, normalise_backward

# %% [markdown]
# **06.1** The sum is $(1, 0, 0, 1)$, and dividing by its length gives the real part $1/\sqrt 2$.
# This is the cosine of 45 degrees, which is half the angle. The Gaussian makes a quarter turn.

# %%
still = np.zeros((1, 3))
identity = np.array([[1.0, 0, 0, 0]])
quarter = np.array([[0.0, 0, 0, 1]])
(_, _, turned), _ = deformed.forward(still, still, identity, still, still, quarter)
lessons.check_number("06.1", 90, np.degrees(2 * np.arccos(turned[0, 0])))


# %% [markdown]
# **06.2** Add every correction that has columns, then normalise the rotation if it was corrected.
#
# **06.3** A sum gives its gradient to both terms; that of the rotation goes through the
# normalisation first. A correction of width zero gets a gradient of width zero.


# %%
def my_deformed(x, s, r, delta_x, delta_s, delta_r):
    x_t = x + delta_x if delta_x.size else x
    s_t = s + delta_s if delta_s.size else s
    r_t = normalise(r + delta_r)[0] if delta_r.size else r
    return x_t, s_t, r_t


def my_backward(inputs, cotangents):
    r_bar = cotangents["r_t_bar"]
    if inputs["delta_r"].size:
        unit, norm = normalise(inputs["r"] + inputs["delta_r"])
        r_bar = normalise_backward(unit, norm, r_bar)
    gradients = {"x": cotangents["x_t_bar"], "s": cotangents["s_t_bar"], "r": r_bar}
    for name in ("x", "s", "r"):
        width = inputs["delta_" + name].shape[1]
        gradients["delta_" + name] = gradients[name][:, :width]
    return gradients


lessons.check_forward("06.2", my_deformed, "deformed")
lessons.check_backward("06.3", my_backward, "deformed")

# %% [markdown]
# **Predict, then run.** $r'$ depends on the direction of the sum only and stays. A change of
# $\Delta r$ now matters a hundred times less, so the gradient is divided by 100.

# %%
r, delta_r, r_bar = np.random.default_rng(6).normal(size=(3, 1, 4))
seen = []
for factor in (1, 100):
    arrays = still, still, factor * r, still, still, factor * delta_r
    (_, _, r_t), saved = deformed.forward(*arrays)
    seen.append((r_t, deformed.backward(saved, still, still, r_bar)["delta_r"]))
assert np.allclose(seen[0][0], seen[1][0])
assert np.allclose(seen[0][1], 100 * seen[1][1])
