# %% [markdown]
# # Solutions to Eq. (6)

# %%
import numpy as np

from p4dgs_ref.equations import deformed, rotation
from p4dgs_ref.school import lessons

# %% [markdown]
# **06.1** The sum $(1, 0, 0, 1)$ over $\sqrt 2$: half the angle has the cosine $1/\sqrt 2$, so the angle is a quarter turn.

# %%
still = np.zeros((1, 3))
quarter = deformed.forward(
    still, still, np.array([[1.0, 0, 0, 0]]), still, still, np.array([[0.0, 0, 0, 1]])
)[0].r_t[0]
lessons.number("06.1", 90, np.degrees(2 * np.arccos(quarter[0])))


# %% [markdown]
# **06.2** Add where there is something to add, then normalise the turn. **06.3** A sum gives its gradient to both; the turn's
# goes through the normalisation first. A delta of width zero gets a gradient of width zero.


# %%
def my_deformed(x, s, r, delta_x, delta_s, delta_r):
    x_t, s_t = (a + delta if delta.size else a for a, delta in ((x, delta_x), (s, delta_s)))
    return x_t, s_t, rotation.normalise(r + delta_r)[0] if delta_r.size else r


def my_backward(inputs, cotangents):
    x_bar, s_bar, r_bar = (cotangents[name] for name in ("x_t_bar", "s_t_bar", "r_t_bar"))
    if inputs["delta_r"].size:
        r_bar = rotation.normalise_backward(
            *rotation.normalise(inputs["r"] + inputs["delta_r"]), r_bar
        )
    gradients = {"x": x_bar, "s": s_bar, "r": r_bar}
    return gradients | {
        "delta_" + n: bar[:, : inputs["delta_" + n].shape[1]] for n, bar in gradients.items()
    }


lessons.forward("06.2", my_deformed, "deformed")
lessons.backward("06.3", my_backward, "deformed")
