# %% [markdown]
# # Solutions to the whole pipeline by hand

# %%
import numpy as np

from p4dgs_ref import SETTINGS, Camera
from p4dgs_ref.equations import color, masking, offsets, opacity, rotation, scale, view
from p4dgs_ref.model import Anchors, Design, predict
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.school import lessons
from p4dgs_ref.splatting import render

# %% [markdown]
# **16.1** In the tutorial: `look([temporal(child, 0.0)[0] for child in canonical])[0]`. At time 0 the children do not stand at
# their canonical places: $\psi_d$ has biases, and moves things then, too. The renderer, asked for the same anchor, agrees.

# %%
rng = np.random.default_rng(3524)
draw = lambda *shape: rng.integers(-8, 9, shape) / 16
grid = (("xyz", 2), ("xy", 2), ("xz", 2), ("yz", 2))
design = Design(
    2, 2, (3,), (3,), 1, 1, (), grid, (8, 4), 1, (0.25, 0.0625, 0.0625, 0.125), 0.0, MODEL_EFFECTS
)
networks = {
    name: ([draw(*pair) for pair in layers], [draw(columns) for _, columns in layers])
    for name, layers in design.layers().items()
}
networks["psi_alpha"][1][-1] += [1, 1]
networks["psi_d"] = tuple([part[0], *(a / 8 for a in part[1:])] for part in networks["psi_d"])
anchor = Anchors(
    *(
        np.array([a])
        for a in (
            [0.0, 0, 0],
            [0.5, -1],
            [0.75, 0.5, 0.625],
            [0.5, 0.5, 0.5],
            [[0.5, 0, 0], [-0.5, 0.5, 1]],
            [True, True],
        )
    )
)
camera = Camera(np.eye(3), np.array([0.0, 0, 4]), 40.0, 40.0, 16.0, 12.0, 33, 25)
g = predict(design, networks, anchor, camera.center, 0.0)[0]
image = render.forward(g.x, g.s, g.r, g.alpha, g.color, camera, np.ones(3), SETTINGS["exact"])[
    0
].image
lessons.number("16.1", [0.6387020, 0.4141825, 0.3525295], image[12, 18])

# %% [markdown]
# **16.2** and **16.3** Forward in the order of data, backward in the opposite order. Two sums are what is easily forgotten: the
# feature is read by four networks, and the place is used twice, in Eq. (1) and, through the view, in Eq. (2).


# %%
def run(x_a, f_a, s_a, l_a, O_a, mask, x_c, tau_alpha, effects, **networks):
    """Everything, with the residuals that the backward needs."""
    net = lambda name: (networks[f"{name}_weights"], networks[f"{name}_biases"])
    seen, res_view = view.forward(x_a, x_c)
    unseen = (f_a[:, :0], f_a[:, :0])
    geometry = seen if "view_geometry" in effects else unseen
    alpha, res_alpha = opacity.forward(f_a, *geometry, *net("psi_alpha"))
    c, res_c = color.forward(f_a, *(seen if "view_color" in effects else unseen), *net("psi_c"))
    r, res_r = rotation.forward(f_a, *geometry, *net("psi_r"))
    s, res_s = scale.forward(s_a, f_a, *geometry, *net("psi_s"))
    x, res_x = offsets.forward(x_a, O_a, l_a)
    kept, res_m = masking.forward(alpha.alpha, mask, tau_alpha, x.x, c.color, s.s, r.r)
    return kept, (res_view, res_alpha, res_c, res_r, res_s, res_x, res_m)


def my_forward(**inputs):
    return run(**inputs)[0]._asdict()


def my_backward(inputs, cotangents):
    res_view, res_alpha, res_c, res_r, res_s, res_x, res_m = run(**inputs)[1]
    full = masking.backward(res_m, **cotangents)
    placed = offsets.backward(res_x, full["x"])
    readers = [
        opacity.backward(res_alpha, full["alpha"]),
        color.backward(res_c, full["color"]),
        rotation.backward(res_r, full["r"]),
        scale.backward(res_s, full["s"]),
    ]
    seeing = [reader for reader in readers if reader["d_vc"].shape[1]]
    x_a_bar = placed["x_a"]
    if seeing:
        x_a_bar = (
            x_a_bar
            + view.backward(
                res_view, sum(n["delta_vc"] for n in seeing), sum(n["d_vc"] for n in seeing)
            )["x_a"]
        )
    return {
        "x_a": x_a_bar,
        "f_a": sum(reader["f_a"] for reader in readers),
        "s_a": readers[3]["s_a"],
        "l_a": placed["l_a"],
        "O_a": placed["O_a"],
    }


lessons.forward("16.2", my_forward, "spatial_prediction")
lessons.backward("16.3", my_backward, "spatial_prediction", "x_a", "f_a", "s_a", "l_a", "O_a")
