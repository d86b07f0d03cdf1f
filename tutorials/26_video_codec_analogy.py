# %% [markdown]
# # P-4DGS as a video codec: intra, inter, and what they save
#
# **Promise.** After this you can name the parts of P-4DGS in a video engineer's words, and have weighed inter against intra.
# **Before it:** `06_deformed`, `16_pipeline_by_hand`, `19_file_byte_by_byte`.
# **Takes** ten seconds on two cores, an hour of yours.

# %%
import json

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref import oracle
from p4dgs_ref.codec.inspect import components
from p4dgs_ref.equations import deformation
from p4dgs_ref.model import predict, predict_backward
from p4dgs_ref.scenes.dnerf import packaged_folder
from p4dgs_ref.scenes.simulator.description import describe
from p4dgs_ref.scenes.simulator.simulate import place_cameras
from p4dgs_ref.scenes.simulator.trace import trace
from p4dgs_ref.school import lessons
from p4dgs_ref.studies.accuracy import fits
from p4dgs_ref.studies.evaluate import decibel, evaluate, squared_error
from p4dgs_ref.studies.random_inputs import sample_model

plt = lessons.pyplot()

# %% [markdown]
# ## Claim
# Frames repeat themselves. A video codec does not store what it can predict: from the same frame (*intra*), from another frame
# and motion vectors (*inter*); what remains is coded with few bits, given its context. P-4DGS does the same to Gaussians:

# %% [markdown]
# | video codec | P-4DGS | equations |
# |---|---|---|
# | intra prediction from neighbouring blocks | an anchor predicts its $k$ Gaussians | $(1)$ to $(4)$ |
# | reference frame; motion vectors, compensation | canonical space; $\psi_d$, $x + \Delta x$ | $(5)$, $(6)$ |

# %% [markdown]
# | video codec | P-4DGS | equations |
# |---|---|---|
# | quantiser with a step per block; CABAC's contexts | $q$ per anchor; $\mu, \sigma$ from the hash grid | $(7)$ to $(14)$ |
# | rate-distortion optimisation | training | $(15)$ to $(17)$ |

# %% [markdown]
# So in the sum over $T$ frames the large term occurs once. Where the motion model is smaller than $T-1$ frames, inter wins:
# $$R_{intra} = \sum_{t=1}^{T} R_t \approx T\,R_1 \qquad\text{against}\qquad R_{inter} = R_1 + R_{\psi_d}.$$

# %% [markdown]
# ## By hand
# A video of 4 frames, one row of 8 pixels of 8 bits, in which everything moves on by one pixel a frame (round the end). Pixel by
# pixel: 256 bits. With one frame stored, and for each of the other 3 a motion vector of 4 bits, 76: not a pixel is coded again.

# %%
row = np.array([0, 0, 90, 200, 90, 0, 0, 0])
video = [np.roll(row, t) for t in range(4)]
assert len(video) == 4 and len(row) == 8 and 4 * 8 * 8 == 256 and 8 * 8 + 3 * 4 == 76
search = lambda reference, frame: min(
    range(-8, 8), key=lambda v: (np.abs(np.roll(reference, v) - frame).sum(), abs(v))
)
vectors = [search(video[0], frame) for frame in video[1:]]
assert vectors == [1, 2, 3] and all(-8 <= v < 8 for v in vectors) and 2**4 == 16
assert all(np.array_equal(np.roll(video[0], v), frame) for v, frame in zip(vectors, video[1:]))

# %% [markdown]
# ## In code
# The experiment, in three dimensions. The packaged scene `bouncing`, drawn anew at $32\times 32$ pixels: 4 moments, each seen by
# the same 12 cameras for training and 3 for testing. A *frame* here is what the 3D scene is at one moment.

# %%
given = json.loads((packaged_folder() / "bouncing" / "scene.json").read_text(encoding="utf-8"))
given |= {"resolution": [32, 32], "lens": {"fl_x": 42.8, "fl_y": 42.8, "cx": 16, "cy": 16}}
given["cameras"] |= {"train": 12, "test": 3}
drawing, times, still = (
    describe(given),
    [0.0, 1 / 3, 2 / 3, 1.0],
    ("view_color", "occlusion", "background"),
)
cameras = [
    (camera, split == "test")
    for split in ("train", "test")
    for camera, _ in place_cameras(drawing, split)
]
pictures = {t: [trace(drawing, camera, t) for camera, _ in cameras] for t in times}
assert (
    len(times) == 4
    and sum(not held for _, held in cameras) == 12
    and sum(held for _, held in cameras) == 3
)


def clip(moments, moves):
    """A scene of some moments; one that does not move knows no time."""
    shots = [
        (image, camera, t if moves else 0.0, held)
        for t in moments
        for image, (camera, held) in zip(pictures[t], cameras)
    ]
    images, seen_by, when, held = zip(*shots)
    return p4.Scene.from_arrays(
        images,
        seen_by,
        when,
        test=np.flatnonzero(held).tolist(),
        effects=still + ("translation",) * moves,
    )


# %% [markdown]
# **Intra**: a static model for each frame. **Inter**: one model of all, with $\psi_d$. Each of the five is trained for 400 steps,
# with as many anchors and the same networks, so intra has four times the training. Files are real, and decoded before they are
# judged.

# %%
sizes = dict(
    anchors=80,
    d=6,
    hidden=(8, 8),
    deformation=(32, 32),
    context=(8, 8),
    grid_3d=(4,),
    grid_2d=(8,),
    F=1,
)


def build(scene, steps):
    """Train, write the file, read it again."""
    data = p4.encode(fits.train(scene, fits.reduced(steps, **sizes)).model)
    return p4.decode(data), data


frames, whole = [clip([t], False) for t in times], clip(times, True)
intra, inter = [build(frame, 400) for frame in frames], build(whole, 400)
assert (
    len(intra) + 1 == 5
    and fits.reduced(400).iterations == 400
    and all(
        model.design.layers()["psi_c"] == inter[0].design.layers()["psi_c"] for model, _ in intra
    )
)
bytes_intra, bytes_inter = [len(data) for _, data in intra], len(inter[1])
quality = {
    "intra": [evaluate(model, frame)[0]["psnr_db"] for (model, _), frame in zip(intra, frames)],
    "inter": [evaluate(inter[0], clip([t], True))[0]["psnr_db"] for t in times],
    "repeat frame 0": [evaluate(intra[0][0], frame)[0]["psnr_db"] for frame in frames],
}
for name, db in quality.items():
    print(f"{name:14s} PSNR {np.round(db, 2)}, mean {np.mean(db):.2f} dB")
print(f"intra {bytes_intra} = {sum(bytes_intra):,} bytes; inter {bytes_inter:,} bytes")
assert (
    bytes_inter < 0.6 * sum(bytes_intra)
    and abs(np.mean(quality["inter"]) - np.mean(quality["intra"])) < 1
)

# %% [markdown]
# About half the bytes, for pictures within 1 dB of each other. The control repeats frame 0 and costs nothing more: it is right at
# its own time and wrong where things moved. What separates it from inter is what motion is worth.

# %%
gap = min(quality["inter"][1:3]) - max(quality["repeat frame 0"][1:3])
print(
    f"inter {sum(bytes_intra) / bytes_inter:.2f} times smaller; motion is worth {gap:.1f} dB where the balls are in the air"
)
assert (
    quality["repeat frame 0"][0] == quality["intra"][0]
    and gap > 3
    and 1.6 < sum(bytes_intra) / bytes_inter < 2.6
)
assert abs(np.mean(quality["inter"]) - np.mean(quality["intra"])) < 1

# %% [markdown]
# Where do the bytes go? At this size networks are most of a file, so part of intra's loss is that it stores them with each frame.
# Count without them, only what describes the *scene*: positions, attributes, masks, grid. The factor then is nearly the number of
# frames.

# %%
NETWORKS = ("anchor_mlps", "context_mlps", "deformation_mlp")
kinds = {
    "networks": NETWORKS[:2],
    "ψ_d, the motion": NETWORKS[2:],
    "positions": ("positions",),
    "attributes, masks, grid": (
        "features",
        "scales",
        "offset_scales",
        "offsets",
        "masks",
        "hash_grid",
    ),
    "header": ("header",),
}
parts = {
    name: [sum(components(data).get(part, 0) for part in kind) for kind in kinds.values()]
    for name, data in (
        *((f"frame {i}", data) for i, (_, data) in enumerate(intra)),
        ("inter", inter[1]),
    )
}
assert (
    all(sum(parts[f"frame {i}"]) == len(data) for i, (_, data) in enumerate(intra))
    and sum(parts["inter"]) == bytes_inter
)
scene_only = {name: part[2] + part[3] for name, part in parts.items()}
factor = sum(scene_only[f"frame {i}"] for i in range(4)) / scene_only["inter"]
print(
    f"scene only: {factor:.2f} times; with everything: {sum(bytes_intra) / bytes_inter:.2f} times"
)
assert 3 < factor < 5 and parts["inter"][1] > 0 == parts["frame 0"][1]
assert all(part[0] + part[1] > sum(part) / 2 for part in parts.values())

# %%
figure, (bars, growth) = plt.subplots(
    1, 2, figsize=(15, 5.6), layout="constrained", gridspec_kw={"width_ratios": [1.3, 1]}
)
bottom = np.zeros(5)
for i, (kind, color, hatch) in enumerate(zip(kinds, lessons.COLORS, ("", "//", "", "..", ""))):
    height = np.array([part[i] for part in parts.values()])
    bars.bar(range(5), height, bottom=bottom, color=color, hatch=hatch, edgecolor="k", label=kind)
    bottom += height
bars.set_xticks(
    range(5), [f"intra\nframe {i}" for i in range(4)] + ["inter\nall frames"], fontsize=13
)
bars.set(ylabel="bytes", title="Four files with a scene each, or one scene and its motion")
handles, labels = bars.get_legend_handles_labels()
bars.legend(handles[::-1], labels[::-1], fontsize=12, loc="upper left")
bars.set_ylim(0, 1.25 * max(bottom))
for name, values, marker, hue in (
    ("intra", np.cumsum(bytes_intra), "o-", 1),
    ("inter", np.full(4, bytes_inter), "s--", 0),
):
    growth.plot(
        range(1, 5),
        values,
        marker,
        ms=11,
        color=lessons.COLORS[hue],
        label=f"{name}, mean PSNR {np.mean(quality[name]):.1f} dB",
    )
growth.set(
    xlabel="frames that can be shown",
    ylabel="bytes needed",
    xticks=range(1, 5),
    ylim=(0, 1.1 * sum(bytes_intra)),
    title="Intra grows, inter is paid at once",
)
growth.legend(fontsize=13)
lessons.show(figure, "26_video_codec_analogy")

# %%
over, camera = [frame.test[0].image for frame in frames], frames[0].test[0].camera
render = lambda model, t: np.clip(model.render(camera, t), 0, 1)
shown = {
    "truth": over,
    "intra": [render(model, 0.0) for model, _ in intra],
    "inter": [render(inter[0], t) for t in times],
    "repeat frame 0": [render(intra[0][0], 0.0)] * 4,
}
figure, axes = plt.subplots(4, 4, figsize=(9, 9.6), layout="constrained")
for line, (name, images) in zip(axes, shown.items()):
    for panel, image, truth, t in zip(line, images, over, times):
        panel.imshow(image), panel.set(xticks=[], yticks=[]), panel.grid(False)
        panel.set_xlabel(
            f"t = {t:.2f}" if name == "truth" else f"{decibel(squared_error(image, truth)):.1f} dB",
            fontsize=14,
        )
    line[0].set_ylabel(name, fontsize=16)
figure.suptitle("One test view: only the last row ignores motion", fontsize=18)
lessons.show(figure, "26_video_codec_analogy_pictures")

# %% [markdown]
# ## Backward by hand
# Why can a quarter of the training be enough? In intra, $L = \sum_t L_t(\theta_t)$: a frame's error reaches its own anchors only.
# In inter all use the *same* anchors, and their gradients add up (a step draws one term, all steps move the same anchors):
# $$L = \sum_t L_t(\theta) \;\Longrightarrow\; \bar\theta = \sum_t \bar\theta^{(t)},
#   \qquad\text{for a feature}\quad \bar f_a = \sum_t \bar f_a^{(t)}.$$

# %% [markdown]
# Checked on a small model: cotangents of the Gaussians at three times, three backward passes, one sum, against a difference of
# the summed loss.

# %%
rng = np.random.default_rng(26)
small, when = sample_model(3, 9), (0.0, 0.4, 1.0)
names = ("x", "s", "r", "alpha", "color")
at = lambda f_a, t: predict(
    small.design, small.networks, small.anchors._replace(f_a=f_a), np.array([0.0, -3, 1]), t
)
f_a = small.anchors.f_a.astype(float)
bars_t = [{n: rng.normal(size=getattr(at(f_a, t)[0], n).shape) for n in names} for t in when]
f_bar = sum(
    predict_backward(at(f_a, t)[1], *(bar[n] for n in names))[0]["f_a"]
    for t, bar in zip(when, bars_t)
)
loss = lambda f_a: sum(
    (bar[n] * getattr(at(f_a, t)[0], n)).sum() for t, bar in zip(when, bars_t) for n in names
)
way, h = rng.normal(size=f_a.shape), 1e-5
difference = (loss(f_a + h * way) - loss(f_a - h * way)) / (2 * h)
assert abs(difference - (f_bar * way).sum()) < 1e-6 * np.abs(f_bar * way).sum()
print(f"by differences {difference:.8f}, by the sum of three gradients {(f_bar * way).sum():.8f}")

# %% [markdown]
# ## Break it
# The oldest mistake of inter coding: the encoder predicts from the *original* last frame, the decoder from what it *decoded*.
# Each frame's rounding error stays, and they add up: **drift**. The first frames look perfect. Predicting from the decoded frame
# cures it.

# %%
signal = np.cumsum(rng.normal(size=(400, 500)), axis=0)  # 400 frames of 500 pixels
rounded = np.rint(np.diff(signal, axis=0, prepend=0))  # what is sent, predicted from the original
open_loop, closed_loop = np.cumsum(rounded, axis=0), np.zeros_like(signal)
for t in range(400):
    before = closed_loop[t - 1] if t else 0
    closed_loop[t] = before + np.rint(signal[t] - before)  # predicted from what the decoder has
drift, kept = (np.sqrt(np.mean((a - signal) ** 2, axis=1)) for a in (open_loop, closed_loop))
assert (
    abs(drift[0] - kept[0]) < 1e-12
    and drift[-1] > 15 * kept[-1]
    and np.abs(closed_loop - signal).max() <= 0.5 + 1e-9
)
for name, error in (("open loop", drift), ("closed loop", kept)):
    print(f"{name}: error {error[0]:.2f} steps in the first frame, {error[-1]:.2f} in the last")

# %% [markdown]
# P-4DGS cannot drift: every time is predicted from canonical space directly, never from another time. But the mistake's sibling
# is at home here: to score the model *before* rounding. What counts is `decode(encode(model))`, as `build` returns it above.

# %%
again = p4.decode(inter[1]).render(camera, 0.5)
assert np.array_equal(again, inter[0].render(camera, 0.5)) and p4.encode(inter[0]) == inter[1]

# %% [markdown]
# ## What a codec does with it
# Two things that video codecs have and P-4DGS has not. A **residual**: what motion cannot explain is coded per frame; here it is
# lost unless $\psi_d$ can say it. And a **choice per block**: here all anchors pay for one network, and it has no smaller size at
# a low rate, the limitation that the paper ends on. Its share of the file:

# %%
share = parts["inter"][1] / bytes_inter
print(
    f"psi_d: {parts['inter'][1]:,} bytes, which lambda_rate cannot change; {100 * share:.0f} % of this inter file"
)
assert components(inter[1])["deformation_mlp"] == parts["inter"][1] and 0.3 < share < 0.7

# %% [markdown]
# ## Exercises
# **26.1** At $30$ frames a second an intra frame has $5000$ bytes; one file for two seconds has $10000$. Both rates, in kbit/s
# (of $1000$ bits)? **26.2** The motion vector of each block of $8$ pixels, from `reference` to `frame`, as $8$ whole numbers: the
# shift $v$ from $-8$ to $8$ for which `np.roll(reference, v)` has the least sum of absolute errors in the block.
# **26.3** The backward of the motion model, Eq. (5), with `mlp` and `positional_encoding` of `p4dgs_ref.equations`.

# %% [markdown]
# For exercise 26.1, order `[intra, inter]`; $25$ frames of $1000$ bytes a second would be $200$. For exercise 26.2: the first
# block has $v = 0$ (`frame` is brighter by $1$ everywhere, so no error is $0$). For exercise 26.3: $x$ is $(N, 3)$, `inputs` has
# `x`, `t`, `weights`, `biases`, `L_x`, `L_t`; the last three weights are the heads, all of the same input: beside each other they
# are one last layer. With a head $W$ of one row, $y = 2$ and $\overline{\Delta x} = (1, 0, -1)$, $\bar W = (2, 0, -2)$.

# %%
reference = np.random.default_rng(8).integers(0, 256, 64)
frame = (
    np.concatenate(
        [
            np.roll(reference, v)[8 * i : 8 * i + 8]
            for i, v in enumerate((0, 3, 3, -2, -2, 5, 0, -7))
        ]
    )
    + 1
)
errors = np.array(
    [
        [np.abs(np.roll(reference, v) - frame)[8 * i : 8 * i + 8].sum() for v in range(-8, 9)]
        for i in range(8)
    ]
)
answer_1 = answer_2 = ...


def my_backward(inputs, cotangents):
    """{"x", "weights", "biases"}: gradients, from cotangents["delta_x_bar"], ["delta_s_bar"], ["delta_r_bar"]."""
    raise NotImplementedError


lessons.number("26.1", answer_1, [30 * 5000 * 8 / 1000, 10_000 * 8 / 1000 / 2])
lessons.number("26.2", answer_2, errors.argmin(axis=1) - 8)
lessons.backward("26.3", my_backward, "deformation")

# %% [markdown]
# ## Check your port
# `p4dgs-ref oracle check DIR --only deformation`. What a port gets wrong here: time as a frame number instead of a share of the
# recording; the encoding frequency by frequency for each axis instead of for the whole vector; $\pi$ in its waves.

# %%
print(oracle.check(lambda **i: deformation.forward(**i)[0], "deformation"))
assert oracle.check(lambda **i: deformation.forward(**i)[0], "deformation").ok
