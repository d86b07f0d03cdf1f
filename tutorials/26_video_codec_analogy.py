# %% [markdown]
# # P-4DGS as a video codec: intra, inter, and what they save
#
# **Promise.** After this you can name the parts of P-4DGS in the words of a video engineer, and you
# have compared inter prediction with intra prediction in bytes. **Before it:** `06_deformed`,
# `16_pipeline_by_hand`, `19_file_byte_by_byte`. **Takes** ten seconds on two cores, 25 minutes of
# reading and 35 of exercises.
#
# **Files:** [model.py](../p4dgs_ref/model.py),
# [deformation.py](../p4dgs_ref/equations/deformation.py), [file.py](../p4dgs_ref/codec/file.py).

# %%
import json

import numpy as np

from p4dgs_ref import lessons

lessons.find_tools()
from tutorials.tools import architecture, figures

plt = figures.pyplot()
architecture.show("26_video_codec_analogy")

# %% [markdown]
# ## Claim
# The frames of a video are similar to each other. A video codec does not store what it can
# predict, either from the same frame (*intra*) or from another frame and motion vectors
# (*inter*). It codes what remains with few bits, given its context. P-4DGS does the same with
# Gaussians:
#
# | video codec | P-4DGS | equations |
# |---|---|---|
# | intra prediction from neighbouring blocks | an anchor predicts its $k$ Gaussians | (1) to (4) |
# | reference frame; motion compensation | canonical space; $\psi_d$, $x + \Delta x$ | (5), (6) |
# | quantiser with a step per block | $q$ per anchor | (7), (8), (10) |
# | contexts of CABAC | $\mu, \sigma$ from the hash grid | (9), (11) to (14) |
# | rate-distortion optimisation | training | (15) to (17) |
#
# In a sum over $T$ frames, the large term therefore occurs only once. If the motion model is
# smaller than $T-1$ frames, inter prediction wins:
# $$R_{intra} = \sum_{t=1}^{T} R_t \approx T\,R_1 \qquad\text{against}\qquad
#   R_{inter} = R_1 + R_{\psi_d}.$$

# %% [markdown]
# ## By hand
# Take a video of 4 frames, each a row of 8 pixels of 8 bits, in which everything moves on by one
# pixel per frame (and re-enters at the other end). Pixel by pixel it has 256 bits. One stored
# frame and, for each of the other 3 frames, a motion vector of 4 bits are 76 bits, and no pixel
# has to be coded again.

# %%
row = np.array([0, 0, 90, 200, 90, 0, 0, 0])
video = [np.roll(row, t) for t in range(4)]
bits_of_pixels = 8 * np.size(video)
bits_of_vectors = 8 * len(row) + 4 * 3
assert (bits_of_pixels, bits_of_vectors) == (256, 76)


def search(reference, frame):
    """The motion vector with the smallest error; among equals, the shortest."""

    def badness(v):
        return np.abs(np.roll(reference, v) - frame).sum(), abs(v)

    return min(range(-8, 8), key=badness)


for t, frame in enumerate(video):
    assert search(video[0], frame) == t
    assert np.array_equal(np.roll(video[0], t), frame)

# %% [markdown]
# ## In code
# We repeat the experiment in three dimensions. The packaged scene `bouncing` is drawn again with
# $32\times 32$ pixels, at 4 moments, each seen by the same 12 cameras for training and 3 for
# testing. A *frame* is here the whole 3D scene at one moment.

# %%
import p4dgs_ref as p4
from p4dgs_ref.scenes.load import packaged_folder
from p4dgs_ref.scenes.simulator import place_cameras
from p4dgs_ref.scenes.simulator.description import read_description
from p4dgs_ref.scenes.simulator.trace import trace

file = packaged_folder() / "bouncing" / "scene.json"
description = json.loads(file.read_text(encoding="utf-8"))
description["resolution"] = [32, 32]
description["lens"] = {"fl_x": 42.8, "fl_y": 42.8, "cx": 16, "cy": 16}
description["cameras"].update(train=12, test=3)
drawing = read_description(description)
cameras, is_test = [], []
for split in ("train", "test"):
    for camera, _ in place_cameras(drawing, split):
        cameras.append(camera)
        is_test.append(split == "test")
times = [0.0, 1 / 3, 2 / 3, 1.0]
pictures = {t: [trace(drawing, camera, t) for camera in cameras] for t in times}
assert sum(is_test) == 3 and len(is_test) == 15

STILL = ("view_color", "occlusion", "background")


def scene_of(moments, moves):
    """A scene of some moments. A scene without motion does not know their times."""
    images, shown_at = [], []
    for t in moments:
        images += pictures[t]
        shown_at += len(cameras) * [t if moves else 0.0]
    return p4.Scene.from_arrays(
        images,
        len(moments) * cameras,
        shown_at,
        test=np.flatnonzero(len(moments) * is_test).tolist(),
        effects=(*STILL, "translation") if moves else STILL,
    )


# %% [markdown]
# **Intra** is a static model for each frame. **Inter** is a single model of all frames, with
# $\psi_d$. Each of the five models is trained for 400 steps, with the same number of anchors and
# the same networks, so intra has four times the training. The files are real, and every model is
# decoded from its file before it is evaluated.

# %%

from p4dgs_ref.report.evaluate import evaluate, psnr
from p4dgs_ref.training.presets import choose
from p4dgs_ref.training.trainer import Trainer

changes = dict(  # `tiny` in 400 steps, with fewer and smaller parts
    stage_ends=(21, 32, 189, 400),
    decay_from=189,
    grow_from=11,
    grow_every=20,
    grow_until=158,
    mask_from=189,
    anchors=80,
    d=6,
    hidden=(8, 8),
    deformation=(32, 32),
    context=(8, 8),
    grid_3d=(4,),
    grid_2d=(8,),
    F=1,
)


def build(scene):
    """Train a model, write its file, and read it again."""
    trained = Trainer(scene, choose("tiny", changes)).run()
    data = p4.encode(trained)
    return p4.decode(data), data


def mean_psnr(model, scene):
    return evaluate(model, scene)[0]["psnr_db"]


frames = [scene_of([t], moves=False) for t in times]
intra = [build(frame) for frame in frames]
inter, inter_data = build(scene_of(times, moves=True))
intra_bytes = [len(data) for _, data in intra]
inter_bytes = len(inter_data)
quality = {
    "intra": [mean_psnr(model, frame) for (model, _), frame in zip(intra, frames)],
    "inter": [mean_psnr(inter, scene_of([t], moves=True)) for t in times],
    "repeat frame 0": [mean_psnr(intra[0][0], frame) for frame in frames],
}
for name, db in quality.items():
    print(f"{name:14s} PSNR {np.round(db, 2)}, mean {np.mean(db):.2f} dB")
print(f"intra {intra_bytes} = {sum(intra_bytes):,} bytes, inter {inter_bytes:,} bytes")
assert inter_bytes < 0.6 * sum(intra_bytes)
assert abs(np.mean(quality["inter"]) - np.mean(quality["intra"])) < 1

# %% [markdown]
# Inter needs about half the bytes, and its pictures are within 1 dB of those of intra. The
# control, which repeats frame 0, costs no further bytes. It is right at its own time and wrong
# wherever something has moved. The difference between the control and inter is what the motion
# model contributes.

# %%
in_the_air = slice(1, 3)
gap = min(quality["inter"][in_the_air]) - max(quality["repeat frame 0"][in_the_air])
factor = sum(intra_bytes) / inter_bytes
print(f"inter is {factor:.2f} times smaller; motion contributes {gap:.1f} dB")
assert gap > 3
assert 1.6 < factor < 2.6

# %% [markdown]
# Where do the bytes go? At this size networks are most of a file, so intra loses partly because
# it stores the networks with each frame. Let us also count without networks, only what describes
# the *scene*: positions, attributes, masks and grid. The factor is then close to the number of
# frames.

# %%
from p4dgs_ref.report.inspect import components

kinds = {
    "networks": ("anchor_mlps", "context_mlps"),
    "ψ_d, the motion": ("deformation_mlp",),
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


def bytes_by_kind(data):
    sizes = components(data)
    return {kind: sum(sizes.get(part, 0) for part in parts) for kind, parts in kinds.items()}


files = {f"frame {i}": bytes_by_kind(data) for i, (_, data) in enumerate(intra)}
files["inter"] = bytes_by_kind(inter_data)
for name, size in zip(files, [*intra_bytes, inter_bytes]):
    assert sum(files[name].values()) == size
    assert files[name]["networks"] + files[name]["ψ_d, the motion"] > size / 2


def scene_bytes(name):
    return files[name]["positions"] + files[name]["attributes, masks, grid"]


all_frames = sum(scene_bytes(f"frame {i}") for i in range(4))
factor_of_scene = all_frames / scene_bytes("inter")
print(f"scene only: {factor_of_scene:.2f} times; with everything: {factor:.2f} times")
assert 3 < factor_of_scene < 5

# %%
figure, (bars, growth) = plt.subplots(
    1,
    2,
    figsize=(15, 5.6),
    layout="constrained",
    width_ratios=(1.3, 1),
)
bottom = np.zeros(5)
for kind, color, hatch in zip(kinds, figures.COLORS, ("", "//", "", "..", "")):
    height = np.array([own[kind] for own in files.values()])
    bars.bar(range(5), height, bottom=bottom, color=color, hatch=hatch, edgecolor="k")
    bars.text(4.5, bottom[4] + height[4] / 2, kind, color=color, va="center", fontsize=12)
    bottom += height
names = [f"intra\nframe {i}" for i in range(4)] + ["inter\nall frames"]
bars.set_xticks(range(5), names, fontsize=13)
bars.set(
    xlim=(-0.5, 6),
    ylabel="bytes",
    title="Four files with a scene each, or one scene and its motion",
)
needed = {
    "intra": (np.cumsum(intra_bytes), "o-", figures.COLORS[1]),
    "inter": (np.full(4, inter_bytes), "s--", figures.COLORS[0]),
}
for name, (values, marker, hue) in needed.items():
    growth.plot(
        range(1, 5),
        values,
        marker,
        ms=11,
        color=hue,
        label=f"{name}, mean PSNR {np.mean(quality[name]):.1f} dB",
    )
figures.finish(
    growth,
    xlabel="frames that can be shown",
    ylabel="bytes needed",
    xticks=range(1, 5),
    ylim=(0, 1.1 * sum(intra_bytes)),
    title="Intra grows with each frame, inter is paid once",
)
figures.label(growth, (1.1, 17_000), (2.4, 8300), fontsize=13)
figures.show(figure, "26_video_codec_analogy")

# %%
camera = frames[0].test[0].camera
truths = [frame.test[0].image for frame in frames]


def render(model, t):
    return np.clip(model.render(camera, t), 0, 1)


shown = {
    "truth": truths,
    "intra": [render(model, 0.0) for model, _ in intra],
    "inter": [render(inter, t) for t in times],
    "repeat frame 0": 4 * [render(intra[0][0], 0.0)],
}
# %%
figure, axes = plt.subplots(4, 4, figsize=(9, 9.6), layout="constrained")
for line, (name, images) in zip(axes, shown.items()):
    for panel, image, truth, t in zip(line, images, truths, times):
        panel.imshow(image)
        figures.finish(
            panel,
            xticks=[],
            yticks=[],
            grid=False,
        )
        panel.set_xlabel(
            f"t = {t:.2f}" if name == "truth" else f"{psnr(image, truth):.1f} dB",
            fontsize=14,
        )
    line[0].set_ylabel(name, fontsize=16)
figures.show(
    figure,
    "26_video_codec_analogy_pictures",
    title="One test view: only the last row ignores motion",
    size=18,
)

# %% [markdown]
# ## Backward by hand
# Why can a quarter of the training be enough for inter? In intra, $L = \sum_t L_t(\theta_t)$, so
# the error of a frame reaches only its own anchors. In inter all frames use the *same* anchors,
# and their gradients add up. (A training step draws one term of the sum, but all steps move the
# same anchors.)
# $$L = \sum_t L_t(\theta) \;\Longrightarrow\; \bar\theta = \sum_t \bar\theta^{(t)},
#   \qquad\text{for a feature}\quad \bar f_a = \sum_t \bar f_a^{(t)}.$$
# We check this with a small published file. Random cotangents of the Gaussians at three times give
# three backward passes; the sum of their gradients is compared with a finite difference of the
# summed loss.

# %%
from p4dgs_ref.model import predict
from p4dgs_ref.oracle.streams import STREAMS

rng = np.random.default_rng(26)
small = p4.decode((STREAMS / "full.p4dgs").read_bytes())
x_c = np.array([0.0, -3, 1])
OUTPUTS = ("x", "s", "r", "alpha", "color")


def gaussians_at(f_a, t):
    anchors = small.anchors._replace(f_a=f_a)
    return predict(small.design, small.networks, anchors, x_c, t)


f_a = small.anchors.f_a.astype(float)
cotangents = {}
f_bar = np.zeros_like(f_a)
for t in (0.0, 0.4, 1.0):
    g, _, back = gaussians_at(f_a, t)
    cotangents[t] = [rng.normal(size=getattr(g, name).shape) for name in OUTPUTS]
    anchors_bar, _ = back(*cotangents[t])
    f_bar += anchors_bar["f_a"]


def loss_at(f_a):
    total = 0
    for t, bars in cotangents.items():
        g, *_ = gaussians_at(f_a, t)
        for name, bar in zip(OUTPUTS, bars):
            total += (bar * getattr(g, name)).sum()
    return total


way = rng.normal(size=f_a.shape)
by_difference = (loss_at(f_a + 1e-5 * way) - loss_at(f_a - 1e-5 * way)) / 2e-5
by_gradient = (f_bar * way).sum()
assert abs(by_difference - by_gradient) < 1e-6 * abs(by_gradient)
print(f"by differences {by_difference:.8f}, by the sum of three gradients {by_gradient:.8f}")

# %% [markdown]
# ## Break it
# The oldest mistake of inter coding is an encoder that predicts from the *original* previous
# frame, while the decoder predicts from the frame that it has *decoded*. The rounding error of
# each frame then stays in all later frames, and the errors add up. This is called **drift**. The
# first frames look perfect. The remedy is to predict from the decoded frame in the encoder too.

# %%
signal = np.cumsum(rng.normal(size=(400, 500)), axis=0)  # 400 frames of 500 pixels
sent = np.rint(np.diff(signal, axis=0, prepend=0))  # predicted from the original
open_loop = np.cumsum(sent, axis=0)
closed_loop = np.zeros_like(signal)
decoded = np.zeros(500)
for t in range(400):
    decoded = decoded + np.rint(signal[t] - decoded)  # predicted from the decoded frame
    closed_loop[t] = decoded


def rms_error(loop):
    return np.sqrt(np.mean((loop - signal) ** 2, axis=1))


drift, bounded = rms_error(open_loop), rms_error(closed_loop)
print(f"open loop: error {drift[0]:.2f} steps in the first frame, {drift[-1]:.2f} in the last")
print(f"closed loop: {bounded[0]:.2f} in the first frame, {bounded[-1]:.2f} in the last")
assert abs(drift[0] - bounded[0]) < 1e-12
assert drift[-1] > 15 * bounded[-1]
assert np.abs(closed_loop - signal).max() <= 0.5 + 1e-9

# %% [markdown]
# P-4DGS cannot drift, because every time is predicted directly from canonical space and never
# from another time. But a related mistake is possible: to evaluate the model *before* rounding.
# The model that counts is `decode(encode(model))`, which `build` returns above.

# %%
again = p4.decode(inter_data)
assert np.array_equal(again.render(camera, 0.5), inter.render(camera, 0.5))
assert p4.encode(inter) == inter_data

# %% [markdown]
# ## What a codec does with it
# Video codecs have two things that P-4DGS lacks. The first is a **residual**: a video codec codes
# for each frame what motion cannot explain, whereas P-4DGS loses whatever $\psi_d$ cannot
# express. The second is a **choice per block**: here all anchors pay for one network, which does
# not become smaller at a low rate. This is the limitation with which the paper ends. The share of
# $\psi_d$ in our file:

# %%
motion = files["inter"]["ψ_d, the motion"]
print(
    f"psi_d has {motion:,} bytes, {motion / inter_bytes:.0%} of this inter file; "
    "lambda_rate cannot change them"
)
assert 0.3 < motion / inter_bytes < 0.7

# %% [markdown]
# ## Exercises
# **26.1** ● At $30$ frames a second, an intra frame takes $5000$ bytes. One inter file for two
# seconds takes $10000$ bytes. What are the two rates `[intra, inter]` in kbit/s (of $1000$ bits)?
# For comparison, $25$ frames of $1000$ bytes a second are $200$ kbit/s.
#
# **26.2** ●● Find the motion vector of each block of $8$ pixels from `reference` to `frame`, as $8$
# integers: the shift $v$ from $-8$ to $8$ for which `np.roll(reference, v)` has the smallest sum
# of absolute errors in the block. The first block has $v = 0$. (`frame` is brighter by $1$
# everywhere, so no error is $0$.)
#
# **26.3** ●●● Write the backward of the motion model, Eq. (5), with `mlp` and `positional_encoding`
# of `p4dgs_ref.equations`. The last three weights are the heads. They have the same input, so
# side by side they form one last layer. For a head $W$ with a single row, $y = 2$ and
# $\overline{\Delta x} = (1, 0, -1)$ give $\bar W = (2, 0, -2)$.
#
# **Predict, then run.** The same motion is recorded for twice as long, so $t$ from 0 to 1 now
# covers twice the time. Which $L_t$ gives $\psi_d$ at least the waves, in seconds, that it had
# before?

# %%
rng = np.random.default_rng(8)
reference = rng.integers(0, 256, 64)
frame = np.ones(64, int)
for i in range(8):
    block = slice(8 * i, 8 * i + 8)
    shift = rng.integers(-8, 9) if i else 0
    frame[block] += np.roll(reference, shift)[block]
answer_1 = answer_2 = ...


def my_backward(inputs, cotangents):
    """Return {"x", "weights", "biases"}.

    The cotangents are "delta_x_bar", "delta_s_bar" and "delta_r_bar". The inputs are "x" (N, 3),
    "t", "weights", "biases", "L_x" and "L_t".
    """
    raise NotImplementedError


lessons.check_number("26.1", answer_1)
lessons.check_number("26.2", answer_2)
lessons.check_backward("26.3", my_backward, "deformation")

# %% [markdown]
# ## Check your port
# Run `p4dgs-ref oracle check DIR --only deformation`. Typical mistakes of ports are a time given
# as a frame number instead of a share of the recording, an encoding that runs through all
# frequencies of one axis before the next instead of encoding the whole vector, and a factor $\pi$
# in the sines and cosines.

# %%
lessons.passes("deformation")
