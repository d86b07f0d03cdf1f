# %% [markdown]
# # Solutions to Eq. (2)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import view

x_a = np.array([3.0, -1, 7])
x_c = np.array([1.0, 2, 1])

# %% [markdown]
# **02.1** From $d\ln\delta = d\delta/\delta$, the cotangent $49$ of the logarithm is one of
# $49/\delta$ of the distance. The gradient still points along the ray, but it now fades with the
# distance: it is $(2, -3, 6)$ nearby and a tenth of that ten times as far away. So both outputs of
# Eq. (2) would have the factor $1/\delta$, and an anchor close to the camera would get a very large
# gradient.

# %%
anchors = x_c + np.outer([1, 10], x_a - x_c)
(delta_vc, _), saved = view.forward(anchors, x_c)
log_bar = np.full((2, 1), 49.0)
answer_1 = view.backward(saved, log_bar / delta_vc, np.zeros((2, 3)))["x_a"]
v = anchors - x_c
lessons.check_number("02.1", answer_1, 49 * v / (v**2).sum(axis=1, keepdims=True))


def log_distance(x_a):
    (delta_vc, _), _ = view.forward(x_a, x_c)
    return np.log(delta_vc), None


rng = np.random.default_rng(2)
_ = lessons.adjoint(rng, log_distance, {"x_a": anchors}, log_bar, {"x_a": answer_1})


# %% [markdown]
# **02.2** Dividing by the largest component first keeps every square in range. Where the largest
# component is zero, the distance and the direction are zero too.
#
# **02.3** The first term is the gradient of the length, which points along the ray. The second one
# is the component of $\bar d_{vc}$ perpendicular to the ray, divided by the length. It is written
# as the sum of *For ports*, so that nothing cancels where the ray nearly follows an axis.


# %%
def my_forward(x_a, x_c):
    v = x_a - x_c
    largest = np.abs(v).max(axis=1, keepdims=True)
    scaled = v / np.where(largest > 0, largest, 1)
    delta_vc = largest * np.sqrt((scaled**2).sum(axis=1, keepdims=True))
    d_vc = v / np.where(delta_vc > 0, delta_vc, 1)
    return delta_vc, d_vc


def my_backward(inputs, cotangents):
    delta_vc, d_vc = my_forward(**inputs)
    d_bar = cotangents["d_vc_bar"]
    products = d_bar[:, :, None] * d_vc[:, None, :]
    minors = products - products.transpose(0, 2, 1)
    across = (minors * d_vc[:, None, :]).sum(axis=2)
    x_a_bar = d_vc * cotangents["delta_vc_bar"]
    x_a_bar += across / np.where(delta_vc > 0, delta_vc, np.inf)
    return {"x_a": x_a_bar}


lessons.check_forward("02.2", my_forward, "view")
lessons.check_backward("02.3", my_backward, "view")

# %% [markdown]
# **Predict, then run.** The largest float16 is 65504, but $300^2 = 90000$. The distance is
# infinite and the direction zero. With the largest component divided out first, both are right.

# %%
v = np.array([300, 0, 0], np.float16)
with np.errstate(over="ignore"):
    distance = np.sqrt((v**2).sum())
assert np.isinf(distance) and not (v / distance).any()
assert np.abs(v).max() * np.sqrt(((v / 300) ** 2).sum()) == 300
