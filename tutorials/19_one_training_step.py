# %% [markdown]
# # Eq. (15) to Eq. (17): one training step, and who moved which feature
#
# **Promise.** After this you know every array of a training step by its shape, and you can say by
# how much the error of one pixel's red value moved one feature of one anchor. **Before it:**
# `18_four_stages`. **Takes** 20 seconds on two cores, 25 minutes of reading and 30 of exercises.
#
# **Files:** [objective.py](../p4dgs_ref/training/objective.py),
# [parameters.py](../p4dgs_ref/training/parameters.py) (Adam),
# [trainer.py](../p4dgs_ref/training/trainer.py).

# %%
from dataclasses import replace

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, shared, show, tour

plt = figures.pyplot()
architecture.show("19_one_training_step", "noise", "render_loss", "rate_loss", "total_loss")

# %% [markdown]
# ## What fails without it
# A training step sends two gradients to each feature: one asks for a better picture, one for fewer
# bits. If the first is lost on the way, the bits become fewer, as they should, and training ruins a
# picture that was already good.
#
# The cell trains the scene of `demo.p4dgs` for 100 more iterations at the last learning rates: once
# all attributes get only the gradient of their bits, and once both gradients. The numbers are means
# over the ten test views, before rounding. *Anchor 29*, which leads through the tutorials, is
# purple.

# %%
from p4dgs_ref import SETTINGS, evaluate, load_scene
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer


class BitsAlone(Trainer):
    """A training whose attributes get the gradient of their bits, without the picture's."""

    def gradients_of(self, view):
        noise, preset = self.rng.bit_generator.state, self.preset
        found = super().gradients_of(view)
        self.rng.bit_generator.state = noise  # so that both draw the same u
        self.preset = replace(preset, lambda_rate=0.0)
        of_picture = super().gradients_of(view)[2]
        self.preset = preset
        for name in ("f_a", "log_s", "log_l", "O_a"):
            found[2][name][...] -= of_picture[name]
        return found


scene, thread = load_scene("bouncing"), figures.THREAD
preset = choose("tiny", {"anchors": tour.MODEL.count, "grow": "off", "mask_from": 3800})
ends = {"before": tour.MODEL}
for name, kind in (("by the bits alone", BitsAlone), ("by both gradients", Trainer)):
    trainer = shared.at_the_end(kind(scene, preset), tour.MODEL, 100)
    ends[name] = trainer.run()
quality = {name: evaluate(model, scene)[0]["psnr_db"] for name, model in ends.items()}
print({name: f"{db:.1f} dB" for name, db in quality.items()})
assert quality["by the bits alone"] < quality["before"] - 2 < quality["by both gradients"] - 1.9

# %%
titles = {f"{name}\n{quality[name]:.1f} dB": model for name, model in ends.items()}
near = {"xlim": (31, 61), "ylim": (45, 15)}
show.compared("19_gradients", titles, tour.CAMERA, tour.T, near)

# %% [markdown]
# ## Claim
# A training step takes one view and one draw of the noise $u$, computes the losses and their
# gradient, and lets Adam move the parameters. The loss is
# $$\mathcal{L}_{total} = \lambda_{rate}\mathcal{L}_{rate} + \mathcal{L}_{render} \tag{15}$$
# with Eq. (16) for the picture and Eq. (17) for the bits. The backward pass is *linear* in the
# cotangents. The gradient of any parameter is therefore a sum with one term for each number of
# the picture and one term for the bits, and the question "why did this feature move?" has a
# precise answer: the list of these terms.

# %% [markdown]
# ## By hand
# Two pixels show the same feature with weights 0.5 and 0.25. The first is too bright by 0.4, and
# the second is too dark by 0.2. With the loss $\frac12\sum e^2$ they contribute 0.2 and -0.05 to
# the gradient, together 0.15. The second pixel is outvoted, but its contribution is known.

# %%
weight = np.array([0.5, 0.25])
error = np.array([0.4, -0.2])


def loss_of(feature):
    return 0.5 * ((error + weight * feature) ** 2).sum()


shares = weight * error
assert np.allclose(shares, [0.2, -0.05])
assert np.isclose(shares.sum(), (loss_of(1e-6) - loss_of(-1e-6)) / 2e-6)

# %% [markdown]
# ## In code
# We look at the step that would come next in the training with both gradients. All its parameters
# are copied to `float64`, and the exact settings of the renderer are used.

# %%
from p4dgs_ref.training.parameters import BETA_1, BETA_2, EPSILON, Adam, Parameters

assert trainer.stage == 4

design = trainer.design
view = trainer.next_view()
inputs = trainer.step_inputs()._replace(settings=SETTINGS["exact"])
truth = view.image.astype(float)
p = Parameters(trainer.parameters.arrays, np.float64)
networks = {name: p.network(name) for name in design.layers()}
grids = p.arrays_of("grid")
A = len(p["x_a"])
u = np.random.default_rng(18).random((A, sum(design.widths))) - 0.5

# %% [markdown]
# **Forward**, array by array. First comes Fig. 2 of the paper: the context of every anchor, and
# the noisy attributes, whose columns are in the order f, s, l, O.

# %%
from p4dgs_ref.equations import likelihood, noise, render_loss, total_loss
from p4dgs_ref.model import Anchors, context, groups, predict, split
from p4dgs_ref.training import objective

table = []


def note(name, array):
    table.append((name, np.shape(array), np.mean(array), np.std(array)))


values = objective.linear_values(p)
ctx, _ = context(design, networks, grids, inputs.located)
noisy_groups = []
for i, (part, draw) in enumerate(zip(groups(values, design), groups(u, design))):
    f_noisy, _ = noise.forward(part, draw, ctx.q[:, i : i + 1])
    noisy_groups.append(f_noisy)
noisy = np.concatenate(noisy_groups, axis=1)
note("values: f s l O", values)
note("u", u)
note("q", ctx.q)
note("mu", ctx.mu)
note("sigma", ctx.sigma)
note("noisy", noisy)

# %% [markdown]
# Then comes Fig. 1: from the noisy anchors to Gaussians at the view's time, to a picture, and to
# the losses.

# %%
from p4dgs_ref.splatting import render

f, s, l, O = split(noisy, design)


def gaussians():
    """The Gaussians at the view's time, all opacities, and `back` from cotangents to anchors."""
    anchors = Anchors(p["x_a"], f, s, l, O, inputs.mask)
    return predict(design, networks, anchors, view.camera.center, view.time)


def rendered(g):
    return render.forward(*g[:5], view.camera, inputs.background, inputs.settings)


g, _, back_g = gaussians()
(image, *_), saved_r = rendered(g)
(L_render, L1, D_SSIM), saved_l = render_loss.forward(image, truth, inputs.lambda_ssim)
(bits, L_rate), back_rate = objective.rate(noisy, ctx, grids, inputs.mask, design)
L_total, _ = total_loss.forward(L_render, L_rate, inputs.lambda_rate)
for name in ("x", "s", "r", "alpha", "color"):
    note(name, getattr(g, name))
note("image", image)
note("L_render", L_render)
note("L1", L1)
note("D_SSIM", D_SSIM)
note("bits", bits)
note("L_rate", L_rate)
note("L_total", L_total)

losses, _, back = objective.loss(p, design, networks, grids, inputs, view, u)
assert np.isclose(losses.L_total, L_total, rtol=1e-12)
assert np.isclose(losses.bits, bits, rtol=1e-12)
print(f"{'array':16s}{'shape':>16s}{'mean':>12s}{'deviation':>12s}")
for name, shape, mean, deviation in table:
    print(f"{name:16s}{shape!s:>16s}{mean:12.4f}{deviation:12.4f}")

# %% [markdown]
# ## Backward by hand
# **The picture.** L1 sends the same cotangent to every number of the picture, whatever its error
# is: $\pm(1-\lambda_{SSIM})/(3HW)$. D-SSIM adds a part that depends on the neighbourhood. Their
# sum, `image_bar (H, W, 3)`, is all that the rest of the backward pass knows about the true
# picture.

# %%
image_bar = render_loss.backward(saved_l, 1.0)["image"]
of_l1 = render_loss.backward(saved_l, 0.0, L1_bar=1 - inputs.lambda_ssim)["image"]
by_hand = (1 - inputs.lambda_ssim) * np.sign(image - truth) / truth.size
assert np.allclose(of_l1, by_hand, rtol=1e-12)

# %% [markdown]
# **The features.** Two gradients arrive at the features. One comes from the picture, through
# `render.backward` and the `back` of `predict`; the other comes from the bits, through the `back`
# of `rate`. Eq. (7) passes both on:
# $\bar f = \bar{\tilde f}_{render} + \lambda_{rate}\,\bar{\tilde f}_{rate}$.


# %%
def feature_bar(cotangent):
    """The gradient of all features (A, d) for a cotangent of the picture."""
    bars = render.backward(saved_r, cotangent)
    of_gaussians = [bars[name] for name in ("x", "s", "r", "alpha", "color")]
    anchors_bar, _ = back_g(*of_gaussians)
    return anchors_bar["f_a"]


of_picture = feature_bar(image_bar)
noisy_bar = back_rate(inputs.lambda_rate)[0]
of_bits = groups(noisy_bar, design)[0]
gradients, _ = back()
assert np.allclose(gradients["f_a"], of_picture + of_bits, rtol=1e-9, atol=1e-15)

# %% [markdown]
# **Linear.** Divide the numbers of the picture into two halves, in any way, and send each half
# back alone. The two gradients add up to the whole.

# %%
half = np.arange(truth.size).reshape(truth.shape) % 2
first, second = feature_bar(image_bar * half), feature_bar(image_bar * (1 - half))
assert np.allclose(first + second, of_picture, rtol=1e-9, atol=1e-15)

# %% [markdown]
# **The share of each pixel.** For one feature, feature 3 of anchor 29, we want the share that
# each of the 12288 numbers of the picture has in its gradient. This could be found with 12288
# backward passes. But the share of pixel $p$ is $\bar C(p)\,\partial C(p)/\partial f$, and one
# finite difference of the *forward* pass gives this derivative for all pixels at once.

# %%
a, j, h = thread.index, 3, 1e-5


def picture_at(step):
    f[a, j] += step
    (moved, *_), _ = rendered(gaussians()[0])
    f[a, j] -= step
    return moved


slope = (picture_at(h) - picture_at(-h)) / (2 * h)
share = image_bar * slope
assert share.size == 12288
assert abs(share.sum() - of_picture[a, j]) < 1e-6 * np.abs(share).sum()
row, column = np.unravel_index(np.abs(share[..., 0]).argmax(), share.shape[:2])
print(
    f"the largest share of red is that of pixel ({column}, {row}): "
    f"{image[row, column, 0]:.3f}, truth {truth[row, column, 0]:.3f}"
)

# %% [markdown]
# **The other direction.** Now we send back a cotangent that is zero except for the red value of
# that pixel. It reaches the features of all anchors at once, and the gradient of feature 3 of
# anchor 29 is the pixel's number in the map of shares.

# %%
only_red = np.zeros_like(image_bar)
only_red[row, column, 0] = image_bar[row, column, 0]
of_red = feature_bar(only_red)
assert abs(of_red[a, j] - share[row, column, 0]) <= 1e-6 * abs(of_red[a, j])
largest = np.abs(of_red).max(axis=1)
print("the anchors on which this pixel has the largest effect:")
for b in np.argsort(-largest)[:5]:
    print(f"    anchor {b}: {largest[b]:.2e}")
print(f"anchors on which it has none: {(largest == 0).sum()} of {A}")

# %% [markdown]
# **Adam.** Step $n$ changes a parameter by $-\eta_n\,m/(\sqrt v + \epsilon)$, where
# $m = 0.9\,m_0 + 0.1\,g$ and $v = 0.999\,v_0 + 0.001\,g^2$. Both averages start at zero; the
# factor $\eta_n = \eta\sqrt{1 - 0.999^n}/(1 - 0.9^n)$ corrects the learning rate $\eta$ for this.
# The numerator is linear in the gradient. Once the divisor is known, each share of the gradient
# therefore has its share of the move, and what remains is the memory $0.9\,m_0$ of earlier steps.

# %%
adam = Adam(p)
adam.first.vector[:] = trainer.adam.first.vector
adam.second.vector[:] = trainer.adam.second.vector
adam.steps = dict(trainer.adam.steps)
m_0 = adam.first["f_a"][a, j]
v_0 = adam.second["f_a"][a, j]
n = adam.steps["f_a"] + 1
v = BETA_2 * v_0 + (1 - BETA_2) * gradients["f_a"][a, j] ** 2
eta_n = trainer.learning_rate("f_a") * np.sqrt(1 - BETA_2**n) / (1 - BETA_1**n)
move_per_m = -eta_n / (np.sqrt(v) + EPSILON)
other_pixels = of_picture[a, j] - of_red[a, j]
parts = {
    "memory": BETA_1 * m_0 * move_per_m,
    "this red": (1 - BETA_1) * of_red[a, j] * move_per_m,
    "other pixels": (1 - BETA_1) * other_pixels * move_per_m,
    "bits": (1 - BETA_1) * of_bits[a, j] * move_per_m,
}

origin = p.vector.copy()
before = p["f_a"][a, j]
# All arrays of a network, such as psi_c.W0 and psi_c.b0, have the rate of the network.
adam.step(p, gradients, lambda name: trainer.learning_rate(name.split(".")[0]))
move = p["f_a"][a, j] - before
after = objective.loss(p, design, networks, grids, inputs, view, u)[0].L_total
p.vector[:] = origin
assert (BETA_1, BETA_2) == (0.9, 0.999)
assert np.isclose(sum(parts.values()), move, rtol=1e-6)
assert after < L_total
print(f"the pixel's red error moved feature 3 of anchor 29 by {parts['this red']:+.2e}")
print(f"the whole move is {move:+.2e}:", {name: f"{part:+.2e}" for name, part in parts.items()})
print(f"the loss of this view with this noise: {L_total:.5f} before, {after:.5f} after")

# %%
figure, axes = plt.subplots(2, 2, figsize=(11.5, 9), layout="constrained")
seen, red_error, pull, made_of = axes.ravel()
seen.imshow(image.clip(0, 1))
mean2d, cov2d, *_ = show.splats(g, view.camera, g.index // design.k == a)
show.ellipses(seen, mean2d, cov2d, fc="none", ec=thread.color, lw=2.5)
seen.set_title("The noisy picture, a pixel, anchor 29")
red_error.set_title("The picture's red error")
pull.set_title("Whose red pulls on anchor 29's feature 3?")
maps = (
    (red_error, image[..., 0] - truth[..., 0], "picture - truth"),
    (pull, share[..., 0] * 1e6, "share of the gradient, $10^{-6}$"),
)
for ax, array, label in maps:
    limit = np.abs(array).max()
    shown = ax.imshow(array, cmap="PuOr", vmin=-limit, vmax=limit)
    figure.colorbar(shown, ax=ax, label=label)
for ax in (seen, red_error, pull):
    ax.plot(column, row, "s", ms=12, mfc="none", mec="k", mew=2.5)
    figures.finish(ax, xlabel="u (pixels)", ylabel="v (pixels)", grid=False)
lengths = [1e3 * part for part in parts.values()]
made_of.barh(list(parts), lengths, color=figures.COLORS[:4])
made_of.axvline(1e3 * move, color="k", ls="--", label="the whole move")
made_of.invert_yaxis()
figures.finish(
    made_of,
    title="The four parts of the feature's move",
    xlabel="change of the feature, $10^{-3}$",
)
figures.label(made_of, (1e3 * move + 0.01, 3.4))
figures.show(figure, "19_one_training_step")

# %% [markdown]
# ## Break it
# Forget that s is stored as its logarithm, and use $\bar s$ as the gradient of $\log s$, without
# the factor $s$. Since every factor is positive, the wrong gradient still points downhill and the
# loss falls. All signs are right, so even Adam's first step is the same. Only the magnitudes are
# wrong, and most of all where s is small. A finite difference finds the mistake.

# %%
right = gradients["log_s"]
wrong = right / np.exp(p["log_s"])


def loss_after(step):
    p["log_s"][...] += step
    losses = objective.loss(p, design, networks, grids, inputs, view, u)[0]
    p["log_s"][...] -= step
    return losses.L_total


assert loss_after(-1e-3 * wrong) < L_total
assert np.array_equal(np.sign(right), np.sign(wrong))
way = np.random.default_rng(1).normal(size=wrong.shape)
by_difference = (loss_after(1e-6 * way) - loss_after(-1e-6 * way)) / 2e-6
by_right = (right * way).sum()
by_wrong = (wrong * way).sum()
print(f"by differences {by_difference:+.4e}")
print(f"by gradient {by_right:+.4e}, without the factor {by_wrong:+.4e}")
assert abs(by_right - by_difference) < 1e-4 * abs(by_difference)
assert abs(by_wrong - by_difference) > 1e-4 * abs(by_difference)

# %% [markdown]
# ## What an anchor costs and what it reaches
# An encoder asks the same question before it spends bits: which pixels depend on this number?
# Anchor 29 has a price, the sum of the bits of its attributes, and a reach, the set of pixels that
# a feature can change. Both can be computed in any training step. In the file, the 48 bits of its
# position are added to the price.

# %%
columns = np.repeat(ctx.q, design.widths, axis=1)
bits_of_numbers, _ = likelihood.forward(noisy, ctx.mu, ctx.sigma, columns)
strength = np.abs(slope).max(axis=2)
reach = (strength > 1e-3 * strength.max()).sum()
price = bits_of_numbers[a, tour.FILE.kept[a]].sum()  # without the offsets of masked children
print(
    f"the attributes of anchor 29 cost {price:.0f} bits; "
    f"its feature 3 reaches {reach} of {strength.size} pixels"
)

# %% [markdown]
# ## What this idea buys
# The first figure shows what the picture's gradient buys: without it, 100 iterations are enough to
# lose 4.5 decibels. Without the gradient of the bits, $\lambda_{rate} = 0$, nothing makes a number
# cheap. A whole training of this kind (`18_four_stages` begins with it) gives pictures as good as
# the demo's and a file that is 23 percent larger. The paper has no number for either.

# %%
sizes = len(tour.DATA), len(tour.place_of("no rate").read_bytes())
print(f"{sizes[0]:,} bytes with both gradients, {sizes[1]:,} without that of the bits")
assert round(100 * (sizes[1] / sizes[0] - 1)) == 23

# %% [markdown]
# **In short**
# - The gradient of a parameter is a sum: a share of each number of the picture, and one of the
#   bits.
# - Adam divides the sum by the size of earlier gradients and adds its memory of them.
# - If one share is lost, the rest still leads downhill, but to another place.
#
# **Often misunderstood**
# - *A pixel moves only the anchors that it sees.* It also moves the weights of the networks, and
#   with them all anchors.
# - *A feature moves against its gradient.* Most of a step of Adam may be memory.
# - *The bits' gradient is a penalty on large numbers.* It pulls a number to the mean that the
#   context predicts, and the prediction to the number.

# %% [markdown]
# ## Exercises
# **19.1** ● How large is the gradient of L1 alone for one number of a picture of 64 x 64 pixels,
# with $\lambda_{SSIM} = 0.2$? Give its magnitude.
#
# **19.2** ● Adam's very first step has no memory. By how much does a parameter move if the learning
# rate is 0.015 and its gradient is -3e-5?
#
# **19.3** ●● Write the backward of Eqs. (5) and (6) as the pipeline uses it, in which no gradient
# flows from $\mathcal{E}(x)$ back to x (choice Q10 in `reference.md`).
#
# **Predict, then run.** The whole loss is multiplied by $1000$. How do Adam's steps change?

# %%
answer_1 = answer_2 = ...


def my_backward(inputs, cotangents):
    """Return {"x", "s", "r"}; you may call the equations `deformation` and `deformed`.

    The cotangents are "x_t_bar", "s_t_bar" and "r_t_bar". The inputs are "x" and "s" (N, 3), "r"
    (N, 4), "t", "L_x", "L_t", "psi_d_weights" and "psi_d_biases".
    """
    raise NotImplementedError


lessons.check_number("19.1", answer_1)
lessons.check_number("19.2", answer_2)
lessons.check_backward("19.3", my_backward, "temporal_prediction", "x", "s", "r")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only trace` compares ten whole training steps: the losses, the
# norms of all gradients, and all parameters at the end. What a port has to compute there is
# `trace_vjp` in [pipeline.py](../tests/workshop/pipeline.py), which made these vectors. Typical
# mistakes of ports are to place $\epsilon$ inside the root, to count steps for arrays that did not
# take part, and to move the positions in stage 4. The equations that join all parts of the step
# are checked here:

# %%
lessons.passes("render_loss", "total_loss")
