# %% [markdown]
# # Eq. (5), Eq. (7), Eq. (8) and Eq. (15): the four stages of training
#
# **Promise.** After this you can say what each stage of training switches on, and how that changes
# the gradient and the picture. **Before it:** `17_pipeline_by_hand`. **Takes** eight seconds on two
# cores, 25 minutes of reading and 35 of exercises.
#
# **Files:** [presets.py](../p4dgs_ref/training/presets.py),
# [trainer.py](../p4dgs_ref/training/trainer.py),
# [objective.py](../p4dgs_ref/training/objective.py).

# %%
from dataclasses import replace

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, show, tour

plt = figures.pyplot()
architecture.show(
    "18_four_stages",
    "deformation",
    "deformed",
    "noise",
    "step",
    "hash_grid",
    "prior",
    "likelihood",
    "rate_loss",
    "total_loss",
)

# %% [markdown]
# ## What fails without it
# Noise, motion and the rate each prevent a failure of their own. A model that never met noise
# loses quality when its numbers are rounded, one that does not know time draws every ball at one
# place, and without the rate nothing rewards a small file.
#
# The first picture is from `demo.p4dgs`. In the last one its Gaussians stay where they are before
# Eq. (6). The other two come from whole trainings of the same length, one with $u = 0$ and one with
# $\lambda_{rate} = 0$. All are decoded from their files, and the numbers are means over the ten
# test views.

# %%
from p4dgs_ref import PRESETS, SETTINGS, decode, encode, evaluate, load_scene

scene, demo = load_scene("bouncing"), tour.MODEL
files = {
    "all four stages": tour.DATA,
    "without noise": tour.place_of("no noise").read_bytes(),
    "without the rate": tour.place_of("no rate").read_bytes(),
}
trained = {name: decode(data) for name, data in files.items()}
networks = {name: layers for name, layers in demo.networks.items() if name != "psi_d"}
trained["without motion"] = replace(demo, networks=networks)
quality = {name: evaluate(model, scene)[0]["psnr_db"] for name, model in trained.items()}
sizes = [len(data) for data in files.values()]
print({name: f"{db:.1f} dB" for name, db in quality.items()}, sizes)
assert np.allclose([*quality.values()], [33.5, 31.1, 33.7, 19.8], atol=0.1)
assert sizes[2] > 1.2 * sizes[0]

# %%
titles = {
    f"{name}\n{quality[name]:.1f} dB"
    + (f", {len(files[name]):,} bytes" if name in files else ""): m
    for name, m in trained.items()
}
show.compared("18_without", titles, tour.CAMERA, tour.T, tour.VIEW, anchor=None)

# %% [markdown]
# ## Claim
# The model is not trained all at once. Each of four stages adds one thing (choice Q24;
# `reference.md` lists all choices). Stage 1 trains a scene without motion. Stage 2 adds noise,
# Eq. (7), with the base step $q = Q_0$. Stage 3 adds time, Eqs. (5) and (6). Stage 4 adds the
# hash grid, the adaptive steps of Eq. (8), and the rate in Eq. (15). In one formula, from stage 1
# to stage 4:
# $$\tilde f = f + u\,q,\quad u \in [-\tfrac12, \tfrac12),\quad
#   q = 0,\; Q_0,\; Q_0,\; Q_0(1+\tanh\psi_q(h)),$$
# $$\mathcal{L} = \mathcal{L}_{render} + \lambda\,[\text{stage 4}]\,\mathcal{L}_{rate}.$$

# %% [markdown]
# ## By hand
# For synthetic scenes the paper ends the stages after 3000, 5000, 10000 and 40000 iterations, so
# they last 3000, 2000, 5000 and 30000 iterations. Iterations are counted from 0, so iteration
# 4999 still belongs to stage 2. Stage 4 has 75 percent of all iterations.

# %%
paper = PRESETS["paper_synthetic"]

lasts = np.diff(paper.stage_ends, prepend=0)
assert (lasts.tolist(), 100 * lasts[3] / lasts.sum()) == ([3000, 2000, 5000, 30000], 75)
assert [paper.stage(i) for i in (0, 4999, 5000, 10_000)] == [1, 2, 3, 4]

# %% [markdown]
# The effect of noise can be computed for a single scalar. Let a feature $f = 0.7$ have the loss
# $(\tilde f - 1)^2$ and the step $q = 0.4$. Stage 1 sees the loss 0.09. With noise, the mean loss
# over $u$ is $(f-1)^2 + q^2/12$. The gradient of $f$ has not changed, but the loss is larger by
# 0.0133, and this additional term rewards a finer step. Without a price for bits the best step
# would be 0. This is why $q$ becomes trainable only in stage 4, together with the rate.

# %%
f, q = 0.7, 0.4
u = (np.arange(1000) + 0.5) / 1000 - 0.5


def mean_loss(f, q):
    return ((f + u * q - 1) ** 2).mean()


slope = (mean_loss(f + 1e-6, q) - mean_loss(f - 1e-6, q)) / 2e-6
assert np.isclose(mean_loss(f, 0), 0.09)
assert np.isclose(mean_loss(f, q) - 0.09, q**2 / 12, rtol=1e-5)
assert round(mean_loss(f, q) - 0.09, 4) == 0.0133
assert np.isclose(slope, 2 * (f - 1))

# %% [markdown]
# *Anchor 29* shows the same three additions in the trained model. The cell prints how far noise
# moved its features in stages 2 and 3 and at the end of stage 4, how far its child 2 is from its
# canonical place at $t = 0.3$, and how many bits of the file the anchor takes.

# %%
from p4dgs_ref.report.inspect import anchor_bits, float_context

thread = figures.THREAD
q_f = float_context(demo).q[thread.index, 0]
at_t, canonical = (demo.gaussians(time, tour.CAMERA) for time in (tour.T, None))
child = at_t.index == demo.design.k * thread.index + thread.child
(moved_by,) = np.linalg.norm(at_t.x - canonical.x, axis=1)[child]
print(f"noise on features: at most {demo.design.Q_0[0] / 2:.3f}, at the end {q_f / 2:.3f}")
print(f"motion: {moved_by:.2f} scene units; bits: {anchor_bits(tour.DATA)[1][thread.index]:.0f}")

# %% [markdown]
# ## In code
# `Trainer.step_inputs()` returns what an iteration needs besides the parameters. Its field `stage`
# decides what the loss computes: it adds noise from stage 2 on, deforms the Gaussians from stage 3
# on, and has a rate in stage 4. Its field `located` holds the frozen positions in the hash grid and
# is `None` before stage 4. `Trainer.learning_rate(name)` is the learning rate of an array; it is 0
# for an array that does not take part. We train the preset `tiny`, reduced to 100 anchors and 530
# iterations, on a scene of bouncing balls, and record after each stage which arrays have moved.

# %%
from p4dgs_ref.training.objective import psnr
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import LEARNING_RATES, Trainer

ends = (60, 90, 330, 530)
changes = dict(
    anchors=100,
    stage_ends=ends,
    decay_from=330,
    grow_from=20,
    grow_every=20,
    grow_until=260,
    mask_from=330,
)
trainer = Trainer(scene, choose("tiny", changes), seed=0)
history, snapshots, moved, saved = [], [], [], []


def arrays_that_moved(before):
    """The stems of the parameters that differ from `before`; psi_d is the stem of psi_d.W0."""
    stems = set()
    for name, array in trainer.parameters.arrays.items():
        if not np.array_equal(array, before[name]):
            stems.add(name.split(".")[0])
    return stems


for end in ends:
    if trainer.stage == 4:
        trainer.freeze_positions()  # otherwise the first step of stage 4 does it
    stage = trainer.stage
    rates = {stem: trainer.learning_rate(stem) for stem in LEARNING_RATES}
    before = {name: a.copy() for name, a in trainer.parameters.arrays.items()}
    for step in range(end - trainer.iteration):
        losses, rendered, view = trainer.step()
        history.append((trainer.iteration, psnr(rendered.image, view.image), losses.L_rate))
        # We look after two steps, because in the very first one all offsets are 0, and so is
        # the gradient of log_l.
        if step == 1:
            on = trainer.step_inputs()._replace(mask=trainer.mask.copy())
            exact_copy = Parameters(trainer.parameters.arrays, np.float64)
            saved.append((stage, exact_copy, on))
            moved.append(arrays_that_moved(before))
    snapshots.append(trainer.model())
    assert moved[-1] == {stem for stem, learning_rate in rates.items() if learning_rate > 0}
    print(f"stage {stage}: noise {on.stage > 1!s:5}  time {on.stage > 2!s:5}", end="  ")
    print(f"rate {on.located is not None!s:5}  unchanged:", *sorted(set(rates) - moved[-1]))
assert [len(stems) for stems in moved] == [9, 9, 10, 12]
assert (moved[2] - moved[1], moved[2] - moved[3]) == ({"psi_d"}, {"x_a"})

# %% [markdown]
# The positions move in stages 1 to 3 and are frozen in stage 4, because the decoder must query
# the grid at the positions at which the encoder queried it. That they move at all is a choice of
# `tiny` (Q14); in the paper's presets their learning rate is 0.

# %%
scores = [evaluate(model, scene)[0]["psnr_db"] for model in snapshots]
assert scores == sorted(scores)
assert paper.lr_x[0] == 0
print("test PSNR at the ends of the stages:", " ".join(f"{s:.2f} dB" for s in scores))


# %%
def smooth(y, n=15):
    return np.convolve(y, np.ones(n) / n, mode="valid")


iteration, decibel, rate = np.array(history).T
figure, (top, low) = plt.subplots(
    2,
    1,
    figsize=(10, 6.4),
    sharex=True,
    layout="constrained",
    height_ratios=(2, 1),
)
names = ("1\nstill", "2\nnoise", "3\ntime", "4\nrate")
for name, shade, start, end in zip(names, ("0.93", "0.85") * 2, (0, *ends), ends):
    for ax in (top, low):
        ax.axvspan(start, end, color=shade, lw=0)
    top.text((start + end) / 2, 28.2, name, ha="center", va="top", fontsize=13)
top.plot(iteration, decibel, ".", ms=3, color="0.4", label="one training view")
top.plot(iteration[14:], smooth(decibel), color="C0", label="mean of 15")
top.plot(ends, scores, "D", ms=10, color="C1", ls="none", label="test views")
figures.finish(
    top,
    ylabel="PSNR (dB)",
    xlim=(0, 540),
    ylim=(10, 28.5),
    title="Each stage switches something on; the rate exists only in the last",
)
figures.label(
    top,
    (335, 20.5),
    (115, 22.6),
    (95, 14.3),
)
low.plot(iteration[rate > 0], rate[rate > 0], color="C2")
low.set(
    xlabel="iteration",
    ylabel="bits per number",
    ylim=(0, None),
)
figures.show(figure, "18_four_stages_curve")

# %% [markdown]
# The next figure shows one test view after each stage. As long as the model knows no time, a
# moving object is a blur over all its positions. Stage 3 sharpens it. The rate of stage 4 should
# cost nothing that can be seen; if it does, $\lambda$ is too large. This training is so short that
# the pictures still improve in stage 4. We choose the view in which the model without time is
# furthest from the truth.


# %%
def blur(view):
    return np.abs(snapshots[0].render(view.camera, None) - view.image).mean()


view = max(scene.test, key=blur)
times = (None, None, view.time, view.time)
pictures = [model.render(view.camera, time).clip(0, 1) for model, time in zip(snapshots, times)]
errors = [np.abs(picture - view.image).mean() for picture in pictures]
assert errors[2] < 0.7 * errors[1]

# %%
figure, panels = plt.subplots(1, 5, figsize=(14, 4.2), layout="constrained")
names = ("1 still", "2 noise", "3 time", "4 rate")
for ax, picture, name in zip(panels, pictures, names):
    ax.imshow(picture)
    ax.set_title(f"{name}\n{psnr(picture, view.image):.1f} dB")
panels[4].imshow(view.image)
panels[4].set_title("truth")
for ax in panels:
    ax.axis("off")
figures.show(
    figure,
    "18_four_stages",
    title=f"Time sharpens what moves: a test view at t = {view.time:.2f}, at the end of each stage",
)

# %% [markdown]
# ## Backward by hand
# Consider one feature, $\tilde f = f + uq$. In the first three stages q is constant, so
# $\bar f = \bar{\tilde f}$, whatever the noise is. In stage 4 the same $\tilde f$ is rendered and
# rated (choice Q23), and $q$ is trained too. It acts twice, in the noise and in the width of the
# bin of Eq. (11):
# $$\bar{\tilde f} = \bar{\tilde f}_{render} + \lambda\,\bar{\tilde f}_{rate},\qquad
#   \bar f = \bar{\tilde f},\qquad
#   \bar q = \sum_i u_i\,\bar{\tilde f}_i + \lambda\,\bar q_{rate}.$$
# The sum runs over all numbers that share a step (choice Q6). `back` of `objective.loss` contains
# these two sums. A single parameter tests both: the last bias of $\psi_q$ for the group f. It
# influences the picture through the noise, and the bits through both terms. We measure the two
# influences separately with finite differences.

# %%
from p4dgs_ref.training import objective

rng = np.random.default_rng(17)


def draw_noise(p):
    return rng.random((len(p["x_a"]), sum(trainer.design.widths))) - 0.5


def losses_at(p, on, noise):
    """The losses at parameters p in float64 with the parts `on`, and `back`."""
    networks = {name: p.network(name) for name in trainer.design.layers()}
    losses, _, back = objective.loss(
        p,
        trainer.design,
        networks,
        p.arrays_of("grid"),
        on._replace(settings=SETTINGS["exact"]),
        view,
        noise,
    )
    return losses, back


stage, p, on = saved[3]
noise = draw_noise(p)
last_bias = p[f"psi_q.b{len(trainer.design.context)}"]
gradients, _ = losses_at(p, on, noise)[1]()
gradient = gradients[f"psi_q.b{len(trainer.design.context)}"][0]


def slopes(noise, h=1e-4):
    """d L_render and d L_rate by a step in the last bias."""
    ends = []
    for step in (h, -h):
        last_bias[0] += step
        losses = losses_at(p, on, noise)[0]
        last_bias[0] -= step
        ends.append([losses.L_render, losses.L_rate])
    return np.subtract(*ends) / (2 * h)


render_slope, rate_slope = slopes(noise)
both = render_slope + on.lambda_rate * rate_slope
print(f"picture {render_slope:+.3e}, bits {on.lambda_rate * rate_slope:+.3e}")
print(f"sum {both:+.3e}, gradient {gradient:+.3e}")
assert abs(both - gradient) < 1e-4 * abs(gradient)
assert rate_slope < 0  # coarser steps need fewer bits
assert slopes(0 * noise)[0] == 0  # without noise q has no influence on the picture

# %% [markdown]
# Now the whole gradient: in each stage we compare it with a finite difference along a random
# direction. An array that a stage does not use has the gradient 0 in every entry, not only a
# learning rate of 0. Two gradients differ from the slope on purpose: no gradient flows through
# $\mathcal{E}(x)$ back to x (choice Q10), and signs have no slope, so the grid receives a
# straight-through gradient (`09_hash_grid`). The arrays whose difference would involve one of
# these two are therefore kept fixed: x_a, O_a and log_l from stage 3 on, and in stage 4 also the
# grid and $\psi_q$.

# %%
held_fixed = {
    1: (),
    2: (),
    3: ("x_a", "O_a", "log_l"),
    4: ("x_a", "O_a", "log_l", "psi_q", "grid"),
}
for stage, p, on in saved:
    noise = draw_noise(p)
    gradients, _ = losses_at(p, on, noise)[1]()
    varied = p.per_element(lambda name: name.split(".")[0] not in held_fixed[stage])
    way = rng.normal(size=p.vector.size) * varied
    origin = p.vector.copy()
    ends = []
    for step in (1e-7, -1e-7):
        p.vector[:] = origin + step * way
        ends.append(losses_at(p, on, noise)[0].L_total)
    p.vector[:] = origin
    slope = (ends[0] - ends[1]) / 2e-7
    by_gradient = gradients.vector @ way
    print(f"stage {stage}: by differences {slope:+.6e}, by gradient {by_gradient:+.6e}")
    assert abs(slope - by_gradient) < 1e-5 * abs(slope)
    for name, first_stage in (("psi_d.W0", 3), ("psi_p.W0", 4), ("grid.0", 4)):
        assert gradients[name].any() == (stage >= first_stage)

# %% [markdown]
# ## Break it
# Leave the noise out. Nothing looks wrong during training: the loss is even smaller, because noise
# only disturbs. But a file holds rounded numbers, Eq. (10). The cell rounds both models of the
# first figure again, to steps four times as wide. The model that has met noise loses less.

# %%
for name in ("all four stages", "without noise"):
    Q_0 = tuple(4 * step for step in trained[name].design.Q_0)
    wide = replace(trained[name], design=replace(trained[name].design, Q_0=Q_0))
    coarse = evaluate(decode(encode(wide)), scene)[0]["psnr_db"]
    print(f"{name}: {quality[name]:.1f} dB, with wider steps {coarse:.1f} dB")

# %% [markdown]
# Only one habit reveals this mistake: always evaluate the *decoded* model, never the trainer's
# own.

# %% [markdown]
# ## What a codec does with it
# Video encoders often work in two passes: the first analyses the scene, and the second spends the
# bits. Here, too, no part of the model knows what a number costs before stage 4; from then on, the
# numbers become cheaper. A decoder has no stages.

# %%
in_stage_4 = rate[rate > 0]
data = encode(snapshots[-1])
after = evaluate(decode(data), scene)[0]["psnr_db"]
print(
    f"bits per number: {in_stage_4[0]:.2f} at the start of stage 4, {in_stage_4[-1]:.2f} at its end"
)
print(f"{len(data)} bytes; {scores[3]:.2f} dB as trained, {after:.2f} dB decoded")
assert len(in_stage_4) == 200
assert in_stage_4[-1] < 0.8 * in_stage_4[0]
assert abs(after - scores[3]) < 0.5

# %% [markdown]
# ## What this idea buys
# In the first figure, noise buys more than two decibels, and the rate makes the file 19 percent
# smaller. The bars show what motion buys: whole trainings with and without $\Delta x$, three seeds
# each. The paper has no such numbers.
#
# What does the *order* of the stages buy? The paper gives no comparison. It is often said that
# Gaussians must not move from the first iteration on, but here they may: with
# `changes | {"stage_ends": (0, 0, 330, 530)}` the training of this page has noise and motion from
# the start, and ends at 26.2 dB as it does above. In the paper's scenes the third stage begins
# after 4,000 or 5,000 iterations.

# %%
from tutorials import gains

rows = {"with motion": "as listed", "without motion": "without translation"}
gains.show("18_four_stages", rows, {}, record="effects")
moving, still = (gains.mean(label, "psnr_db", "effects") for label in rows.values())
print(f"means: {moving:.1f} dB and {still:.1f} dB")
assert moving > still + 10

# %% [markdown]
# **In short**
# - Stage 1 learns a scene that stands still, stage 2 adds noise, stage 3 motion, stage 4 the
#   context and the rate.
# - A part that does not yet take part has the gradient 0.
# - Noise, motion and rate are all needed. Their order is the paper's choice.
#
# **Often misunderstood**
# - *Each stage trains its own part.* Everything that has begun goes on, except for the positions,
#   which stage 4 freezes.
# - *Noise is a regulariser.* It stands for the rounding in the file, so it has the file's step.
# - *The rate makes pictures better, because they improve in stage 4.* They improve because training
#   goes on. The rate makes the file smaller, and some quality is its price.

# %% [markdown]
# ## Exercises
# **18.1** ● What percentage of its iterations does the preset `paper_real` spend in stage 3?
#
# **18.2** ● In which stage of `tiny` does each of these arrays move for the first time: x_a, f_a,
# log_s, log_l, O_a, psi_alpha, psi_c, psi_r, psi_s, psi_d, psi_p, psi_q, grid? Give thirteen
# numbers.
#
# **18.3** ●●● Write the part of the backward that stage 4 adds: the gradients of all bits for the
# noisy numbers and the steps. The output `bits` is Eq. (13) plus Eq. (14), without the offsets of
# masked children. The output `L_rate` is `bits` divided by the count of all numbers, the masked
# ones included.
#
# **Predict, then run.** Stage 4 runs with $\lambda_{rate} = 0$, so that only the picture counts.
# Which of $\psi_p$, $\psi_q$ and the hash grid still get a gradient?

# %%
answer_1 = answer_2 = ...


def my_backward(inputs, cotangents):
    """Return {"noisy" (A, n), "q" (A, 4)}; you may use the backward of `likelihood`.

    The cotangents "bits_bar" and "L_rate_bar" are scalars. The inputs are "noisy", "mu", "sigma"
    (A, n) with columns in the order f, s, l, O; "q" (A, 4), one step for each group; "mask" (A, k);
    "d" and "k".
    """
    raise NotImplementedError


lessons.check_number("18.1", answer_1)
lessons.check_number("18.2", answer_2)
lessons.check_backward("18.3", my_backward, "rate_stage", "noisy", "q")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rate_stage` judges what stage 4 of a port computes, and
# `--only context_stage` judges the steps, means and deviations before it. Typical mistakes of
# ports are to draw the noise twice, once for rendering and once for the rate, and to train
# $\psi_d$ from iteration 0.


# %%
from p4dgs_ref.model import Context


def port(noisy, mu, sigma, q, mask, grids, d, k):
    widths = replace(trainer.design, d=d, k=k)
    return objective.rate(noisy, Context(q, mu, sigma), grids, mask, widths)[0]


lessons.passes("rate_stage", port=port)
