# %% [markdown]
# # Solutions to Eq. (1)

# %%
import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.equations import offsets

x_a = np.array([1, 2, 0])
l_a = np.array([0.5, 0.5, 2])

# %% [markdown]
# **01.1** Axis by axis, the position is $1 + 0\cdot 0.5$, $2 + 4\cdot 0.5$ and $0 - 0.5\cdot 2$.

# %%
lessons.check_number("01.1", [1, 4, -1], x_a + np.array([0, 4, -0.5]) * l_a)


# %% [markdown]
# **01.2** The error of an offset is multiplied by $l_a$, as the offset itself is. Larger scalings
# with smaller offsets describe the same scene, but the same step of the offsets is then coarser in
# the scene. Training finds the balance, because the step is learned, too.

# %%
child = np.array([[[2.0, 0, -0.5]]])
moves = []
for factor in (1, 2):
    given = {"x_a": x_a[None], "l_a": factor * l_a[None]}
    exact, _ = offsets.forward(O_a=child / factor, **given)
    rounded, _ = offsets.forward(O_a=child / factor + 0.1, **given)
    moves.append((rounded - exact)[0, 0])
lessons.check_number("01.2", [[0.05, 0.05, 0.2], [0.1, 0.1, 0.4]], moves)

# %% [markdown]
# **01.3** The anchor stays, because its gradient is the sum of the cotangents, $0$. The gradient of
# $l$ is $2 \cdot 1 - 1 \cdot 1 + 1 \cdot 2 = 3$, so descent makes $l$ smaller and pulls the
# children together. As $dl = l\,d(\log l)$, the gradient of the logarithm is $3 \cdot 0.5 = 1.5$.

# %%
along_x = np.array([[[1.0], [1.0], [-2.0], [0.0]]]) * [1, 0, 0]
of_four = np.array([[[2.0], [-1.0], [-1.0], [0.0]]]) * [1, 0, 0]
_, saved = offsets.forward(np.zeros((1, 3)), of_four, np.full((1, 3), 0.5))
bars = offsets.backward(saved, along_x)
x_a_bar, l_bar = bars["x_a"][0, 0], bars["l_a"][0, 0]
lessons.check_number("01.3", [0, 3, 1.5], [x_a_bar, l_bar, 0.5 * l_bar])

# %% [markdown]
# **Predict, then run.** Between 512 and 1024, numbers in float16 are 0.5 apart. A child moves if
# the product is more than half of that, so the first offset is 3. This is why positions are
# computed in float32. In the file they are 16-bit integers, in steps of 1/65,535 of the anchors'
# box.

# %%
in_half = np.arange(1, 6).astype(np.float16)
children = np.float16(1000) + in_half * np.float16(0.1)
assert np.spacing(np.float16(1000)) == 0.5
assert children.tolist() == [1000, 1000, 1000.5, 1000.5, 1000.5]
