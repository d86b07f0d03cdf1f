# %% [markdown]
# # Effects: what a scene calls for, and nothing else
#
# **Promise.** After this you can say which effect needs which part of the method, and show that an absent one costs nothing.
# **Before it:** `05_positional_encoding_and_deformation`, `06_deformed`, `15_compositing`.
# **Takes** seven seconds on two cores, half an hour of yours.

# %%
from dataclasses import replace

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref import effects as fx
from p4dgs_ref import oracle
from p4dgs_ref.codec.inspect import components
from p4dgs_ref.equations import color, deformation, deformed
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import compositing
from p4dgs_ref.studies.effect_ledger import describe, ledger
from p4dgs_ref.studies.effect_work import counted
from p4dgs_ref.studies.random_inputs import sample_model
from p4dgs_ref.studies.suggest import suggest
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import PAPER_SYNTHETIC, choose
from p4dgs_ref.training.trainer import Trainer

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# Every scene pays for what the most complicated one needs, unless it says what happens in it. Here it does: a list of effects,
# and what is not listed is not simulated. Take Eq. (6):
# $$(x', s', r') = (x + \Delta x,\; s + \Delta s,\; r + \Delta r) \tag{6}$$

# %% [markdown]
# Nothing scales? Then there is no $\Delta s$: no head of $\psi_d$, no bytes, no addition. *Absent* is stronger than zero, but
# must look like it: **switched off equals fed with its neutral input**, $\Delta = 0$. The model has seven effects.

# %%
needs = {
    "translation": "Δx of ψ_d",
    "rotation": "Δr of ψ_d",
    "scaling": "Δs of ψ_d",
    "view_color": "Eq. (2) into ψ_c",
    "view_geometry": "Eq. (2) into ψ_α, ψ_r, ψ_s",
    "occlusion": "depth order and T_i",
    "background": "a colour behind T_N",
}
assert len(MODEL_EFFECTS) == 7 and set(needs) == set(MODEL_EFFECTS)
for effect in MODEL_EFFECTS:
    print(f"{effect:14s} {needs[effect]}")

# %% [markdown]
# ## By hand
# How large is $\psi_d$ with the paper's two layers of 192? The inputs are $E(x)$, $3\,(1 + 2\cdot 10)$ numbers, and $E(t)$,
# $1 + 2\cdot 6$: 76 (the paper leaves the frequencies, $10$ and $6$, open; this project's preset sets them). Weights and biases
# of the two layers and of the three heads together: 14784, 37056 and 1930. Of these, translation alone needs 579 that nothing
# else does.

# %%
inputs = 3 * (1 + 2 * 10) + 1 + 2 * 6
layers = [inputs * 192 + 192, 192 * 192 + 192, 192 * (3 + 3 + 4) + (3 + 3 + 4)]
assert inputs == 76 and layers == [14784, 37056, 1930] and 192 * 3 + 3 == 579
count = lambda effects: sum(
    i * o + o for i, o in design_of(PAPER_SYNTHETIC, effects).layers().get("psi_d", ())
)
assert count(MODEL_EFFECTS) == sum(layers)

# %% [markdown]
# In `float16` that is 107540 bytes. A scene that only translates keeps 104838 of them, one that rests none. So the three motions
# are not worth much one by one: they share the trunk, and it goes with the last of them.

# %%
still = ("view_color", "occlusion", "background")
lists = {"all": MODEL_EFFECTS, "moves": ("translation", *still), "rests": still}
sizes = {name: 2 * count(effects) for name, effects in lists.items()}
assert sizes == {"all": 107540, "moves": 104838, "rests": 0}

# %% [markdown]
# ## In code
# What does a step of training call? Count it, on two scenes: `static`, with two effects, and `bouncing`, with four. Four
# equations occur in one and not in the other. `predict` does not call them, that is all.

# %%
scenes = {name: p4.load_scene(name) for name in ("static", "bouncing")}
print({name: scene.effects for name, scene in scenes.items()})
assert [len(scene.effects) for scene in scenes.values()] == [2, 4]
work = {}
for name, scene in scenes.items():
    trainer = Trainer(scene, choose("smoke"), seed=0)
    while trainer.stage < 4:
        trainer.step()
    with counted() as work[name]:
        trainer.step()
called = {name: {key for key, _ in found.calls} for name, found in work.items()}
assert called["bouncing"] - called["static"] == {
    "view",
    "positional_encoding",
    "deformation",
    "deformed",
}
assert len(called["bouncing"] - called["static"]) == 4 and called["static"] < called["bouncing"]
assert work["static"].of("translation") == 0 < work["bouncing"].of("translation")

# %% [markdown]
# **Off is neutral.** A model with all effects, its three heads set to zero, beside the same model without any motion. Places and
# scales agree to the bit; quaternions within the last digits, for one of them was divided by its length, 1, once more.

# %%
full = sample_model(5, 24)
assert {"translation", "rotation", "scaling"} <= set(full.design.effects)
weights, biases = full.networks["psi_d"]
rest = lambda arrays: [*arrays[:-3], *(0 * a for a in arrays[-3:])]
neutral = replace(full, networks={**full.networks, "psi_d": (rest(weights), rest(biases))})
less = tuple(effect for effect in full.design.effects if effect not in fx.MOTION)
absent = replace(
    full,
    design=full.design._replace(effects=less),
    networks={name: net for name, net in full.networks.items() if name != "psi_d"},
)
camera = scenes["bouncing"].test[0].camera
one, other = (model.gaussians(0.3, camera) for model in (neutral, absent))
assert all(
    np.array_equal(getattr(one, name), getattr(other, name))
    for name in ("x", "s", "alpha", "color")
)
assert 0 <= np.abs(one.r - other.r).max() < 4 * np.finfo(float).eps and len(one.x) > 1

# %% [markdown]
# **Occlusion** has no input to be neutral; what goes is $T_i$: it is 1 everywhere. Splats and background add up like lamps,
# $C = \sum_i \alpha_i c_i + c_{bg}$. Over black, where no splat stands before another, this is the same picture; where two white
# ones of opacity 0.5 do, it is 1.0 instead of 0.75.

# %%
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
with_it, without = (
    compositing.forward(**pair, occlusion=on)[0].image[0, 0, 0] for on in (True, False)
)
assert (pair["alpha"] == 0.5).all() and with_it == 0.75 and without == 1.0
alone = {**pair, "visible": np.array([True, False])}
assert np.array_equal(
    *(compositing.forward(**alone, occlusion=on)[0].image for on in (True, False))
)
assert np.all(compositing.forward(**pair, occlusion=False)[0].transmittance == 1)

# %% [markdown]
# ## Backward by hand
# Is a zero head as good as none? Forward, yes. Backward, no. $\Delta x = yW + b$ with $W = 0$, $b = 0$, $y$ from the trunk:
# $$\bar W = y^T\,\overline{\Delta x} \ne 0, \quad \bar b = \textstyle\sum\overline{\Delta x} \ne 0,
#   \quad \bar y = \overline{\Delta x}\,W^T = 0.$$
# The head starts to learn in the first step, the trunk in the second. A zero is a *starting point*; only absence is a decision.

# %%
rng = np.random.default_rng(25)
field = deformation.random_field(rng, 2, 1, 6, 5)
field["weights"][-3], field["biases"][-3] = np.zeros((5, 3)), np.zeros(3)
x, bar = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
delta, res = deformation.forward(x, 0.3, **field)
bars = deformation.backward(res, delta_x_bar=bar)
y = np.maximum(res.mlp.inputs[-1], 0)  # what the head reads
assert not delta.delta_x.any() and np.allclose(bars["weights"][-3], y.T @ bar, rtol=1e-12)
assert (
    np.allclose(bars["biases"][-3], bar.sum(axis=0), rtol=1e-12)
    and np.abs(bars["weights"][-3]).max() > 0
)
assert not any(a.any() for a in bars["weights"][:-3])  # the trunk: nothing yet

# %% [markdown]
# An absent head has zero *width*: its array is `(h, 0)`, its gradient too, and every product above is empty without a special
# case.

# %%
none = deformation.random_field(rng, 2, 1, 6, 5, heads=(3, 0, 4))
delta, res = deformation.forward(x, 0.3, **none)
assert delta.delta_s.shape == (7, 0) and deformation.backward(res, delta_x_bar=bar)["weights"][
    -2
].shape == (5, 0)
assert np.array_equal(deformed.forward(x, x, rng.normal(size=(7, 4)), *delta)[0].s_t, x)

# %% [markdown]
# ## Break it
# Switch motion off by zero weights and leave the network in. Pictures are right to the last digit, tests of pictures pass. The
# work is done all the same, and the file carries the zeros. What catches it: count calls, and read the file's ledger.

# %%
with counted() as wasted:
    neutral.gaussians(0.3, camera)
with counted() as spared:
    absent.gaussians(0.3, camera)
paid = [components(p4.encode(model)).get("deformation_mlp", 0) for model in (neutral, absent)]
print(
    f"multiply-adds {sum(wasted.of(e) for e in fx.MOTION):,.0f} and {sum(spared.of(e) for e in fx.MOTION):,.0f}; "
    f"bytes of psi_d {paid[0]:,} and {paid[1]:,}"
)
assert all(wasted.of(e) > 0 == spared.of(e) for e in fx.MOTION) and paid[0] > 0 == paid[1]
assert ("deformation", "forward") in wasted.calls and ("deformation", "forward") not in spared.calls

# %% [markdown]
# ## What a codec does with it
# A video codec has *profiles* and *tools*: what a stream does not use, its header switches off, and the decoder neither reads nor
# computes it. Here the header lists effects. The **ledger** trains one build as listed and, for each effect, a twin in which that
# effect alone is switched the other way.

# %%
rows = ledger(scenes["static"], "smoke", seed=0, share=1, stage_ends=(15, 25, 100, 150))
print(describe(rows))
of = {row["effect"]: row for row in rows}
assert all(row["work_off"] == row["bytes_off"] == 0 for row in rows)
assert all(
    of[effect]["work_on"] > 0 and of[effect]["bytes_on"] > 0
    for effect in (*fx.MOTION, "view_color", "view_geometry")
)
assert all(
    of[effect]["bytes_on"] == 0 < of[effect]["work_on"] for effect in ("occlusion", "background")
)

# %% [markdown]
# Two kinds of cost. Motion and view own *weights*: bytes. Occlusion and background own none, and occlusion is more *work* than
# all other effects together: it is the transmittance at every pair of Gaussian and pixel. Decibels of so short a training are
# worth little, except where they are large.

# %%
assert of["occlusion"]["work_on"] > sum(
    of[effect]["work_on"] for effect in MODEL_EFFECTS if effect != "occlusion"
)
assert of["occlusion"]["psnr_lost_when_off"] > 0.5

figure, axes = plt.subplots(1, 3, figsize=(16, 5.4), sharey=True, layout="constrained")
worth = [
    row["psnr_lost_when_off"] if row["called_for"] else row["psnr_gained_when_forced"]
    for row in rows
]
panels = (
    ("work (thousand multiply-adds a step)", [row["work_on"] / 1000 for row in rows], "{:,.0f}"),
    ("weights in the file (bytes)", [row["bytes_on"] for row in rows], "{:,.0f}"),
    ("PSNR with it, less without (dB)", worth, "{:+.2f}"),
)
for panel, (label, values, form) in zip(axes, panels):
    bars_ = panel.barh(
        [row["effect"] for row in rows],
        values,
        edgecolor="k",
        color=[lessons.COLORS[0 if row["called_for"] else 4] for row in rows],
        hatch=["" if row["called_for"] else "//" for row in rows],
    )
    panel.bar_label(bars_, [form.format(v) for v in values], padding=4, fontsize=13)
    low, high = min(0, *values), max(values)
    panel.set_xlim(low - 0.35 * (high - low) * (low < 0), high + 0.25 * (high - low))
    (
        panel.set_xlabel(label, fontsize=14),
        panel.tick_params(labelsize=13),
        panel.axvline(0, color="k", lw=0.8),
    )
axes[0].invert_yaxis()
figure.legend(
    [
        plt.Rectangle((0, 0), 1, 1, fc=lessons.COLORS[i], ec="k", hatch=h)
        for i, h in ((0, ""), (4, "//"))
    ],
    ["the scene calls for it", "forced on"],
    loc="outside lower center",
    ncols=2,
    fontsize=14,
)
figure.suptitle(
    "The scene `static`: what its two effects cost, and what five others would", fontsize=18
)
lessons.show(figure, "25_effects")

# %% [markdown]
# Who writes the list? A person, or the pictures: the silhouettes of `static` fit one still shape, those of `bouncing` contradict
# each other. What pictures cannot tell is kept, for an effect too many costs bytes, and one too few costs the truth.

# %%
evidence = {name: {row["effect"]: row for row in suggest(scene)} for name, scene in scenes.items()}
for name, found in evidence.items():
    print(f"{name}: translation? {found['translation']['evidence']}")
assert (
    not evidence["static"]["translation"]["called_for"]
    and evidence["bouncing"]["translation"]["called_for"]
)

# %% [markdown]
# ## Exercises
# **25.1** Nothing in a scene turns. How many numbers does the paper's $\psi_d$ lose? **25.2** Write Eqs. (5) and (6) together,
# with heads of zero width. **25.3** Write the backward of Eq. (3') for colours, with or without a view (`equations.mlp` may be
# used): $y = \psi_c(f_a, \delta_{vc}, d_{vc})$, $(A, 3k)$, and $c = \mathrm{sigmoid}(y)$, as in `04_color_rotation_scale`.

# %% [markdown]
# For exercise 25.2: $E(p) = (p, \sin 2^0p, \cos 2^0p, \sin 2^1p, \dots)$ with $L$ pairs, each of the whole vector; ReLU between
# layers. Where $r$ changes, $r' = (r + \Delta r)/\sqrt{\|r + \Delta r\|^2 + 10^{-24}}$; else it stays as it is. With weights of
# $0$ and $\Delta x$'s bias $(1, 0, 0)$, $x = (0, 2, 0)$ gives $x' = (1, 2, 0)$. For exercise 25.3: where $y = 0$,
# $\bar y = \bar c/4$; for large $y$ write $1 - c$ as a sigmoid. `mlp.backward(res, y_bar)` gives `x`, `weights`, `biases`.

# %%
answer_1 = ...


def my_motion(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    """Trunk, then heads (h, 3 or 0), (h, 3 or 0), (h, 4 or 0) -> x_t, s_t, r_t."""
    raise NotImplementedError


def my_color_backward(inputs, cotangents):
    """{"f_a", "delta_vc", "d_vc", "weights", "biases"}: gradients, from cotangents["color_bar"] (A, k, 3)."""
    raise NotImplementedError


turns = [count([e for e in MODEL_EFFECTS if e != "rotation"]), count(MODEL_EFFECTS)]
lessons.number("25.1", answer_1, turns[1] - turns[0])
lessons.forward("25.2", my_motion, "temporal_prediction")
lessons.backward("25.3", my_color_backward, "color")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only temporal_prediction`, `--only color`: cases with fewer effects are among them. What a port
# gets wrong: an absent head's columns stay in, so that every weight behind them is read one place too far on.


# %%
def port(x, s, r, t, L_x, L_t, psi_d_weights, psi_d_biases):
    return deformed.forward(
        x, s, r, *deformation.forward(x, t, psi_d_weights, psi_d_biases, L_x, L_t)[0]
    )[0]


print(oracle.check(port, "temporal_prediction"))
assert (
    oracle.check(port, "temporal_prediction").ok
    and oracle.check(lambda **i: color.forward(**i)[0], "color").ok
)
