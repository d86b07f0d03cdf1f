# %% [markdown]
# # Eq. (5), Eq. (7), Eq. (8) and Eq. (15): the four stages of training
#
# **Promise.** After this you can say what each stage switches on, and what that does to the gradient and to the picture.
# **Before it:** `16_pipeline_by_hand`. **Takes** eight seconds on two cores, three quarters of an hour of yours.

# %%
from dataclasses import replace

import numpy as np

from p4dgs_ref import PRESETS, SETTINGS, decode, encode, evaluate, load_scene, oracle
from p4dgs_ref.equations import rounding
from p4dgs_ref.oracle.stages_coding import rate_backward, rate_forward
from p4dgs_ref.school import lessons
from p4dgs_ref.training import objective
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.progress import psnr
from p4dgs_ref.training.trainer import LEARNING_RATES, Trainer

plt, paper = lessons.pyplot(), PRESETS["paper_synthetic"]

# %% [markdown]
# ## Claim
# The model is not trained all at once. Each stage adds one thing (choice Q24; the README lists all choices): 1 a still scene;
# 2 noise, Eq. (7), with $q = Q_0$; 3 time, Eqs. (5) and (6); 4 the hash grid, steps of Eq. (8), and the rate in Eq. (15):
# $$\tilde f = f + u\,q,\quad u \in [-\tfrac12, \tfrac12),\quad q = 0,\; Q_0,\; Q_0,\; Q_0(1+\tanh\psi_q(h)),\qquad
#   \mathcal{L} = \mathcal{L}_{render} + \lambda\,[\text{stage 4}]\,\mathcal{L}_{rate}.$$

# %%
stages = [paper.stage(iteration) for iteration in (0, 3000, 5000, 10_000)]
assert stages == [1, 2, 3, 4]

# %% [markdown]
# ## By hand
# The paper's synthetic scenes end their stages after 3000, 5000, 10000 and 40000 iterations: they last 3000, 2000, 5000 and
# 30000. Counted from 0, iteration 4999 still belongs to stage 2. Stage 4 has 75 percent of all iterations.

# %%
ends = np.array(paper.stage_ends)
lasts = np.diff(ends, prepend=0)
assert (
    ends.tolist() == [3000, 5000, 10000, 40000]
    and lasts.tolist() == [3000, 2000, 5000, 30000]
    and stages[0] > 0
)
assert (
    (paper.stage(4999), paper.stage(5000)) == (2, 3)
    and 100 * lasts[3] / ends[3] == 75
    and stages[3] == 4
)

# %% [markdown]
# One scalar. A feature $f = 0.7$ wants to be 1, with loss $(\tilde f - 1)^2$ and step $q = 0.4$. Stage 1 sees the loss 0.09. With
# noise, the mean over $u$ is $(f-1)^2 + q^2/12$: the same pull on $f$, and 0.0133 more, which rewards a finer step. Without a
# price the best step would be 0: this is why $q$ may move only once the rate is there, in stage 4.

# %%
f, q = 0.7, 0.4
u = (np.arange(1000) + 0.5) / 1000 - 0.5
mean = lambda f, q: ((f + u * q - 1) ** 2).mean()
assert (
    np.isclose((f - 1) ** 2, 0.09)
    and round(mean(f, q) - 0.09, 4) == 0.0133
    and f == 0.7
    and q == 0.4
)
assert np.isclose((mean(f + 1e-6, q) - mean(f - 1e-6, q)) / 2e-6, 2 * (f - 1)) and mean(
    f, 0
) < mean(f, q)

# %% [markdown]
# ## In code
# `Trainer.fixed()` tells an iteration what is on: `noisy` from stage 2, `moving` from stage 3, `located` (the frozen positions in
# the grid) from stage 4. `Trainer.rate_of(name)` is an array's learning rate, 0 where it does not take part.
# We train the preset `tiny`, cut to 100 anchors and 530 iterations, on balls that bounce.

# %%
scene, changes = (
    load_scene("bouncing"),
    dict(
        anchors=100,
        stage_ends=(60, 90, 330, 530),
        decay_from=90,
        grow_from=20,
        grow_every=20,
        grow_until=260,
        mask_from=330,
    ),
)
trainer = Trainer(scene, choose("tiny", changes), seed=0)
assert trainer.preset.anchors == 100 and trainer.preset.iterations == 530
assert [trainer.preset.stage(i) for i in (0, 60, 90, 330)] == [1, 2, 3, 4]
history, snapshots, moved, saved = [], [], [], []
for end in trainer.preset.stage_ends:
    if trainer.stage == 4:
        trainer.freeze_positions()  # what the first step of stage 4 would do
    stage, rates = trainer.stage, {stem: trainer.rate_of(stem) for stem in LEARNING_RATES}
    before = {name: a.copy() for name, a in trainer.parameters.arrays.items()}
    for step in range(end - trainer.iteration):
        losses, seen, view = trainer.step()
        if (
            step == 1
        ):  # after two steps: in the very first one all offsets are 0, and so is the gradient of log_l
            on = trainer.fixed()._replace(mask=trainer.mask.copy())
            saved.append((stage, Parameters(trainer.parameters.arrays, np.float64), on))
            moved.append(
                {
                    n.split(".")[0]
                    for n, a in trainer.parameters.arrays.items()
                    if not np.array_equal(a, before[n])
                }
            )
            assert moved[-1] == {stem for stem, learning_rate in rates.items() if learning_rate > 0}
        history.append((trainer.iteration, psnr(seen.image, view.image), losses.L_rate))
    snapshots.append(trainer.model())
    print(
        f"stage {stage}: noise {on.noisy!s:5}  time {on.moving!s:5}  rate {on.located is not None!s:5}  rests:",
        *sorted(set(rates) - moved[-1]),
    )
assert (
    [len(names) for names in moved] == [9, 9, 10, 12]
    and "x_a" not in moved[3]
    and "psi_d" in moved[2] - moved[1]
)

# %% [markdown]
# Positions move in stages 1 to 3 and rest in stage 4, because a decoder must find them where the encoder asked the grid.
# That they move at all is a choice of `tiny` (Q14); the paper's presets have the rate 0.

# %%
scores = [evaluate(model, scene)[0]["psnr_db"] for model in snapshots]
assert (
    ["x_a" in names for names in moved] == 3 * [True] + [False]
    and len(moved) == 4
    and paper.lr_x[0] == 0
)
assert 1 < len(scores) and scores[0] < scores[1] < scores[2] < scores[3]
print("test PSNR at the ends of the stages:", " ".join(f"{s:.2f} dB" for s in scores))
iteration, decibel, rate = np.array(history).T
smooth = lambda y, n=15: np.convolve(y, np.ones(n) / n, mode="valid")
figure, (top, low) = plt.subplots(
    2, 1, figsize=(10, 6.4), sharex=True, layout="constrained", height_ratios=(2, 1)
)
for i, (start, end) in enumerate(zip((0, *changes["stage_ends"]), changes["stage_ends"])):
    for ax in (top, low):
        ax.axvspan(start, end, color=("0.93", "0.85")[i % 2], lw=0)
    top.text(
        (start + end) / 2,
        28.2,
        ("1\nstill", "2\nnoise", "3\ntime", "4\nrate")[i],
        ha="center",
        va="top",
        fontsize=13,
    )
top.plot(iteration, decibel, ".", ms=3, color="0.6", label="one training view")
top.plot(iteration[14:], smooth(decibel), color="C0", label="mean of 15")
top.plot(changes["stage_ends"], scores, "D", ms=10, color="C1", ls="none", label="test views")
low.plot(iteration[rate > 0], rate[rate > 0], color="C2")
top.set(
    ylabel="PSNR (dB)",
    ylim=(10, 28.5),
    title="Each stage switches something on; the rate exists only in the last",
)
low.set(xlabel="iteration", ylabel="bits per number", ylim=(0, None))
top.legend(loc="lower right", framealpha=1), top.set_xlim(0, 540)
lessons.show(figure, "17_four_stages_curve")

# %% [markdown]
# What it looks like: before time exists, whatever moves is a smear over all its places. Time sharpens it. The rate should
# cost nothing that can be seen; otherwise $\lambda$ is too large.

# %%
view = max(
    scene.test, key=lambda v: np.abs(snapshots[0].render(v.camera, None) - v.image).mean()
)  # most to gain
times = (None, None, view.time, view.time)
pictures = [model.render(view.camera, time).clip(0, 1) for model, time in zip(snapshots, times)]
errors = [np.abs(picture - view.image).mean() for picture in pictures]
assert errors[2] < 0.7 * errors[1]
figure, panels = plt.subplots(1, 5, figsize=(14, 4.2), layout="constrained")
for ax, picture, title in zip(
    panels, (*pictures, view.image), ("1 still", "2 noise", "3 time", "4 rate", "truth")
):
    ax.imshow(picture), ax.axis("off")
    ax.set_title(title if title == "truth" else f"{title}\n{psnr(picture, view.image):.1f} dB")
figure.suptitle(
    f"Time sharpens what moves: a test view at t = {view.time:.2f}, at the end of each stage",
    fontsize=16,
)
lessons.show(figure, "17_four_stages")

# %% [markdown]
# ## Backward by hand
# One feature, $\tilde f = f + uq$. The first three stages have $dq = 0$: $\bar f = \bar{\tilde f}$, whatever the noise. In the
# last, the same $\tilde f$ is rendered and rated (choice Q23), and $q$ moves, in the noise and in the bin of Eq. (11):
# $$\bar{\tilde f} = \bar{\tilde f}_{render} + \lambda\,\bar{\tilde f}_{rate},\qquad \bar f = \bar{\tilde f},\qquad
#   \bar q = \sum_i u_i\,\bar{\tilde f}_i + \lambda\,\bar q_{rate}.$$

# %% [markdown]
# The sum runs over the numbers that share a step (choice Q6). In `objective.backward` these are the lines
# `noisy_bar = noisy_bar + rate_bar` and `q_bar = ... part["q"] ... + rate_q`. One number tests both: the last bias of
# $\psi_q$ for f. It has a way through the picture, and one through the bits; we measure each by differences.

# %%
exact, rng = SETTINGS["exact"], np.random.default_rng(17)


def losses_at(p, on, noise):
    """All losses and the residual at parameters p, in float64, as stage `on` computes them."""
    networks = {name: p.network(name) for name in trainer.design.layers()}
    return objective.forward(
        p, trainer.design, networks, p.listed("grid"), on._replace(settings=exact), view, noise
    )[::2]


stage, p, on = saved[3]
noise, name = (
    rng.random((len(p["x_a"]), sum(trainer.design.widths))) - 0.5,
    f"psi_q.b{len(trainer.design.context)}",
)
gradient = objective.backward(losses_at(p, on, noise)[1])[0][name][0]


def difference(noise, h=1e-4):
    made = []
    for step in (h, -h):
        p[name][0] += step
        made.append(losses_at(p, on, noise)[0])
        p[name][0] -= step
    return [
        (getattr(made[0], part) - getattr(made[1], part)) / (2 * h)
        for part in ("L_render", "L_rate")
    ]


through_picture, through_bits = difference(noise)
print(
    f"picture {through_picture:+.3e}, bits {on.lambda_rate * through_bits:+.3e}, gradient {gradient:+.3e}"
)
assert abs(through_picture + on.lambda_rate * through_bits - gradient) < 1e-4 * abs(gradient)
assert (
    difference(0 * noise)[0] == 0 and through_bits < 0
)  # no noise: no way through the picture; coarser is cheaper

# %% [markdown]
# Now everything at once: in each stage the gradient against a difference along a random direction. What a stage does not use has
# the gradient 0 in every entry, not only a learning rate of 0. Two gradients differ from the slope on purpose: none flows through
# $\mathcal{E}(x)$ back to x (choice Q10), and signs have no slope, so the grid gets a straight-through one (`09_hash_grid`).
# Whatever a difference would move through these, rests: x_a, O_a, log_l, and in the last stage the grid and $\psi_q$.

# %%
for stage, p, on in saved:
    noise = rng.random((len(p["x_a"]), sum(trainer.design.widths))) - 0.5
    gradients = objective.backward(losses_at(p, on, noise)[1])[0]
    resting = ((), (), ("x_a", "O_a", "log_l"), ("x_a", "O_a", "log_l", "psi_q", "grid"))[stage - 1]
    way = rng.normal(size=p.vector.size) * p.per_element(
        lambda name: name.split(".")[0] not in resting
    )
    origin, made = p.vector.copy(), []
    for step in (1e-7, -1e-7):
        p.vector[:] = origin + step * way
        made.append(losses_at(p, on, noise)[0].L_total)
    p.vector[:] = origin
    slope = (made[0] - made[1]) / 2e-7
    idle = [
        stem
        for stem in ("psi_d", "psi_p", "psi_q", "grid")
        if not any(g.any() for n, g in gradients.arrays.items() if n.split(".")[0] == stem)
    ]
    print(
        f"stage {stage}: by differences {slope:+.6e}, by gradient {gradients.vector @ way:+.6e}, gradient 0:",
        *idle,
    )
    assert abs(slope - gradients.vector @ way) < 1e-5 * abs(slope)
    assert idle == ["psi_d", "psi_p", "psi_q", "grid"][(0, 0, 1, 4)[stage - 1] :]

# %% [markdown]
# ## Break it
# Skip the noise. As trained, the model is even better, and nothing looks wrong. But a file holds rounded numbers, Eq. (10).
# The same 300 iterations on a still scene, without and with noise, once as trained and once rounded to coarse $Q_0$:


# %%
def rounded(model):
    a, Q_0 = model.anchors, model.design.Q_0
    flat = lambda v, Q: rounding.forward(v.reshape(len(v), -1), np.full((len(v), 1), Q))[
        0
    ].f_hat.reshape(v.shape)
    return replace(
        model,
        anchors=a._replace(
            **{n: flat(getattr(a, n), Q) for n, Q in zip(("f_a", "s_a", "l_a", "O_a"), Q_0)}
        ),
    )


quiet, table = load_scene("static"), {}
coarse = dict(
    anchors=80,
    d=8,
    hidden=(16, 16),
    Q_f=1.0,
    Q_s=0.05,
    Q_l=0.05,
    Q_O=0.2,
    decay_from=100,
    grow_from=20,
    grow_every=20,
    grow_until=200,
    mask_from=300,
)
for what, first in (("without noise", 300), ("with noise", 60)):
    model = Trainer(
        quiet, choose("tiny", {**coarse, "stage_ends": (first, 300, 300, 300)}), seed=0
    ).run()
    table[what] = [evaluate(m, quiet)[0]["psnr_db"] for m in (model, rounded(model))]
    print(f"{what:14s} as trained {table[what][0]:.2f} dB, rounded {table[what][1]:.2f} dB")
without, noisy = table.values()
assert without[0] > noisy[0] and without[1] < noisy[1] and coarse["mask_from"] == 300

# %% [markdown]
# What catches it is the habit of scoring what was *decoded*, never the trainer's own model.

# %% [markdown]
# ## What a codec does with it
# An encoder in two passes: the first looks at the scene, the second spends the bits. Nothing before stage 4 knows what a number
# costs; from there on, numbers get cheaper. And the decoder needs none of this: it has no stages.

# %%
in_stage_4 = rate[rate > 0]
data = encode(snapshots[-1])
after = evaluate(decode(data), scene)[0]["psnr_db"]
print(
    f"bits per number: {in_stage_4[0]:.2f} at the start of stage 4, {in_stage_4[-1]:.2f} at its end"
)
print(f"{len(data)} bytes; {scores[3]:.2f} dB as trained, {after:.2f} dB decoded")
assert (
    in_stage_4[-1] < 0.8 * in_stage_4[0]
    and len(in_stage_4) == 200
    and trainer.stage == 4
    and abs(after - scores[3]) < 0.5
)

# %% [markdown]
# ## Exercises
# **17.1** Which percentage of its iterations does the preset `paper_real` spend in stage 3? **17.2** In which stage does each of
# the arrays x_a, f_a, log_s, log_l, O_a, psi_alpha, psi_c, psi_r, psi_s, psi_d, psi_p, psi_q, grid first move, in `tiny`?
# Thirteen numbers. **17.3** Write what the last stage adds: the gradients of all bits for the noisy numbers and the steps.
# `bits` is Eq. (13) plus Eq. (14), without the offsets of masked children; `L_rate` is `bits` over all numbers, masked ones too.

# %%
answer_1 = ...
answer_2 = ...


def my_backward(inputs, cotangents):
    """{"noisy" (A, n), "q" (A, 4)}, from cotangents["bits_bar"] and ["L_rate_bar"], two scalars; use likelihood's backward.

    inputs: "noisy", "mu", "sigma" (A, n), columns f, s, l, O; "q" (A, 4), a step serves a group; "mask" (A, k); "d", "k".
    """
    raise NotImplementedError


real = np.diff((0, *PRESETS["paper_real"].stage_ends))
lessons.number("17.1", answer_1, 100 * real[2] / real.sum())
lessons.number(
    "17.2", answer_2, [min(i + 1 for i in range(4) if stem in moved[i]) for stem in LEARNING_RATES]
)
lessons.backward("17.3", my_backward, "rate_stage", "noisy", "q")
assert len(LEARNING_RATES) == 13 and PRESETS["paper_real"].stage(4000) == 3

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only rate_stage` judges the last stage of a port, `--only context_stage` what goes before.
# What a port gets wrong: it draws the noise twice, once to render and once to rate, or lets $\psi_d$ learn from iteration 0.

# %%
both = (
    lambda **i: rate_forward(**i)[0],
    lambda inputs, bars: rate_backward(rate_forward(**inputs)[1], **bars),
)
verdict = oracle.check(both[0], "rate_stage", both[1])
print(verdict)
assert verdict.ok and trainer.preset.stage(0) == 1
