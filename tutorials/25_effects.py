# %% [markdown]
# # Effects: what a scene calls for, and nothing else
#
# **Promise.** After this you can say which effect needs which part of the method, and show that an
# effect that is not listed costs nothing. **Before it:** `05_positional_encoding_and_deformation`,
# `06_deformed`, `15_compositing`. **Takes** ten seconds on two cores, 20 minutes of reading and
# 35 of exercises.
#
# **Files:** [effects.py](../p4dgs_ref/effects.py),
# [effect_ledger.py](../p4dgs_ref/lab/effect_ledger.py).

# %%
from dataclasses import replace

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures, shared, show, tour

plt = figures.pyplot()
architecture.show("25_effects", "view", "color", "deformation", "deformed", "compositing")

# %% [markdown]
# ## What fails without it
# A model without motion shows every ball at one height, whatever the time is. So why not give every
# model every effect? Because an effect that nothing in the scene needs still has weights in the
# file, and costs work in every frame.
#
# On the left is the trained scene, in the middle the same file without the network that moves it.
# The ten test views fall from 33.48 to 19.84 dB. On the right is the opposite mistake, in bytes:
# anchor 29 and all the others never turn, and yet a head for their rotation would cost 520 bytes.

# %%
import p4dgs_ref as p4
from p4dgs_ref.training.objective import psnr

model = tour.MODEL
listed = [effect for effect in model.design.effects if effect != "translation"]
still = replace(
    model,
    design=replace(model.design, effects=tuple(listed)),
    networks={name: net for name, net in model.networks.items() if name != "psi_d"},
)
views = p4.load_scene("bouncing").test
moving, frozen = (
    np.mean([psnr(one.render(view.camera, view.time), view.image) for view in views])
    for one in (model, still)
)
print(f"with motion {moving:.2f} dB, without it {frozen:.2f} dB")
assert (round(moving, 2), round(frozen, 2)) == (33.48, 19.84)

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
for ax, one, title in zip(axes, (model, still), ("the trained scene", "without its motion")):
    image = show.frame(one, tour.CAMERA, tour.T)
    show.picture(ax, image, tour.CAMERA, **tour.VIEW, title=f"{title}, t = {tour.T}")
axes[2].bar(
    ["translation (listed):\n13,446", "rotation (if listed):\n520"], [13446, 520], color=show.TIME
)
axes[2].set(title="bytes of weights that only it needs")
figures.show(figure, "25_effects_motion")

# %% [markdown]
# ## Claim
# A ball bounces without turning. Why should a network predict its rotation, a file hold the
# weights for it, and every frame wait for their multiplications? But Eq. (6) moves, scales and
# rotates every Gaussian of every scene:
# $$(x', s', r') = (x + \Delta x,\; s + \Delta s,\; r + \Delta r) \tag{6}$$
# If nothing rotates, leave the rotation head out. The opposite mistake is worse: leave $\Delta x$
# out although something moves, and the model shows, at best, the average of all moments. An
# *effect* too many costs parameters, time and bytes. One too few spoils the picture.
#
# Switching an effect off is more than setting it to zero: its network head does not exist, and
# nothing computes it. Still the result must be the same: **an effect that is switched off equals
# an effect with its neutral input**, here $\Delta = 0$. The model has seven effects, each with its
# own part:

# %%
from p4dgs_ref.scenes.scene import MODEL_EFFECTS

needs = {
    "translation": "Δx of ψ_d",
    "rotation": "Δr of ψ_d",
    "scaling": "Δs of ψ_d",
    "view_color": "Eq. (2) as an input of ψ_c",
    "view_geometry": "Eq. (2) as an input of ψ_α, ψ_r, ψ_s",
    "occlusion": "depth order and T_i",
    "background": "a colour behind T_N",
}
assert set(needs) == set(MODEL_EFFECTS)

# %% [markdown]
# ## By hand
# What does a missing head save? We count the parameters of $\psi_d$, the network of Eq. (5), with
# the paper's two layers of 192 units. Its inputs are $E(x)$ with $3\,(1 + 2\cdot 10)$ numbers and
# $E(t)$ with $1 + 2\cdot 6$ numbers, together 76. (These frequencies, $10$ and $6$, are those of
# our preset; the paper does not state them.) The two layers and the three heads together have
# 14784, 37056 and 1930 weights and biases. Only 579 of these are needed by translation and by
# nothing else.

# %%
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import PAPER_SYNTHETIC, choose

inputs = 3 * (1 + 2 * 10) + 1 + 2 * 6
layer_1 = inputs * 192 + 192
layer_2 = 192 * 192 + 192
heads = 192 * (3 + 3 + 4) + (3 + 3 + 4)
head_of_translation = 192 * 3 + 3


def parameters_of_psi_d(effects):
    layers = design_of(PAPER_SYNTHETIC, effects).layers()
    return sum(rows * columns + columns for rows, columns in layers.get("psi_d", ()))


without_translation = [effect for effect in MODEL_EFFECTS if effect != "translation"]
spared = parameters_of_psi_d(MODEL_EFFECTS) - parameters_of_psi_d(without_translation)
assert (layer_1, layer_2, heads) == (14784, 37056, 1930)
assert parameters_of_psi_d(MODEL_EFFECTS) == layer_1 + layer_2 + heads
assert spared == head_of_translation == 579

# %% [markdown]
# In `float16` this is 107540 bytes. If objects only translate, 104838 of them stay; if nothing
# moves, none do. So one motion more or less hardly matters: all three share the first two layers,
# which disappear only with the last motion.

# %%
still = ("view_color", "occlusion", "background")
lists = MODEL_EFFECTS, ("translation", *still), still
assert [2 * parameters_of_psi_d(effects) for effects in lists] == [107540, 104838, 0]

# %% [markdown]
# ## In code
# In this project a scene lists its effects, and `predict` does not call the equations of others.
# We ask which equations one training step calls for two scenes, `static` with two effects and
# `bouncing` with four. Four equations run only for `bouncing`.

# %%
from p4dgs_ref.training.trainer import Trainer
from p4dgs_ref.training.watch import equation_codes, watch_calls


def equations_in(function):
    """Return the equations that a function calls."""
    called = set()
    with watch_calls(equation_codes(), lambda event, mark, *_: called.add(mark[0])):
        function()
    return called


scenes = {name: p4.load_scene(name) for name in ("static", "bouncing")}
called = {}
for name, scene in scenes.items():
    print(name, scene.effects)
    trainer = Trainer(scene, choose("smoke"), seed=0)
    while trainer.stage < 4:
        trainer.step()
    called[name] = equations_in(trainer.step)
assert called["static"] < called["bouncing"]
assert called["bouncing"] - called["static"] == {
    "view",
    "positional_encoding",
    "deformation",
    "deformed",
}

# %% [markdown]
# **Off is neutral.** We take the file of a model with all effects, set the three heads of $\psi_d$
# to zero, and compare it with the same model without motion. Positions and scales agree to the last
# bit. Quaternions agree except for their last digits, because one of the two models divides them by
# their length, 1, once more.

# %%
from p4dgs_ref import effects as fx
from p4dgs_ref.oracle.streams import STREAMS

full = p4.decode((STREAMS / "full.p4dgs").read_bytes())
assert set(fx.MOTION) <= set(full.design.effects)
weights, biases = full.networks["psi_d"]


def with_zero_heads(arrays):
    return [*arrays[:-3], *(0 * head for head in arrays[-3:])]


zero_psi_d = (with_zero_heads(weights), with_zero_heads(biases))
neutral = replace(full, networks={**full.networks, "psi_d": zero_psi_d})
without_motion = [effect for effect in full.design.effects if effect not in fx.MOTION]
other_networks = {name: net for name, net in full.networks.items() if name != "psi_d"}
absent = replace(
    full,
    design=replace(full.design, effects=tuple(without_motion)),
    networks=other_networks,
)
camera = scenes["bouncing"].test[0].camera
one = neutral.gaussians(0.3, camera)
other = absent.gaussians(0.3, camera)
for name in ("x", "s", "alpha", "color"):
    assert np.array_equal(getattr(one, name), getattr(other, name))
assert np.abs(one.r - other.r).max() < 4 * np.finfo(float).eps

# %% [markdown]
# **Occlusion** has no neutral input. Without it nothing hides anything: the transmittance $T_i$ is
# 1 everywhere, and splats and background add up like lamps, $C = \sum_i \alpha_i c_i + c_{bg}$.
# Over black, and where no splat is in front of another, the picture is the same. Where two white
# splats of opacity 0.5 overlap, it is 1.0 instead of 0.75.

# %%
from p4dgs_ref.splatting import compositing

pair = dict(
    mean2d=np.zeros((2, 2)),
    conic=np.zeros((2, 3)),
    alpha=np.full(2, 0.5),
    color=np.ones((2, 3)),
    depth=np.arange(2.0),
    visible=np.ones(2, bool),
    background=np.zeros(3),
    height=1,
    width=1,
)
alone = {**pair, "visible": np.array([True, False])}


def seen(splats, occlusion):
    (image, transmittance), _ = compositing.forward(**splats, occlusion=occlusion)
    return image[0, 0, 0], transmittance[0, 0]


assert (seen(pair, True)[0], seen(pair, False)) == (0.75, (1.0, 1.0))
assert seen(alone, True)[0] == seen(alone, False)[0]

# %% [markdown]
# ## Backward by hand
# Is a head of zeros as good as no head? In the forward pass, yes. In the backward pass, no. For
# $\Delta x = yW + b$ with $W = 0$, $b = 0$ and $y$ from the layers before it,
# $$\bar W = y^T\,\overline{\Delta x} \ne 0, \quad \bar b = \textstyle\sum\overline{\Delta x} \ne 0,
#   \quad \bar y = \overline{\Delta x}\,W^T = 0.$$
# The head begins to learn in the first step, and the layers before it in the second. Zeros are only
# a *starting point*; a head that does not exist stays away.

# %%
from p4dgs_ref.equations import deformation, deformed, positional_encoding
from p4dgs_ref.lab.random_inputs import random_field

rng = np.random.default_rng(25)
field = random_field(rng, 2, 1, 6, 5)
field["weights"][-3] = np.zeros((5, 3))
field["biases"][-3] = np.zeros(3)
x = rng.normal(size=(7, 3))
bar = rng.normal(size=(7, 3))
(delta_x, _, _), saved = deformation.forward(x, 0.3, **field)
bars = deformation.backward(saved, bar, np.zeros((7, 3)), np.zeros((7, 4)))

E_x, _ = positional_encoding.forward(x, field["L_x"])
E_t, _ = positional_encoding.forward(np.full((7, 1), 0.3), field["L_t"])
y = np.concatenate([E_x, E_t], axis=1)
for W, b in zip(field["weights"][:-3], field["biases"][:-3]):
    y = np.maximum(y @ W + b, 0)
assert not delta_x.any()
assert bars["weights"][-3].any()
assert np.allclose(bars["weights"][-3], y.T @ bar, rtol=1e-12)
assert np.allclose(bars["biases"][-3], bar.sum(axis=0), rtol=1e-12)
assert not any(layer.any() for layer in bars["weights"][:-3])

# %% [markdown]
# A missing head has the *width* zero. Its weights and their gradient have the shape `(h, 0)`, so
# every product above is empty, and no line of code treats this as a special case.

# %%
none = random_field(rng, 2, 1, 6, 5, heads=(3, 0, 4))
delta, saved = deformation.forward(x, 0.3, **none)
bars = deformation.backward(saved, bar, np.zeros((7, 0)), np.zeros((7, 4)))
assert (delta[1].shape, bars["weights"][-2].shape) == ((7, 0), (5, 0))
(_, s_t, _), _ = deformed.forward(x, x, rng.normal(size=(7, 4)), *delta)
assert np.array_equal(s_t, x)

# %% [markdown]
# ## Break it
# Switch motion off the lazy way: set the weights to zero and leave the network in place. All
# pictures are right, so tests that compare pictures pass. But all the work is still done, and the
# file contains the zeros. We notice it by watching calls and listing the parts of the file.

# %%
from p4dgs_ref.lab.effect_ledger import network_work
from p4dgs_ref.report.inspect import components

wasted = equations_in(lambda: neutral.gaussians(0.3, camera))
spared = equations_in(lambda: absent.gaussians(0.3, camera))
count = len(neutral.gaussians(0.3, camera).alpha)
of_zeros, of_none = (network_work(one.design, one.count, count) for one in (neutral, absent))
bytes_of_zeros = components(p4.encode(neutral))["deformation_mlp"]
print(
    f"multiply-adds {sum(of_zeros[effect] for effect in fx.MOTION):,}, "
    f"bytes of psi_d {bytes_of_zeros:,}"
)
for effect in fx.MOTION:
    assert of_zeros[effect] > 0 == of_none[effect]
assert "deformation" in wasted - spared
assert components(p4.encode(absent)).get("deformation_mlp", 0) == 0 < bytes_of_zeros

# %% [markdown]
# ## What a codec does with it
# A video codec has *tools*. The header of a stream says which of them the stream does not use, and
# the decoder neither reads nor computes those. Here the header lists the effects. A **ledger**
# counts what each one costs (`p4dgs-ref effects static`): an untrained model draws the test views,
# and so does, for each effect that is not listed, a second model to which this effect is added.

# %%
from p4dgs_ref.lab import effect_ledger

ledger = effect_ledger.of_scene(scenes["static"])
rows = ledger["effects"]
print(effect_ledger.to_text(ledger))
for row in rows:
    work, size = (row.get(f"if_{kind}", row[kind]) for kind in ("work", "bytes"))
    assert (row["work"] > 0) == row["listed"] and work > 0
    assert (size > 0) == (row["effect"] not in ("occlusion", "background"))
assert {"view", "positional_encoding", "deformation", "deformed"} == set(ledger["never_called"])

# %% [markdown]
# Motion and view effects have *weights*, which take bytes. Occlusion and background have none, but
# occlusion is *work*, because it needs a transmittance for every Gaussian at every pixel. An
# untrained model draws larger splats than a trained one, so occlusion becomes less work: for
# `bouncing` it takes 1,715,021 multiply-adds per frame before the training, and 486,874 in the
# demo's file.

# %%
counted = effect_ledger.costs(model, [(view.camera, view.time) for view in views])[0]
untrained = effect_ledger.of_scene(p4.load_scene("bouncing"))["effects"]
work = {row["effect"]: row["work"] for row in untrained}
assert (work["occlusion"], counted["occlusion"]["work"]) == (1_715_021, 486_874)

# %%
effects = [row["effect"] for row in rows]
faces = [figures.COLORS[0 if row["listed"] else 4] for row in rows]
hatches = ["" if row["listed"] else "//" for row in rows]
columns = {
    "work (thousand multiply-adds of a frame)": [
        row.get("if_work", row["work"]) / 1000 for row in rows
    ],
    "weights in the file (bytes)": [row.get("if_bytes", row["bytes"]) for row in rows],
}
figure, axes = plt.subplots(1, 2, figsize=(14, 5.4), sharey=True, layout="constrained")
for panel, (label, values) in zip(axes, columns.items()):
    bars = panel.barh(effects, values, edgecolor="k", color=faces, hatch=hatches)
    panel.bar_label(bars, [f"{v:,.0f}" for v in values], padding=4, fontsize=13)
    panel.set_xlim(0, 1.25 * max(values))
    panel.set_xlabel(label)
axes[0].invert_yaxis()
axes[1].text(2000, 5.5, "listed by the scene", color=figures.COLORS[0], va="center", fontsize=14)
axes[1].text(2000, 3.5, "not listed: what it would cost", color=figures.COLORS[4], fontsize=14)
figures.show(
    figure,
    "25_effects",
    title="The scene `static`: what its two effects cost, and what each of five others would add",
    size=18,
)

# %% [markdown]
# Who writes the list? A person does, or a program that looks at the pictures (`p4dgs-ref effects
# SCENE --suggest`). Does anything move? The program trains twice, briefly: once with the true times
# of the views, and once with the same times shuffled among the views. If nothing moves, both models
# predict new views equally well. If something moves, the true times win. (The `±` below is one
# standard error, over the views.) Where the pictures cannot decide, the program lists the effect,
# because one too few is worse than one too many.

# %%
from p4dgs_ref.lab.suggest import gains_by_view, verdict

evidence = {}
for name, scene in scenes.items():
    gains = gains_by_view((scene, fx.MOTION, "translation", 0, 300))  # dB by true times, each view
    evidence[name], reason = verdict("translation", [gains], len(scene.train))
    print(f"{name}: translation? {evidence[name]}: {reason}")
assert evidence == {"static": "no", "bouncing": "yes"}

# %% [markdown]
# ## What this idea buys
# What is an effect worth? Only trainings with it and without it can tell. A
# [record](experiments/README.md#how-long-to-train-and-what-effects-gain) has trainings of
# `bouncing` with one effect switched on or off, three seeds each. Here a `±` is twice the standard
# error over the seeds; a gain below it counts as none. Motion gains 13 dB for 13,446 bytes of
# weights. Rotation, scaling and `view_geometry`, which the scene does not list, show no gain with
# three seeds, and cost bytes in every file. Without occlusion or background, most trainings *draw
# nothing*: their PSNR is that of an empty page, 10.86 dB. How many dB these two effects are worth
# cannot be said from that.
#
# The paper has no such switches; its scenes move, turn and shine, and all of Eqs. (2) to (6) are
# always computed.

# %%
from p4dgs_ref.lab.writer import read_csv, text_table
from tutorials.experiments.tables import effects as gains

record = read_csv(shared.FOLDER / "experiments" / "records" / "effects.csv")
empty = gains.psnr_of_nothing(p4.load_scene("bouncing"))
summaries = list(gains.summaries(record, empty))
print("\n".join(text_table(gains.COLUMNS, summaries)))
said = {row["label"]: row["gain"] for row in summaries}
assert said["without translation"].startswith("-13.")
assert all(said[f"with {effect}"].startswith("none") for effect in ("rotation", "scaling"))
assert said["with view_geometry"].startswith("none")
assert said["without occlusion"] == "draws nothing (3 of 3)"
assert round(empty, 2) == 10.86

# %% [markdown]
# **In short**
# - A scene lists its effects; what is not listed has no weights and costs no time.
# - Switched off means that the code does not run, not that its numbers are zero.
# - One effect too few spoils the picture, one too many costs bytes and work.
#
# **Often misunderstood**
# - *A head of zeros is the same as no head.* Its pictures are the same; its bytes, its work and its
#   gradients are not.
# - *Occlusion is worth 22.8 dB.* This is the difference from an empty page: without occlusion these
#   trainings draw nothing.
# - *Leaving an effect out changes what the other equations return.* They return the same numbers.

# %% [markdown]
# ## Exercises
# **25.1** ● Nothing in a scene rotates. How many parameters fewer does the paper's $\psi_d$ have?
#
# **25.2** ●● Write Eqs. (5) and (6) together, for heads that may have the width zero. Here
# $E(p) = (p, \sin 2^0p, \cos 2^0p, \sin 2^1p, \dots)$ with $L$ pairs, each of the whole vector,
# and there is a ReLU between the layers. If there is a $\Delta r$, then
# $r' = (r + \Delta r)/\sqrt{\|r + \Delta r\|^2 + 10^{-24}}$; otherwise $r' = r$. For example, if
# all weights are $0$ and the bias of $\Delta x$ is $(1, 0, 0)$, then $x = (0, 2, 0)$ gives
# $x' = (1, 2, 0)$.
#
# **25.3** ●● Write the backward of Eq. (3') for colours, with or without a view. With
# $y = \psi_c(f_a, \delta_{vc}, d_{vc})$ of the shape $(A, 3k)$, the colour is
# $c = \mathrm{sigmoid}(y)$, as in `04_color_rotation_scale`. You may use `equations.mlp`;
# `mlp.backward(saved, y_bar)` returns the gradients of `x`, `weights` and `biases`. Where
# $y = 0$, $\bar y = \bar c/4$. For large $y$, write $1 - c$ as a sigmoid.
#
# **Predict, then run.** A scene has no effect at all. How many parameters does $\psi_d$ have, and
# how many inputs does $\psi_c$ read?

# %%
answer_1 = ...


def my_motion(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    """Return x_t, s_t and r_t.

    The last three weights are the heads; their shapes are (h, 3 or 0), (h, 3 or 0) and (h, 4 or 0).
    """
    raise NotImplementedError


def my_color_backward(inputs, cotangents):
    """Return {"f_a", "delta_vc", "d_vc", "weights", "biases"}.

    The cotangent is cotangents["color_bar"] (A, k, 3).
    """
    raise NotImplementedError


lessons.check_number("25.1", answer_1)
lessons.check_forward("25.2", my_motion, "temporal_prediction")
lessons.check_backward("25.3", my_color_backward, "color")

# %% [markdown]
# ## Check your port
# Run `p4dgs-ref oracle check DIR --only temporal_prediction` and `--only color`; some of their
# cases have fewer effects. A typical mistake of ports is to expect the columns of an absent head
# in the file, so that all weights after it are read from the wrong place.


# %%
def port(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    delta, _ = deformation.forward(x, t, psi_d_weights, psi_d_biases, L_x, L_t)
    return deformed.forward(x, s, r, *delta)[0]


lessons.passes("temporal_prediction", port=port)
lessons.passes("color")
