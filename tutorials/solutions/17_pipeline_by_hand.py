# %% [markdown]
# # Solutions to the whole pipeline by hand

# %%
import numpy as np

from p4dgs_ref import SETTINGS, Camera, lessons
from p4dgs_ref.equations import color, masking, offsets, opacity, rotation, scale, view
from p4dgs_ref.model import Anchors, Design, predict
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting import render

# %% [markdown]
# **17.1** In the tutorial, evaluate `look([temporal(child, 0.0)[0] for child in canonical])[0]`.
# At time 0 the children are not at their canonical positions, because $\psi_d$ has biases and
# therefore moves them even then. The renderer returns the same colour for the same anchor.

# %%
rng = np.random.default_rng(3524)


def draw(*shape):
    return rng.integers(-8, 9, shape) / 16


design = Design(
    d=2,
    k=2,
    hidden=(3,),
    deformation=(3,),
    L_x=1,
    L_t=1,
    context=(),
    F=1,
    table=(8, 4),
    tau_alpha=0.0,
    grid=(("xyz", 2), ("xy", 2), ("xz", 2), ("yz", 2)),
    Q_0=(0.25, 0.0625, 0.0625, 0.125),
    effects=MODEL_EFFECTS,
)
networks = {}
for name, layers in design.layers().items():
    weights = [draw(*rows_and_columns) for rows_and_columns in layers]
    biases = [draw(columns) for _, columns in layers]
    networks[name] = (weights, biases)
networks["psi_alpha"][1][-1] += [1, 1]
for part in networks["psi_d"]:
    for head in part[1:]:
        head /= 8
anchor = Anchors(
    x_a=np.array([[0.0, 0, 0]]),
    f_a=np.array([[0.5, -1]]),
    s_a=np.array([[0.75, 0.5, 0.625]]),
    l_a=np.array([[0.5, 0.5, 0.5]]),
    O_a=np.array([[[0.5, 0, 0], [-0.5, 0.5, 1]]]),
    mask=np.array([[True, True]]),
)
camera = Camera(np.eye(3), np.array([0.0, 0, 4]), 40.0, 40.0, 16.0, 12.0, 33, 25)
g = predict(design, networks, anchor, camera.center, 0.0)[0]
(image, *_), _ = render.forward(*g[:5], camera, np.ones(3), SETTINGS["exact"])
lessons.check_number("17.1", [0.6387020, 0.4141825, 0.3525295], image[12, 18])

# %% [markdown]
# **17.2** and **17.3** The forward pass follows the data, and the backward pass goes the opposite
# way. Two sums are easy to forget: four networks read the features, and the position is used twice,
# in Eq. (1) and in Eq. (2).


# %%
def run(x_a, f_a, s_a, l_a, O_a, mask, x_c, tau_alpha, effects, **networks):
    """The outputs by name, and what each backward needs."""

    def network(name):
        return networks[f"{name}_weights"], networks[f"{name}_biases"]

    saved = {}
    seen, saved["view"] = view.forward(x_a, x_c)
    unseen = (f_a[:, :0], f_a[:, :0])
    geometry = seen if "view_geometry" in effects else unseen
    for_color = seen if "view_color" in effects else unseen
    x, saved["x"] = offsets.forward(x_a, O_a, l_a)
    s, saved["s"] = scale.forward(s_a, f_a, *geometry, *network("psi_s"))
    r, saved["r"] = rotation.forward(f_a, *geometry, *network("psi_r"))
    alpha, saved["alpha"] = opacity.forward(f_a, *geometry, *network("psi_alpha"))
    colors, saved["color"] = color.forward(f_a, *for_color, *network("psi_c"))
    kept, saved["kept"] = masking.forward(x, s, r, alpha, colors, mask, tau_alpha)
    names = ("alpha", "x", "color", "s", "r", "index")
    return dict(zip(names, kept)), saved


def my_forward(**inputs):
    return run(**inputs)[0]


def my_backward(inputs, cotangents):
    saved = run(**inputs)[1]
    full = masking.backward(saved["kept"], **cotangents)
    placed = offsets.backward(saved["x"], full["x"])
    scaled = scale.backward(saved["s"], full["s"])
    readers = [
        opacity.backward(saved["alpha"], full["alpha"]),
        color.backward(saved["color"], full["color"]),
        rotation.backward(saved["r"], full["r"]),
        scaled,
    ]
    x_a_bar = placed["x_a"]
    seeing = [reader for reader in readers if reader["d_vc"].shape[1]]
    if seeing:
        delta_vc_bar = sum(reader["delta_vc"] for reader in seeing)
        d_vc_bar = sum(reader["d_vc"] for reader in seeing)
        x_a_bar = x_a_bar + view.backward(saved["view"], delta_vc_bar, d_vc_bar)["x_a"]
    return {
        "x_a": x_a_bar,
        "f_a": sum(reader["f_a"] for reader in readers),
        "s_a": scaled["s_a"],
        "l_a": placed["l_a"],
        "O_a": placed["O_a"],
    }


lessons.check_forward("17.2", my_forward, "spatial_prediction")
lessons.check_backward("17.3", my_backward, "spatial_prediction", "x_a", "f_a", "s_a", "l_a", "O_a")

# %% [markdown]
# **Predict, then run.** Eqs. (2) to (4) depend on the anchor only relative to the camera, so all
# attributes except $x$ stay the same, and $x$ moves by $(1, 0, 0)$. But Eq. (5) reads the position
# itself. At the new position, $\psi_d$ moves the Gaussians differently, and the pixel changes.

# %%
there = anchor._replace(x_a=anchor.x_a + [1.0, 0, 0])
camera_there = Camera(np.eye(3), np.array([-1.0, 0, 4]), 40.0, 40.0, 16.0, 12.0, 33, 25)
pixels = {}
canonical = {}
for name, moved, seen_by in (("here", anchor, camera), ("there", there, camera_there)):
    canonical[name] = predict(design, networks, moved, seen_by.center)[0]
    g = predict(design, networks, moved, seen_by.center, 0.5)[0]
    (image, *_), _ = render.forward(*g[:5], seen_by, np.ones(3), SETTINGS["exact"])
    pixels[name] = image[12, 18]
assert np.allclose(canonical["there"].x - canonical["here"].x, [1, 0, 0])
for attribute in ("s", "r", "alpha", "color"):
    a, b = (getattr(canonical[name], attribute) for name in ("here", "there"))
    assert np.allclose(a, b)
assert np.abs(pixels["there"] - pixels["here"]).max() > 0.003
