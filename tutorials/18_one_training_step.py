# %% [markdown]
# # Eq. (15) to Eq. (17): one training step, and who moved which feature
#
# **Promise.** After this you know every array of a step by its shape, and can say: this pixel's red error moved this feature of
# that anchor by so much. **Before it:** `17_four_stages`. **Takes** four seconds on two cores, an hour of yours.

# %%
import numpy as np

from p4dgs_ref import SETTINGS, load_scene, oracle
from p4dgs_ref.equations import likelihood, noise, render_loss, total_loss
from p4dgs_ref.model import Anchors, context, groups, predict, predict_backward, split
from p4dgs_ref.oracle.pipeline import trace_forward
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import render
from p4dgs_ref.training import objective
from p4dgs_ref.training.adam import BETA_1, BETA_2, EPSILON, Adam
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer

plt, EXACT = lessons.pyplot(), SETTINGS["exact"]

# %% [markdown]
# ## Claim
# A step is: one view, one noise $u$, the losses, their gradient, Adam. The loss is
# $$\mathcal{L}_{total} = \lambda_{rate}\mathcal{L}_{rate} + \mathcal{L}_{render} \tag{15}$$
# with Eq. (16) for the picture and Eq. (17) for the bits.

# %% [markdown]
# The backward is *linear* in what enters it. So the gradient of any parameter is a sum, with one term for each number of the
# picture and one for the bits. Whoever asks "why did this feature move?" can be given the list.

# %% [markdown]
# ## By hand
# Two pixels show the same feature with weights 0.5 and 0.25. One is too bright by 0.4, the other too dark by 0.2. With the loss
# $\frac12\sum e^2$ they ask for 0.2 and -0.05: together 0.15. The second pixel loses the vote, but its share is known.

# %%
weight, error = np.array([0.5, 0.25]), np.array([0.4, -0.2])
shares = weight * error
assert (
    weight.tolist() == [0.5, 0.25]
    and np.allclose(shares, [0.2, -0.05])
    and np.isclose(shares.sum(), 0.15)
)
assert (0.4, 0.2) == tuple(abs(error))

# %% [markdown]
# ## In code
# We need a model that has learnt something: `tiny`, cut to 80 anchors, trained for 360 iterations, 30 of them in stage 4.
# Then we take everything over in `float64`, and render with the exact settings.

# %%
changes = dict(
    anchors=80,
    d=8,
    hidden=(16, 16),
    deformation=(32, 32),
    stage_ends=(60, 90, 330, 400),
    decay_from=330,
    grow_from=20,
    grow_every=20,
    grow_until=260,
    mask_from=400,
)
trainer = Trainer(load_scene("bouncing"), choose("tiny", changes), seed=0)
while trainer.iteration < 360:
    trainer.step()
assert (
    trainer.preset.anchors == 80
    and trainer.iteration == 360
    and 360 - trainer.preset.stage_ends[2] == 30
)
assert trainer.stage == 4
p, design, fixed, view = (
    Parameters(trainer.parameters.arrays, np.float64),
    trainer.design,
    trainer.fixed()._replace(settings=EXACT),
    trainer.next_view(),
)
networks, grids = {name: p.network(name) for name in design.layers()}, p.listed("grid")
A, n = len(p["x_a"]), sum(design.widths)
u = np.random.default_rng(18).random((A, n)) - 0.5

# %% [markdown]
# **Forward**, array by array. First Fig. 2: the context of every anchor, and the noisy numbers, columns in the order f, s, l, O.

# %%
table = []
note = lambda name, array: table.append(
    (name, np.shape(array), float(np.mean(array)), float(np.std(array)))
)
values = objective.linear_values(p)
ctx = context(design, networks, grids, fixed.located)[0]
noisy = np.concatenate(
    [
        noise.forward(part, draw, ctx.q[:, i : i + 1])[0].f_noisy
        for i, (part, draw) in enumerate(zip(groups(values, design), groups(u, design)))
    ],
    axis=1,
)
for name, array in (
    ("values: f s l O", values),
    ("u", u),
    ("q", ctx.q),
    ("mu", ctx.mu),
    ("sigma", ctx.sigma),
    ("noisy", noisy),
):
    note(name, array)

# %% [markdown]
# Then Fig. 1: from the noisy anchors to Gaussians at the view's time, to splats, to the picture, to the losses.

# %%
f, s, l, O = split(noisy, design)
g, res_p = predict(
    design, networks, Anchors(p["x_a"], f, s, l, O, fixed.mask), view.camera.center, view.time
)
out, res_r = render.forward(*g[:5], view.camera, fixed.background, EXACT)
truth = view.image.astype(float)
loss, res_l = render_loss.forward(out.image, truth, fixed.lambda_ssim)
rate, res_b = objective.rate_forward(noisy, ctx, grids, fixed.mask, design)
total = total_loss.forward(loss.L_render, rate.L_rate, fixed.lambda_rate)[0].L_total
for name, array in (
    *zip(g._fields[:5], g),
    ("mean2d", res_r.splats.mean2d),
    ("image", out.image),
    *loss._asdict().items(),
    ("bits", rate.bits),
    ("L_rate", rate.L_rate),
    ("L_total", total),
):
    note(name, array)
losses, _, res = objective.forward(p, design, networks, grids, fixed, view, u)
assert np.isclose(losses.L_total, total, rtol=1e-12) and np.isclose(
    losses.bits, rate.bits, rtol=1e-12
)
print(f"{'array':16s}{'shape':>16s}{'mean':>12s}{'deviation':>12s}")
for name, shape, mean, deviation in table:
    print(f"{name:16s}{shape!s:>16s}{mean:12.4f}{deviation:12.4f}")

# %% [markdown]
# ## Backward by hand
# **The picture.** L1 asks every number of it for the same, whatever its error: $\pm(1-\lambda_{SSIM})/(3HW)$; D-SSIM adds what
# its neighbourhood asks. This cotangent, `image_bar (H, W, 3)`, is all that the rest of the backward knows of the truth.

# %%
image_bar = render_loss.backward(res_l, L_render_bar=1.0)["image"]
sign = np.sign(out.image - truth)
of_l1 = (1 - fixed.lambda_ssim) * sign / sign.size
assert sign.size == 3 * truth.shape[0] * truth.shape[1] and not np.allclose(image_bar, of_l1)
assert np.allclose(
    render_loss.backward(res_l, L1_bar=1 - fixed.lambda_ssim)["image"], of_l1, rtol=1e-12
)

# %% [markdown]
# **The features.** Through the renderer and the four networks, `render.backward` then `predict_backward`; through the bits,
# `rate_backward`. Eq. (7) hands on both: $\bar f = \bar{\tilde f}_{render} + \lambda_{rate}\,\bar{\tilde f}_{rate}$.


# %%
def feature_bar(cotangent):
    """What a cotangent of the picture asks of all features (A, d)."""
    bars = render.backward(res_r, cotangent)
    return predict_backward(res_p, *(bars[name] for name in ("x", "s", "r", "alpha", "color")))[0][
        "f_a"
    ]


of_picture, gradients = feature_bar(image_bar), objective.backward(res)[0]
of_bits = groups(objective.rate_backward(res_b, fixed.lambda_rate, design)[0], design)[0]
assert np.allclose(gradients["f_a"], of_picture + of_bits, rtol=1e-9, atol=1e-15)

# %% [markdown]
# **Linear.** Split the picture in two, anywhere, and send each half back alone: the two gradients add up to the whole.

# %%
half = np.arange(truth.size).reshape(truth.shape) % 2
assert np.allclose(
    feature_bar(image_bar * half) + feature_bar(image_bar * (1 - half)),
    of_picture,
    rtol=1e-9,
    atol=1e-15,
)

# %% [markdown]
# **Whose vote?** For one feature, anchor 12's feature 3, we want the share of all 12288 numbers of the picture. 12288 backwards
# would do. But the share of pixel $p$ is $\bar C(p)\,\partial C(p)/\partial f$, and one difference of the *forward* gives that
# derivative for all pixels at once.

# %%
a, j, h = 12, 3, 1e-5
picture = []
for step in (h, -h):
    f[a, j] += step
    moved = predict(
        design, networks, Anchors(p["x_a"], f, s, l, O, fixed.mask), view.camera.center, view.time
    )[0]
    picture.append(render.forward(*moved[:5], view.camera, fixed.background, EXACT)[0].image)
    f[a, j] -= step
slope = (picture[0] - picture[1]) / (2 * h)
share = image_bar * slope
assert share.size == 12288 and abs(share.sum() - of_picture[12, 3]) < 1e-6 * np.abs(share).sum()
row, column = np.unravel_index(np.abs(share[..., 0]).argmax(), share.shape[:2])
print(
    f"red of pixel ({column}, {row}): {out.image[row, column, 0]:.3f}, truth {truth[row, column, 0]:.3f}"
)

# %% [markdown]
# **The other way round:** a cotangent that is zero but for that pixel's red, sent back. It arrives at every feature at once, and
# at anchor 12's feature 3 with the number of the map.

# %%
one = np.zeros_like(image_bar)
one[row, column, 0] = image_bar[row, column, 0]
asked = feature_bar(one)
assert abs(asked[12, 3] - share[row, column, 0]) <= 1e-6 * abs(asked[12, 3])
order = np.argsort(-np.abs(asked).max(axis=1))
print(
    "anchors that this pixel asks most:",
    *(f"{b} ({np.abs(asked[b]).max():.2e})" for b in order[:5]),
)
print(f"anchors that it does not reach: {(np.abs(asked).max(axis=1) == 0).sum()} of {A}")

# %% [markdown]
# **Adam.** Step $n$ is $-\eta_n\,m/(\sqrt v + \epsilon)$, $m = 0.9\,m_0 + 0.1\,g$, $v = 0.999\,v_0 + 0.001\,g^2$. Both start at
# zero, hence $\eta_n = \eta\sqrt{1 - 0.999^n}/(1 - 0.9^n)$ from the rate $\eta$. The numerator is linear in the gradient:
# once the divisor is known, each share of the gradient has its share of the move. The rest is memory, $0.9\,m_0$.

# %%
adam, before = Adam(p), p["f_a"][a, j].copy()
for mine, theirs in ((adam.first, trainer.adam.first), (adam.second, trainer.adam.second)):
    mine.vector[:] = theirs.vector
adam.steps = dict(trainer.adam.steps)
m_0, v_0, count, lr = (
    adam.first["f_a"][a, j],
    adam.second["f_a"][a, j],
    adam.steps["f_a"] + 1,
    trainer.rate_of("f_a"),
)
divisor = np.sqrt(BETA_2 * v_0 + (1 - BETA_2) * gradients["f_a"][a, j] ** 2) + EPSILON
per_m = -lr * np.sqrt(1 - BETA_2**count) / (1 - BETA_1**count) / divisor
origin = p.vector.copy()
adam.step(p, gradients, trainer.rate_of)
move = p["f_a"][a, j] - before
others = of_picture[a, j] - asked[a, j]
parts = {
    "memory": BETA_1 * m_0 * per_m,
    "this red": 0.1 * asked[a, j] * per_m,
    "other pixels": 0.1 * others * per_m,
    "bits": 0.1 * of_bits[a, j] * per_m,
}
assert (
    BETA_1 == 0.9
    and BETA_2 == 0.999
    and np.isclose(1 - BETA_1, 0.1)
    and np.isclose(sum(parts.values()), move, rtol=1e-6)
)
print("this pixel's red error moved anchor 12's feature 3 by", f"{parts['this red']:+.2e}")
print(
    f"in all it moved by {move:+.2e}:",
    ", ".join(f"{name} {part:+.2e}" for name, part in parts.items()),
)
after = objective.forward(p, design, networks, grids, fixed, view, u)[0].L_total
print(f"the loss of this view with this noise: {total:.5f} before, {after:.5f} after")
p.vector[:] = origin
assert after < total

# %%
figure, panels = plt.subplots(2, 2, figsize=(11.5, 9), layout="constrained")
panels = panels.ravel()
panels[0].imshow(out.image.clip(0, 1))
maps = (
    (out.image[..., 0] - truth[..., 0], "picture - truth"),
    (share[..., 0] * 1e6, "share of the gradient, $10^{-6}$"),
)
for ax, (array, label) in zip(panels[1:3], maps):
    shown = ax.imshow(array, cmap="PuOr", vmin=-np.abs(array).max(), vmax=np.abs(array).max())
    figure.colorbar(shown, ax=ax, label=label)
for ax, title in zip(
    panels,
    ("The noisy picture and a pixel", "Its red error", "Whose red pulls at anchor 12's feature 3?"),
):
    ax.plot(column, row, "s", ms=12, mfc="none", mec=lessons.COLORS[1], mew=2.5)
    ax.set(title=title, xlabel="u (pixels)", ylabel="v (pixels)"), ax.grid(False)
panels[3].barh(list(parts), [1e3 * part for part in parts.values()], color=lessons.COLORS[:4])
panels[3].axvline(1e3 * move, color="k", ls="--", label="the whole move")
(
    panels[3].set(
        title="What the feature's move is made of", xlabel="change of the feature, $10^{-3}$"
    ),
    panels[3].invert_yaxis(),
)
panels[3].legend()
lessons.show(figure, "18_one_training_step")

# %% [markdown]
# ## Break it
# Forget that s is stored as its logarithm: hand $\bar s$ to $\log s$ without the factor $s$. Every factor is positive, so the
# wrong gradient still points downhill, and the loss falls. All signs are right, so even Adam's first step is the same; only
# sizes are wrong, most where s is small. A difference finds it.

# %%
p_bar = gradients["log_s"]
broken = p_bar / np.exp(p["log_s"])


def loss_after(step):
    p["log_s"][...] += step
    made = objective.forward(p, design, networks, grids, fixed, view, u)[0].L_total
    p["log_s"][...] -= step
    return made


assert loss_after(-1e-3 * broken) < total and np.array_equal(np.sign(p_bar), np.sign(broken))
way = np.random.default_rng(1).normal(size=broken.shape)
difference = (loss_after(1e-6 * way) - loss_after(-1e-6 * way)) / 2e-6
print(
    f"by differences {difference:+.4e}, by gradient {(p_bar * way).sum():+.4e}, without the factor {(broken * way).sum():+.4e}"
)
assert (
    abs((p_bar * way).sum() - difference)
    < 1e-4 * abs(difference)
    < abs((broken * way).sum() - difference)
)

# %% [markdown]
# ## What a codec does with it
# An encoder asks the same question before it spends bits: which pixels live on this number? Anchor 12 has a price, the sum of
# its bits, and a reach, the pixels that its features can change. Both can be computed in any step.

# %%
bits = likelihood.forward(noisy, ctx.mu, ctx.sigma, np.repeat(ctx.q, design.widths, axis=1))[0].bits
reach = (np.abs(slope).max(axis=2) > 1e-3 * np.abs(slope).max()).sum()
print(
    f"anchor 12 costs {bits[12].sum():.0f} bits; its feature 3 reaches {reach} of {truth[..., 0].size} pixels"
)
assert a == 12 and j == 3 and bits[12].sum() > 0 and 0 < reach < truth[..., 0].size

# %% [markdown]
# ## Exercises
# **18.1** How hard does L1 alone pull at one number of a picture of 64 x 64 pixels, $\lambda_{SSIM} = 0.2$? **18.2** Adam's very
# first step has no memory. By how much does a parameter move at the rate 0.015 if its gradient is -3e-5? **18.3** Write the
# backward of Eqs. (5) and (6) as the pipeline wants it: nothing flows from $\mathcal{E}(x)$ back into x (README, choice Q10).

# %%
answer_1 = ...
answer_2 = ...


def my_backward(inputs, cotangents):
    """{"x", "s", "r"}, from cotangents["x_t_bar"], ["s_t_bar"], ["r_t_bar"]; use deformation.forward and deformed.backward.

    inputs: "x", "s" (N, 3), "r" (N, 4), "t", "L_x", "L_t", "psi_d_weights", "psi_d_biases".
    """
    raise NotImplementedError


first = Parameters({"w": np.zeros(1)}, np.float64)
fresh, pull = Adam(first), first.zeros()
pull["w"][0] = -3e-5
the_rate = 0.015
fresh.step(first, pull, lambda name: the_rate)
assert (
    pull["w"][0] == -3e-5
    and the_rate == 0.015
    and truth.shape[:2] == (64, 64)
    and fixed.lambda_ssim == 0.2
)
lessons.number("18.1", answer_1, np.abs(of_l1).max())
lessons.number("18.2", answer_2, first["w"][0])
lessons.backward("18.3", my_backward, "temporal_prediction", "x", "s", "r")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only trace` compares ten whole steps: losses, norms of all gradients, all parameters at the end.
# What ports get wrong: $\epsilon$ inside the root, steps counted for arrays that did not take part, positions that still move.

# %%
print(verdict := oracle.check(lambda **inputs: trace_forward(**inputs)[0], "trace"))
assert verdict.ok and trainer.stage == 4 and trainer.rate_of("x_a") == 0
