# %% [markdown]
# # Solutions: covariance

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations.numerics import normalise
from p4dgs_ref.splatting import covariance

# %% [markdown]
# **13.1** $w = \cos 60°$, so this is a rotation by $120°$ about $(1, 1, 1)$. Its matrix consists of
# zeros and ones, and it turns the x axis into y, y into z and z into x. The variance $1$ of x
# therefore goes to y, $4$ goes to z, and $9$ goes to x.

# %%
scales = np.array([[1.0, 2, 3]])
by_hand, _ = covariance.forward(scales, np.full((1, 4), 0.5))
lessons.check_number("13.1", np.diag([9, 1, 4]), by_hand[0])


# %% [markdown]
# **13.2** A shared scale receives the sum of the three gradients, and its logarithm $s$ times that:
# $\bar l = s\sum_i\bar s_i$. Here $\Sigma = e^{2l} I$ for every rotation, so
# $\bar l = 2\,e^{2l}\,\mathrm{tr}\,\bar\Sigma = 6$, and no step that keeps $r$ a unit quaternion
# changes anything: a ball learns no rotation.

# %%
Sigma_bar = np.arange(9.0).reshape(1, 3, 3)
r = np.full((1, 4), 0.5)


def ball(log_s, r):
    unit, _ = normalise(r)
    return covariance.forward(np.full((1, 3), np.exp(log_s)), unit)


_, saved = ball(np.log(0.5), r)
bars = covariance.backward(saved, Sigma_bar)
l_bar = 0.5 * bars["s"].sum()
across = bars["r"] - r * (r * bars["r"]).sum()
given = {"log_s": np.log(0.5), "r": r}
rng = np.random.default_rng(13)
_ = lessons.adjoint(rng, ball, given, Sigma_bar, {"log_s": l_bar, "r": across})
answer_2 = [l_bar, *across[0]]
lessons.check_number("13.2", answer_2, [2 * 0.25 * np.trace(Sigma_bar[0]), 0, 0, 0, 0])

# %% [markdown]
# **13.3** The slopes of $R$ are those of the text. Because $R$ is quadratic, a difference over
# steps of one gives them exactly.


# %%
def matrix(r):
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4]."""
    w, x, y, z = r.T
    R = np.zeros((len(r), 3, 3))
    R[:, 0, 0] = 1 - 2 * (y * y + z * z)
    R[:, 0, 1] = 2 * (x * y - w * z)
    R[:, 0, 2] = 2 * (x * z + w * y)
    R[:, 1, 0] = 2 * (x * y + w * z)
    R[:, 1, 1] = 1 - 2 * (x * x + z * z)
    R[:, 1, 2] = 2 * (y * z - w * x)
    R[:, 2, 0] = 2 * (x * z - w * y)
    R[:, 2, 1] = 2 * (y * z + w * x)
    R[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return R


def my_forward(s, r):
    M = matrix(r) * s[:, None, :]
    return M @ M.transpose(0, 2, 1)


def my_backward(inputs, cotangents):
    s, r = inputs["s"], inputs["r"]
    Sigma_bar = cotangents["Sigma_bar"]
    R = matrix(r)
    M = R * s[:, None, :]
    both = Sigma_bar + Sigma_bar.transpose(0, 2, 1)
    M_bar = both @ M
    R_bar = M_bar * s[:, None, :]
    r_bar = np.zeros_like(r)
    for i, letter in enumerate(np.eye(4)):
        slope = (matrix(r + letter) - matrix(r - letter)) / 2
        r_bar[:, i] = (R_bar * slope).sum(axis=(1, 2))
    return {"s": (M_bar * R).sum(axis=1), "r": r_bar}


lessons.check_backward("13.3", my_backward, "covariance")

# %% [markdown]
# **Predict, then run.** Both quaternions are the same rotation, so $\Sigma$ stays. $R$ is
# quadratic in $r$, so its slopes, and with them $\bar r$, change their signs. Two ports may
# therefore differ in all signs of $r$ and draw the same picture.

# %%
r = np.array([[0.1, -0.7, 0.5, 0.5]])
cotangents = {"Sigma_bar": rng.normal(size=(1, 3, 3))}
assert np.array_equal(my_forward(scales, r), my_forward(scales, -r))
plus = my_backward({"s": scales, "r": r}, cotangents)
minus = my_backward({"s": scales, "r": -r}, cotangents)
assert np.allclose(plus["s"], minus["s"]) and np.allclose(plus["r"], -minus["r"])
