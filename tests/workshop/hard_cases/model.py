"""Hard cases of prediction, deformation, grid, losses and optimiser: rows H-P1 to H-P10, H-S1."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_anchor_network, random_field

from . import literals
from .entry import hard


def view_entries():
    """H-P1, and what a search found beside it."""
    yield hard(
        "H-P1.inside",
        "view",
        "an anchor in the camera: a direction 0/0",
        dict(x_a=np.array([[1.0, 2, 3], [1, 2, 5]]), x_c=np.array([1.0, 2, 3])),
        ("d_vc", (0, 0)),
        literals.plain_direction,
        ("zero", "kink"),
        smooth=False,
        expected={"delta_vc": np.array([[0.0], [2]]), "d_vc": np.array([[0.0, 0, 0], [0, 0, 1]])},
    )
    yield hard(
        "H-P1.beside",
        "view",
        "an anchor 1e-23 from the camera: squares of differences leave the range of float32",
        dict(x_a=np.array([[3e-23, -4e-23, 1.2e-22], [1e-9, 2e-9, 2e-9]]), x_c=np.zeros(3)),
        ("delta_vc", (0, 0)),
        literals.plain_distance,
        ("extreme",),
    )
    yield hard(
        "H-P1.along_an_axis",
        "view",
        "nearly along an axis: 1 - d_x^2 has no digits; literal is (I - d d^T) v",
        dict(x_a=np.array([[4.0, 2.0**-14, -(2.0**-16)], [2.0**-20, -2, 0]]), x_c=np.zeros(3)),
        ("x_a_bar", (0, 0)),
        literals.gradient_by_projection,
        ("extreme",),
    )


def motion_entries():
    """H-P2 to H-P4."""
    s = np.array([[0.5, 2, 3], [1, 0.25, 4]])
    for name, factor in (("zero", -1.0), ("negative", -2.0)):
        yield hard(
            f"H-P2.{name}",
            "deformed",
            f"delta_s = {factor:g} s: a scale that is {name}; literal takes a logarithm",
            dict(
                x=np.zeros((2, 3)),
                s=s,
                r=np.eye(4)[:2],
                delta_x=np.ones((2, 3)),
                delta_s=factor * s,
                delta_r=np.zeros((2, 4)),
            ),
            ("s_t", (0, 0)),
            lambda v: np.exp(np.log(v["s"][0, 0] + v["delta_s"][0, 0])),
            ("negative", "zero"),
            expected={"x_t": np.ones((2, 3)), "s_t": (1 + factor) * s, "r_t": np.eye(4)[:2]},
        )
    field = random_field(np.random.default_rng(3), 2, 3, 5)
    x = np.array([[0.3, -1, 0.7], [0, 0.25, -0.5]])
    for t in (0.0, 1.0, -1.0, 2.0):
        yield hard(
            f"H-P3.t{t:g}",
            "deformation",
            f"t = {t:g}: at, before and after the ends of the recording",
            dict(x=x, t=t, **field),
            ("delta_x", (0, 0)),
            literals.network_on_one_row,
            ("zero",) if t == 0 else ("outside",),
            each=False,
        )
    for L in (10, 16, 20):
        yield hard(
            f"H-P4.L{L}",
            "positional_encoding",
            f"frequencies to 2^{L - 1}; literal doubles the angle L - 1 times",
            dict(p=np.array([[1.29, -0.77], [-1.3, 0.001]]), L=L),
            ("E", (0, -4)),
            literals.sine_by_doubling,
            ("extreme",),
            each=False,
        )


def grid_entries():
    """H-P5, H-P6."""
    box = dict(lo=np.array([-1.0, 0, 2]), hi=np.array([1.0, 4, 2.5]))
    rng = np.random.default_rng(8)
    for name, resolutions, tables in (
        ("dense", (("xyz", 3), ("xy", 5)), (27, 25)),
        ("hashed", (("xyz", 9), ("yz", 65)), (16, 16)),
    ):
        grids = [rng.uniform(-0.9, 0.9, size=(T, 2)) for T in tables]
        for place, x_a in (
            ("outside", [[-7.0, 9, 1e30], [3, -1e30, 0]]),
            ("upper_face", [[1.0, 4, 2.5], [0.25, 4, 2.5]]),
        ):
            yield hard(
                f"H-P5.{name}_{place}",
                "hash_grid",
                "an anchor beyond the box or on its upper face; literal is the node it would read",
                dict(x_a=np.array(x_a), **box, grids=grids, resolutions=resolutions),
                ("h", (0, 0)),
                literals.node_without_clamp,
                ("outside", "clamped"),
                each=False,
            )
    latents = np.array([[0.0], [-0.0], [1.0], [-1.0], [1.5], [-1.5]])
    yield hard(
        "H-P6.latents",
        "hash_grid",
        "entries 0, -0, +-1 and beyond; literal is sign(0) = 0, which is no bit",
        dict(
            x_a=np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]]),
            lo=np.zeros(3),
            hi=np.array([2.0, 2, 0]),
            grids=[np.concatenate([latents, np.zeros((3, 1))])],
            resolutions=(("xy", 3),),
        ),
        ("h", (0, 0)),
        lambda v: np.sign(v["grids"][0][0, 0]),
        ("kink", "clamped"),
        smooth=False,
        expected={"h": np.array([[1.0], [1], [1], [-1], [1], [-1]])},
    )


def image_entries():
    """H-P7: SSIM of images without structure."""
    truth = np.full((6, 5, 1), 0.75)
    kink = dict(smooth=False, expected={"ssim": np.float64(1), "image_bar": 0 * truth})
    for name, image, other, more in (
        ("constant", 0 * truth + 0.5, truth, {}),
        ("identical", truth, truth, kink),
        ("black", 0 * truth, 0 * truth, kink),
    ):
        yield hard(
            f"H-P7.{name}",
            "ssim",
            f"{name} images: E[x^2] - E[x]^2 is rounding",
            dict(image=image, truth=other),
            ("ssim", ()),
            literals.ssim_by_moments,
            ("single", "zero"),
            value=(1e-12, 2e-6),
            grad=(1e-10, 2e-5),
            **more,
        )
    rng = np.random.default_rng(4)
    truth = np.round(rng.random((4, 3, 2)), 3)
    yield hard(
        "H-P7.nearly_equal",
        "render_loss",
        "images 1e-4 apart: 1 - SSIM has no digits left in float32",
        dict(image=truth + 1e-4 * rng.choice([-1, 1], truth.shape), truth=truth, lambda_ssim=0.25),
        ("D_SSIM", ()),
        literals.one_minus_ssim,
        ("zero",),
        value=(1e-10, 2e-4),
        grad=(1e-10, 2e-4),
    )


def loss_entries():
    """H-P10, H-P8: weights of the losses, empty arrays, a logarithm of 0."""
    for lam in (0.0, 1e6):
        yield hard(
            f"H-P10.lambda{lam:g}",
            "total_loss",
            f"lambda_rate = {lam:g}",
            dict(L_render=np.float64(0.0625), L_rate=np.float64(2.5), lambda_rate=lam),
            ("L_total", ()),
            lambda v: v["L_render"] + v["lambda_rate"] * v["L_rate"],
            ("zero", "extreme"),
            expected={
                "L_total": np.float64(0.0625 + lam * 2.5),
                "L_render_bar": np.nan,
                "L_rate_bar": np.nan,
            },
        )
    yield hard(
        "H-P10.all_masked",
        "masking",
        "a mask that removes every child: empty arrays",
        dict(
            alpha=np.full((3, 2), 0.5),
            mask=np.zeros((3, 2), bool),
            tau_alpha=0.0,
            x=np.ones((3, 2, 3)),
            color=np.ones((3, 2, 3)),
            s=np.ones((3, 2, 3)),
            r=np.ones((3, 2, 4)),
        ),
        ("alpha_bar", (0, 0)),
        lambda v: np.divide(v["alpha"][v["mask"]].sum(), np.count_nonzero(v["mask"])),
        ("masked", "empty"),
        expected={
            "alpha_bar": np.zeros((3, 2)),
            "x_bar": np.zeros((3, 2, 3)),
            "color_bar": np.zeros((3, 2, 3)),
            "s_bar": np.zeros((3, 2, 3)),
            "r_bar": np.zeros((3, 2, 4)),
        },
    )


def saturated_entries():
    """H-S1, found by a search: slopes where tanh and the sigmoid round to their limit."""
    inputs = random_anchor_network(np.random.default_rng(6), A=2, d=2, k=2)
    inputs["weights"][-1] *= 0
    inputs["biases"][-1][...] = [9.0, -17.0]
    yield hard(
        "H-S1.tanh",
        "opacity",
        "the slope of a saturated tanh: literal is 1 - alpha^2",
        inputs,
        ("biases_bar", (-1, 1)),
        lambda v: 1 - np.tanh(v["biases"][-1][1]) ** 2,
        ("saturated",),
    )
    for key in ("color", "scale"):
        inputs = random_anchor_network(np.random.default_rng(7), A=2, d=2, k=1, outputs=3)
        inputs["weights"][-1] *= 0
        inputs["biases"][-1][...] = [16.0, -30.0, 38.0]
        more = {"s_a": np.array([[1.0, 2, 4], [0.5, 1, 8]])} if key == "scale" else {}
        yield hard(
            f"H-S1.{key}",
            key,
            "the slope of a saturated sigmoid: literal is s (1 - s)",
            {**more, **inputs},
            ("biases_bar", (-1, 2)),
            literals.plain_sigmoid_slope,
            ("saturated",),
        )


def entries():
    """All of them, in the order of the table."""
    yield from view_entries()
    yield from motion_entries()
    yield from grid_entries()
    yield from image_entries()
    yield from loss_entries()
    yield from saturated_entries()
