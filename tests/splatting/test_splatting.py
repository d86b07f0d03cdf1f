"""The renderers against each other: the readable loop, the exact twin and the fast one."""

import tracemalloc

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.splatting import compositing, fast, loop, render, tiles
from p4dgs_ref.splatting.camera import look_at
from p4dgs_ref.splatting.settings import EXACT, FAST, KERNEL
from tests import ROOT
from tests.sampling import few
from tests.workshop import needles
from tests.workshop.cases.compositing import random_splats

# (height, width): one pixel, less than a tile, not a multiple of a tile, square.
SIZES = [(1, 1), (5, 3), (29, 43), (64, 64)]


def splats(n, height, width, seed=0, **changes):
    """Random splats and a background, as `fast` and `loop` take them."""
    inputs = random_splats(np.random.default_rng(seed), n, height, width, **changes)
    a, b, c = inputs["conic"].T
    inputs["cov2d"] = np.stack([c, -b, a], axis=1) / (a * c - b * b)[:, None]
    return dict(inputs, background=np.array([1.0, 0.6, 0.2]), height=height, width=width)


def run(module, inputs, image_bar, **extra):
    """Image, transmittance and gradients; `compositing` needs no covariance."""
    if module is compositing:
        inputs = {name: value for name, value in inputs.items() if name != "cov2d"}
    (image, transmittance), saved = module.forward(**inputs, **extra)
    return image, transmittance, module.backward(saved, image_bar)


def bin_splats(inputs, settings=FAST):
    names = ("mean2d", "cov2d", "conic", "alpha", "depth", "visible", "width", "height")
    return tiles.bin_splats(*(inputs[name] for name in names), settings)


@pytest.mark.parametrize("x, listed", [(5.5, [0]), (6.5, [0, 1, 2]), (8.5, [1, 2, 3]), (9.5, [3])])
def test_the_edge_of_a_tile(x, listed):
    """A disc of radius 2 around (x, x); of four tiles, the first has the pixels 0 to 7."""
    disc = dict(mean2d=[[x, x]], cov2d=[[1, 0, 1]], conic=[[1, 0, 1]], alpha=[0.5], depth=[1])
    arrays = {name: np.array(value, float) for name, value in disc.items()}
    radius_2 = FAST._replace(cut=0.5 * np.exp(-2))
    lists = bin_splats(dict(arrays, visible=np.array([True]), width=16, height=16), radius_2)
    assert lists.tile.tolist() == listed, f"tiles with an edge at 8 that a disc around {x} meets"


@pytest.mark.parametrize("width, height", [(21, 12), (64, 7)])
def test_a_camera_without_a_principal_point_has_it_in_the_middle_of_the_pixels(width, height):
    camera = look_at((0, -2, 0), (0, 0, 0), 50, 40, width, height)
    assert (camera.c_x, camera.c_y) == (np.arange(width).mean(), np.arange(height).mean())
    assert (camera.f_x, camera.f_y, camera.width, camera.height) == (50, 40, width, height)
    given = look_at((0, -2, 0), (0, 0, 0), 50, 40, width, height, c_x=3, c_y=4)
    assert (given.c_x, given.c_y) == (3, 4)
    with pytest.raises(ValueError, match="not on one line"):
        look_at((0, 0, 2), (0, 0, 0), 50, 40, width, height)


def relative(a, b):
    return np.linalg.norm(np.asarray(a, float) - b) / max(np.linalg.norm(b), 1e-300)


def largest(a, b):
    return np.abs(a - b).max()


@pytest.mark.parametrize("height, width", SIZES)
@pytest.mark.parametrize("alpha", [(0.05, 0.9), (0.9, 1.0)])
def test_loop_and_fast_without_cuts_equal_the_exact_twin(height, width, alpha):
    inputs = splats(60, height, width, alpha=alpha)
    image_bar = np.random.default_rng(1).normal(size=(height, width, 3))
    exact, exact_T, exact_bars = run(compositing, inputs, image_bar)
    for module in (loop, fast):
        image, T, bars = run(module, inputs, image_bar, settings=EXACT)
        assert largest(image, exact) < 1e-12 and largest(T, exact_T) < 1e-12
        assert bars.keys() == exact_bars.keys()
        for name, bar in bars.items():
            assert relative(bar, exact_bars[name]) < 1e-11, (module.__name__, name)


def test_the_fast_renderer_ends_where_no_tile_lets_light_through():
    """A hundred wide opaque splats: none of the ranks behind the first 32 can be seen."""
    inputs = splats(100, 8, 8, alpha=(0.98, 0.99))
    inputs["mean2d"][:] = 4
    inputs["conic"][:], inputs["cov2d"][:] = [1e-4, 0, 1e-4], [1e4, 0, 1e4]
    image, T, _ = run(fast, inputs, np.ones((8, 8, 3)), settings=FAST)
    exact, *_ = run(compositing, inputs, np.ones((8, 8, 3)))
    assert largest(image, exact) < FAST.stop + 1e-6 and T.max() < FAST.stop
    _, (chunks, *_) = fast.forward(**inputs, settings=FAST)
    assert len(chunks) == 1


def test_the_loop_draws_the_rectangles_of_the_fast_renderer():
    """The kernel's square ends 25 pixels from a splat with sigma 8; alpha is 0.01 there, not 0."""
    inputs, image_bar = splats(1, 70, 90, alpha=(0.9, 1.0)), np.ones((70, 90, 3))
    inputs["conic"][:], inputs["cov2d"][:] = [1 / 64, 0, 1 / 64], [64, 0, 64]
    inputs["mean2d"][:] = 16 + 25.01
    double = KERNEL._replace(dtype="float64")
    image, T, bars = run(fast, inputs, image_bar, settings=double)
    looped, looped_T, looped_bars = run(loop, inputs, image_bar, settings=double)
    assert largest(looped, image) < 1e-12 and largest(looped_T, T) < 1e-12
    for name, bar in bars.items():
        assert relative(looped_bars[name], bar) < 1e-11, name


@pytest.mark.parametrize("ratio", few(needles.RATIOS, 1))
def test_needles_have_all_their_digits_in_every_renderer(ratio):
    """Image and every number of the gradients, against decimals, in both precisions."""
    gaussians, image_bar = needles.needle(ratio)
    image, bars = needles.truth(ratio)
    double = FAST._replace(dtype="float64", cut=1e-16, stop=0.0)
    for settings, precision in ((EXACT, 1e-12), (double, 1e-12), (FAST, 1e-4)):
        (found, *_), saved = render.forward(**gaussians, camera=needles.CAMERA, settings=settings)
        found_bars = render.backward(saved, image_bar)
        np.testing.assert_allclose(found, image, rtol=precision)
        for name, bar in bars.items():
            np.testing.assert_allclose(found_bars[name], bar, precision, err_msg=name)
    places = (gaussians[name] for name in ("x", "s", "r"))
    projected, _ = render.project(*places, needles.CAMERA, EXACT)
    names = ("mean2d", "cov2d", "conic", "depth", "visible")
    looks = {name: gaussians[name] for name in ("alpha", "color", "background")}
    size = dict(height=needles.CAMERA.height, width=needles.CAMERA.width)
    (found, _), _ = loop.forward(**dict(zip(names, projected)), **looks, **size, settings=EXACT)
    np.testing.assert_allclose(found, image, rtol=1e-12)


@pytest.mark.parametrize(
    "alpha, least, most", few([((0.05, 0.9), 1e-5, 1e-4), ((0, FAST.cut), 1e-4, 1e-3)], 1)
)
def test_what_fast_settings_leave_out_bounds_their_error(alpha, least, most):
    """Alphas below the cut and the transmittance at the stop bound the error of a pixel.

    Gradients are within 1e-3 of the exact twin, for a random cotangent, unless all is left out.
    """
    inputs = splats(1000, 64, 64, seed=1000, alpha=alpha)
    image_bar = np.random.default_rng(2).normal(size=(64, 64, 3))
    exact, _, exact_bars = run(compositing, inputs, image_bar)
    image, _, bars = run(fast, inputs, image_bar, settings=FAST)
    y, x = np.mgrid[:64, :64].reshape(2, 1, -1)
    shown, *_ = compositing.alphas(inputs["mean2d"], inputs["conic"], inputs["alpha"], 0.99, x, y)
    left_out = np.where(shown < FAST.cut, shown, 0).sum(axis=0).reshape(64, 64, 1)
    assert (np.abs(image - exact) <= FAST.stop + left_out + 1e-6).all()
    assert least < largest(image, exact) < most
    for name, bar in bars.items():
        assert alpha[1] == FAST.cut or relative(bar, exact_bars[name]) <= 1e-3, name


@pytest.mark.parametrize("file", [*ROOT.glob("tutorials/demo.p4dgs")])
def test_the_error_on_a_trained_file_is_the_one_that_the_settings_state(file):
    model, view = p4.decode(file.read_bytes()), p4.load_scene("orbit").test[1]
    images = [model.render(view.camera, view.time, settings) for settings in (FAST, EXACT)]
    assert largest(*images) == pytest.approx(1.84e-4, abs=5e-6)
    assert (FAST.cut, FAST.stop) == (5e-5, 1e-4)


def test_equal_depths_stay_in_the_order_of_their_index():
    """An unstable sort would show with some hundred depths of few values.

    The other stable sort of the renderer, by the number of splats in a tile, only has to put
    tiles of similar length into one group: every tile is composited by itself.
    """
    rng = np.random.default_rng(8)
    depth, visible = rng.integers(0, 4, 999) / 4, rng.random(999) < 0.7
    wanted = sorted(np.flatnonzero(visible).tolist(), key=lambda row: depth[row])
    assert compositing.depth_order(depth, visible, True).tolist() == wanted


def test_ellipse_test_is_exact():
    """A pair is listed exactly where alpha reaches the cut inside the tile's rectangle.

    The peak of alpha in a tile is found by dense sampling, which can only miss a little of it.
    """
    inputs = splats(300, 40, 48, seed=5, sigma=(0.6, 9.0))
    lists = bin_splats(inputs)
    listed = set(zip(lists.tile.tolist(), lists.splat.tolist()))
    fine, superfluous = np.linspace(0, 7, 113), 0
    (m_x, m_y), (a, b, c) = (inputs[name].T[:, :, None, None] for name in ("mean2d", "conic"))
    for tile in range(lists.columns * lists.rows):
        x_0, y_0 = tile % lists.columns * 8, tile // lists.columns * 8
        e_x, e_y = fine + x_0 - m_x, fine[:, None] + y_0 - m_y
        form = (a * e_x**2 + c * e_y**2 + 2 * b * e_x * e_y).min(axis=(1, 2))
        nearest = tiles.nearest_form(inputs["mean2d"], inputs["conic"], x_0, y_0, 7)
        assert (nearest <= form + 1e-12).all()
        peak = inputs["alpha"] * np.exp(-0.5 * form)
        assert listed.issuperset((tile, row) for row in np.flatnonzero(peak >= FAST.cut))
        superfluous += sum((tile, row) in listed for row in np.flatnonzero(peak < 0.9 * FAST.cut))
    assert superfluous <= 0.001 * len(listed)


@pytest.mark.parametrize("settings", [EXACT, KERNEL, FAST])
@pytest.mark.parametrize("hidden", ["not visible", "off the image", "transparent"])
def test_nothing_to_draw_gives_the_background(hidden, settings):
    inputs = splats(5, 9, 14)
    if hidden == "not visible":
        inputs["visible"] = np.zeros(5, bool)
    elif hidden == "off the image":
        inputs["mean2d"] = inputs["mean2d"] + 1e20
    else:
        inputs["alpha"] = np.zeros(5)
    image, _, bars = run(fast, inputs, np.ones((9, 14, 3)), settings=settings)
    looped, *_ = run(loop, inputs, np.ones((9, 14, 3)), settings=settings)
    assert largest(looped, image) < 1e-7
    assert np.array_equal(image, np.broadcast_to(image[:1, :1], (9, 14, 3)))
    assert np.allclose(image[0, 0], inputs["background"])
    assert all(np.isfinite(bar).all() for bar in bars.values()) and not bars["mean2d"].any()


@pytest.mark.parametrize("occlusion", [True, False])
@pytest.mark.parametrize("settings", [EXACT, KERNEL, FAST])
def test_without_gradients_the_picture_is_the_same(settings, occlusion):
    inputs = splats(300, 90, 120, seed=13, alpha=(0.4, 1.0))
    (image, T), saved = fast.forward(**inputs, settings=settings, occlusion=occlusion)
    (alone, alone_T), nothing = fast.forward(
        **inputs, settings=settings, occlusion=occlusion, keep=False
    )
    assert np.array_equal(alone, image) and np.array_equal(alone_T, T)
    assert saved[0] and nothing is None


@pytest.mark.parametrize("settings", [EXACT, KERNEL, FAST])
@pytest.mark.parametrize("wrong", [np.nan, -0.3])
def test_opacities_that_are_nan_or_negative_are_refused(settings, wrong):
    """Lists of tiles would leave such a Gaussian out in silence, and the exact twin would not."""
    with pytest.raises(ValueError, match=r"alpha\[1\] is (nan|-0.3): expected at least 0"):
        render.forward(
            x=np.zeros((2, 3)),
            s=np.full((2, 3), 0.1),
            r=np.array([[1.0, 0, 0, 0]] * 2),
            alpha=np.array([0.7, wrong]),
            color=np.ones((2, 3)),
            camera=look_at((0, -2, 0), (0, 0, 0), 50, 50, 21, 21),
            background=np.zeros(3),
            settings=settings,
        )


# --- memory ---
@pytest.mark.parametrize("height, width", few([(90, 120), (131, 50), (29, 43)], 1))
@pytest.mark.parametrize("settings, occlusion", [(FAST, True), (FAST, False), (KERNEL, True)])
def test_a_picture_with_too_many_pairs_is_drawn_in_halves(
    monkeypatch, height, width, settings, occlusion
):
    """Down to single tiles, which are drawn whatever their pairs; gradients are halved, too."""
    inputs = splats(300, height, width, seed=13, alpha=(0.4, 1.0))
    image_bar = np.random.default_rng(1).normal(size=(height, width, 3))
    looks = dict(settings=settings, occlusion=occlusion)
    image, T, bars = run(fast, inputs, image_bar, **looks)
    for most in (0, 100):
        monkeypatch.setattr(tiles, "MAX_PAIRS", most)
        assert bin_splats(inputs, settings) is None
        halved, halved_T, halved_bars = run(fast, inputs, image_bar, **looks)
        assert halved.shape == image.shape and halved_T.shape == T.shape
        assert largest(halved, image) < 1e-6 and largest(halved_T, T) < 1e-6
        assert halved_bars.keys() == bars.keys()
        for name, bar in bars.items():
            assert relative(halved_bars[name], bar) < 3e-6, name
        (alone, alone_T), nothing = fast.forward(**inputs, **looks, keep=False)
        assert np.array_equal(alone, halved) and np.array_equal(alone_T, halved_T)
        assert nothing is None


@pytest.mark.parametrize("n, scale", few([(2000, 0.06), (100, 0.5), (10_000, 0.004)], 1))
def test_the_number_of_pairs_bounds_the_memory(monkeypatch, n, scale):
    """Both passes stay below what `MAX_PAIRS` promises, in one piece and in many."""
    rng = np.random.default_rng(0)
    camera = look_at((0, -3.6, 0), (0, 0, 0), 300, 300, 256, 256)
    r = rng.normal(size=(n, 4))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    x, alpha = rng.uniform(-1, 1, (n, 3)), rng.uniform(0.01, 0.05, n)
    inputs = x, np.full((n, 3), scale), r, alpha, np.ones((n, 3)), camera, np.ones(3), FAST
    counts, peaks, runs = [], [], tiles.runs
    monkeypatch.setattr(
        tiles, "runs", lambda first, count: counts.append(count.sum()) or runs(first, count)
    )
    render.forward(*inputs, keep=False)
    pairs = counts[1]  # after the rows of tiles; just enough, then an eighth
    for most in (pairs, pairs // 8):
        monkeypatch.setattr(tiles, "MAX_PAIRS", most)
        tracemalloc.start()
        try:
            (image, *_), saved = render.forward(*inputs)
            render.backward(saved, np.ones_like(image))
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        assert max(counts[1::2]) <= most
        assert peaks[-1] <= 500 * most + 600 * n + 8 * fast.RANKS * fast.GROUP * image.itemsize
        counts.clear()
    assert peaks[1] < peaks[0]


def test_the_most_pairs_need_at_most_6_gb():
    """500 bytes a pair is what the test above allows."""
    assert 2e9 < 500 * tiles.MAX_PAIRS < 6e9
