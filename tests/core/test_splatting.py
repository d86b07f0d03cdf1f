"""The renderers held against each other: the exact twin, the fast one, and the readable loop."""

import numpy as np
import pytest

from p4dgs_ref.splatting import compositing, fast, loop, render, tiles
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT, FAST, PAPER

SIZES = [
    (1, 1),
    (5, 3),
    (29, 43),
    (64, 64),
]  # (height, width): one pixel, less than a tile, ragged, square


def splats(n, height, width, seed=0, **changes):
    inputs = compositing.random_splats(np.random.default_rng(seed), n, height, width, **changes)
    a, b, c = inputs["conic"].T
    inputs["cov2d"] = np.stack([c, -b, a], axis=1) / (a * c - b * b)[:, None]
    return dict(inputs, background=np.array([1.0, 0.6, 0.2]), height=height, width=width)


def without_cov(inputs):
    return {name: value for name, value in inputs.items() if name != "cov2d"}


def relative(a, b):
    return np.linalg.norm(np.asarray(a, float) - b) / max(np.linalg.norm(b), 1e-300)


def run(module, inputs, image_bar, **extra):
    out, res = module.forward(**inputs, **extra)
    return out, module.backward(res, image_bar)


@pytest.mark.parametrize("height, width", SIZES)
@pytest.mark.parametrize("alpha", [(0.05, 0.9), (0.9, 1.0)])
def test_loop_and_fast_without_cuts_equal_the_exact_twin(height, width, alpha):
    inputs = splats(60, height, width, alpha=alpha)
    image_bar = np.random.default_rng(1).normal(size=(height, width, 3))
    exact, exact_bars = run(compositing, without_cov(inputs), image_bar)
    for module in (loop, fast):
        out, bars = run(module, inputs, image_bar, settings=EXACT)
        assert np.abs(out.image - exact.image).max() < 1e-12
        assert np.abs(out.transmittance - exact.transmittance).max() < 1e-12
        for name, bar in bars.items():
            assert relative(bar, exact_bars[name]) < 1e-11, (module.__name__, name)


@pytest.mark.parametrize("n, size", [(1000, 64), pytest.param(5000, 128, marks=pytest.mark.slow)])
def test_fast_settings_stay_within_their_declared_error(n, size):
    """Image within 1e-4, gradients within 1e-3 (relative L2) of the exact twin, under a white-noise cotangent."""
    inputs = splats(n, size, size, seed=n)
    image_bar = np.random.default_rng(2).normal(size=(size, size, 3))
    exact, exact_bars = run(compositing, without_cov(inputs), image_bar)
    out, bars = run(fast, inputs, image_bar, settings=FAST)
    assert np.abs(out.image - exact.image).max() <= 1e-4
    for name, bar in bars.items():
        assert relative(bar, exact_bars[name]) <= 1e-3, name


@pytest.mark.parametrize("alpha", [(0.3, 1.0), (0.985, 1.0)])
@pytest.mark.parametrize("height, width", SIZES)
def test_paper_settings_follow_the_kernel_in_both_renderers(height, width, alpha):
    """Tile rectangles of the 3-sigma box, the 1/255 mask, the stop before the splat, the clamp without gradient rule."""
    inputs = splats(80, height, width, seed=3, alpha=alpha)
    image_bar = np.random.default_rng(4).normal(size=(height, width, 3))
    exact, exact_bars = run(loop, inputs, image_bar, settings=PAPER)
    out, bars = run(fast, inputs, image_bar, settings=PAPER._replace(dtype="float64"))
    assert np.abs(out.image - exact.image).max() < 1e-12
    for name, bar in bars.items():
        assert relative(bar, exact_bars[name]) < 1e-11, name


def test_paper_settings_differ_from_exact_where_they_should():
    inputs = splats(80, 29, 43, seed=3)
    exact = compositing.forward(**without_cov(inputs))[0]
    paper = fast.forward(**inputs, settings=PAPER)[0]
    assert 1e-5 < np.abs(paper.image - exact.image).max() < 0.05


def test_ellipse_test_is_exact():
    """A pair is listed exactly where alpha reaches the cut inside the tile's rectangle (dense sampling as oracle)."""
    inputs = splats(300, 40, 48, seed=5, sigma=(0.6, 9.0))
    arrays = [inputs[name] for name in ("mean2d", "cov2d", "conic", "alpha", "depth", "visible")]
    lists = tiles.bin_splats(*arrays, 48, 40, FAST)
    listed = set(zip(lists.tile.tolist(), lists.row.tolist()))
    fine = np.linspace(0, 7, 113)
    wrong = 0
    for tile in range(lists.columns * lists.rows):
        x, y = np.meshgrid(fine + tile % lists.columns * 8, fine + tile // lists.columns * 8)
        for row in range(300):
            e_x, e_y = x - inputs["mean2d"][row, 0], y - inputs["mean2d"][row, 1]
            a, b, c = inputs["conic"][row]
            peak = (
                inputs["alpha"][row]
                * np.exp(-0.5 * (a * e_x**2 + c * e_y**2) - b * e_x * e_y).max()
            )
            if peak >= FAST.cut:
                assert (tile, row) in listed
            wrong += peak < 0.9 * FAST.cut and (tile, row) in listed
    assert wrong <= 0.001 * len(listed)  # only where the sampling misses a peak between its points


def test_lists_are_sorted_by_tile_then_depth_then_index():
    inputs = splats(200, 32, 32, seed=6)
    inputs["depth"] = np.round(inputs["depth"])  # many equal depths
    arrays = [inputs[name] for name in ("mean2d", "cov2d", "conic", "alpha", "depth", "visible")]
    lists = tiles.bin_splats(*arrays, 32, 32, FAST)
    keys = list(zip(lists.tile, inputs["depth"][lists.row], lists.row))
    assert keys == sorted(keys) and len(set(keys)) == len(keys)


def test_cost_follows_the_covered_pixels():
    """The same splats in an image 16 times larger touch the same number of pairs, give or take the border."""
    small, large = splats(400, 64, 64, seed=7), None
    large = dict(small, mean2d=small["mean2d"] + 96, height=256, width=256)
    pairs = [len(fast.forward(**inputs, settings=FAST)[1].lists.row) for inputs in (small, large)]
    assert pairs[1] < 1.4 * pairs[0]
    assert pairs[1] * 64 < 0.15 * 400 * 256 * 256


@pytest.mark.parametrize("settings", [EXACT, PAPER, FAST])
def test_nothing_to_draw_gives_the_background(settings):
    inputs = splats(5, 9, 14)
    for hidden in (
        dict(visible=np.zeros(5, bool)),
        dict(mean2d=inputs["mean2d"] + 1e6),
        dict(alpha=np.zeros(5)),
    ):
        out, res = fast.forward(**{**inputs, **hidden}, settings=settings)
        assert np.array_equal(out.image, np.broadcast_to(out.image[:1, :1], (9, 14, 3)))
        assert np.allclose(out.image[0, 0], inputs["background"])
        bars = fast.backward(res, np.ones((9, 14, 3)))
        assert all(np.isfinite(bar).all() for bar in bars.values()) and not bars["mean2d"].any()


@pytest.mark.parametrize("settings", [EXACT, FAST])
def test_without_occlusion_splats_add_up(settings):
    inputs = splats(40, 19, 23, seed=8)
    image_bar = np.random.default_rng(9).normal(size=(19, 23, 3))
    expected, expected_bars = run(compositing, without_cov(inputs), image_bar, occlusion=False)
    out, bars = run(fast, inputs, image_bar, settings=settings, occlusion=False)
    tolerance = 1e-12 if settings is EXACT else 5e-3  # cut splats add up here: nothing hides them
    assert np.abs(out.image - expected.image).max() < tolerance
    assert all(relative(bars[name], expected_bars[name]) < tolerance for name in bars)


def test_render_gradient_against_finite_differences():
    """Covariance, projection and compositing chained, all inputs moved at once along random directions."""
    rng = np.random.default_rng(10)
    camera = look_at((0.3, -3.0, 1.2), (0, 0, 0), 40, 36, 31, 22, c_x=14.2, c_y=11.7)
    r = rng.normal(size=(25, 4))
    inputs = dict(
        x=rng.normal(size=(25, 3)) * 0.5,
        s=rng.uniform(0.05, 0.3, (25, 3)),
        r=r / np.linalg.norm(r, axis=1, keepdims=True),
        alpha=rng.uniform(0.1, 0.9, 25),
        color=rng.uniform(size=(25, 3)),
        background=np.array([0.2, 0.4, 0.9]),
    )
    image_bar = rng.normal(size=(22, 31, 3))
    for settings in (EXACT, FAST._replace(cut=1e-14, stop=0, dtype="float64")):
        _, res = render.forward(**inputs, camera=camera, settings=settings)
        bars = render.backward(res, image_bar)
        for name, value in inputs.items():
            direction = rng.normal(size=value.shape)
            at = lambda h: np.vdot(
                image_bar,
                render.forward(
                    **{**inputs, name: value + h * direction}, camera=camera, settings=settings
                )[0].image,
            )
            h = 1e-4
            numeric = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
            assert (
                abs(numeric - np.vdot(bars[name], direction))
                <= 1e-7 * np.abs(bars[name] * direction).sum()
            ), name


def test_one_gaussian_in_closed_form():
    """An isotropic Gaussian on the axis: alpha at r pixels is o exp(-r^2 / (2 (f^2 s^2 / z^2 + 0.3)))."""
    camera = look_at((0, -2, 0), (0, 0, 0), 50, 50, 21, 21)
    out, _ = render.forward(
        np.zeros((1, 3)),
        np.full((1, 3), 0.1),
        np.array([[1.0, 0, 0, 0]]),
        np.array([0.7]),
        np.ones((1, 3)),
        camera,
        np.zeros(3),
        EXACT,
    )
    y, x = np.mgrid[:21, :21] - 10.0
    expected = 0.7 * np.exp(-(x**2 + y**2) / (2 * (2.5**2 + 0.3)))
    assert np.allclose(out.image, expected[:, :, None], atol=1e-12)
