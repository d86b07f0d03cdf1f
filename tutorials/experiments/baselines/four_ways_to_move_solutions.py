# %% [markdown]
# # Solutions to four ways to move a Gaussian

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import positional_encoding
from p4dgs_ref.lab.baselines import conditional, marginal, plane_features

# %% [markdown]
# **28.1** A player of D3DGS needs the Gaussians and the network. The normals are counted because
# they are in the file. 4DGS has no network. A player needs the 161 parameters of its Gaussians, but
# not the moments of Adam.

# %%
d3dgs = (50_000 * 62 + 522_280) * 4 / 1e6
gaussian4d = 90_000 * 644 / 1e6
lessons.check_number("28.1", [d3dgs, gaussian4d], [12.4 + 2.08912, 57.96])

# %% [markdown]
# **28.2** The velocity is $b/v = 0.75$, so the Gaussian moves by $0.15$. Its variance is
# $0.05 - 0.03^2/0.04$ at all times, and its weight $e^{-0.2^2/0.08}$. The second computation uses
# G2 and G3, whose scales and rotation come from the eigenvalues and eigenvectors of the covariance.

# %%
moved = 1 + 0.75 * 0.2
variance = 0.05 - 0.0009 / 0.04
faded = np.exp(-0.04 / 0.08)
variances, axes = np.linalg.eigh([[0.05, 0.03], [0.03, 0.04]])
R = np.eye(4)[None].copy()
R[0][np.ix_([0, 3], [0, 3])] = axes
s = np.ones((1, 4))
s[0, [0, 3]] = np.sqrt(variances)
x = np.array([[1.0, 0, 0]])
mu_t = np.array([0.5])
(x_t, Sigma_t, var_t), _ = conditional.forward(x, mu_t, s, R, 0.7)
(_, weight), _ = marginal.forward(np.ones(1), mu_t, var_t, 0.7)
by_equations = [x_t[0, 0], Sigma_t[0, 0, 0], weight[0]]
lessons.check_number("28.2", [moved, variance, faded], by_equations)

# %% [markdown]
# **28.3** The nodes are at 0, 0.25, 0.5, 0.75 and 1. The picture at 0.1 reads the first two nodes
# with the weights 0.6 and 0.4, the one at 0.3 the second and the third with 0.8 and 0.2, and the
# one at 0.6 the third and the fourth with 0.6 and 0.4. Each cotangent goes back with the same
# weights. The second computation is H1 with planes of which all but one are 1 everywhere.

# %%
by_hand = [0.6, 0.4 - 1.6, -0.4 + 3, 2, 0]
in_space = [np.ones((2, 2, 1)) for _ in range(3)]
in_time = [np.ones((2, 5, 1)) for _ in range(3)]
planes = in_space + in_time
x = np.zeros((1, 3))
lo = np.zeros(3)
hi = np.ones(3)
p_bar = np.zeros(5)
for t, x_bar in ((0.1, 1), (0.3, -2), (0.6, 5)):
    _, saved = plane_features.forward(x, t, lo, hi, planes)
    features_bar = np.array([[float(x_bar)]])
    bars = plane_features.backward(saved, features_bar)["planes"]
    p_bar += bars[5].sum(axis=(0, 2))
lessons.check_number("28.3", by_hand, p_bar)

# %% [markdown]
# **Predict, then run.** The network continues along some curve, because its sines continue, but no
# picture has constrained this curve. The planes clamp the time to the nearest end, so the last
# picture is frozen. The 4D Gaussians continue along their lines and fade until nothing is left.

# %%
planes = [plane * np.linspace(1, 2, plane.shape[1])[:, None] for plane in planes]
end, _ = plane_features.forward(x, 1.0, lo, hi, planes)
after, _ = plane_features.forward(x, 1.25, lo, hi, planes)
assert np.array_equal(end, after)
(_, weight), _ = marginal.forward(np.ones(1), np.array([0.95]), np.array([0.05**2]), 1.25)
assert weight[0] < 1e-7
E_end, E_after = (positional_encoding.forward(np.array([[t]]), 4)[0] for t in (1.0, 1.25))
assert np.abs(E_after - E_end).max() > 0.2
