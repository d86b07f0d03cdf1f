"""Warnings about trainings that cannot learn or did not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.cli import text
from p4dgs_ref.scenes import packaged_scenes
from p4dgs_ref.training import advice
from p4dgs_ref.training.fit import fit
from p4dgs_ref.training.presets import TINY
from p4dgs_ref.training.trainer import Trainer
from tests.sampling import few
from tests.training.bars import Share, moving, scene


def messages(function, *args, **kwargs):
    """The texts of the warnings that a call gives, but for those of kernels and of old packages."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        function(*args, **kwargs)
    texts = [str(warning.message) for warning in seen if warning.category is UserWarning]
    return [text for text in texts if not text.startswith("the kernels are")]


def test_few_views_are_told_of_in_one_line():
    told = advice.few_views(scene(advice.FEW_VIEWS - 1))
    assert f"{advice.FEW_VIEWS - 1} training views" in told and "\n" not in told
    assert not advice.few_views(scene(advice.FEW_VIEWS))


@pytest.mark.parametrize(
    "change, count",
    [
        ({}, 0),
        (
            {
                "image": np.full((12, 16, 3), 0.5)
                + 0.05 * (np.indices((12, 16)).sum(0) % 2)[..., None]
            },
            4,
        ),
        ({"image": np.linspace((0.5, 0.2, 0.1), (0.5, 0.2, 0.9), 192).reshape(12, 16, 3)}, 0),
    ],
)
def test_pictures_without_content_are_counted(change, count):
    """A good score on them means nothing: an empty model has it, too."""
    full = moving()
    told = advice.empty_pictures(replace(full, train=[replace(v, **change) for v in full.train]))
    assert "\n" not in told and bool(told) == bool(count)
    assert f": {count} of 5 pictures show hardly more than one colour; good" in told or not count


CLOUD = np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3))
OUTSIDE = [[0, 0, 50.0]] * 100 + np.arange(100)[:, None]
BEFORE_A_LENS = np.array([3, 0, 1]) * (1 - np.linspace(0.01, 0.05, 100))[:, None]
POINTS = [
    (CLOUD, []),
    (CLOUD / 1e6, ["of 500 starting points", "499 lost by merging", "in a voxel (0.001)"]),
    (np.vstack([CLOUD, [[0, 1e5, 0]]]), ["of 501", "1 more than 10 times as far"]),
    (np.vstack([CLOUD, OUTSIDE]), ["of 600", "100 outside every training view"]),
    (np.vstack([CLOUD, BEFORE_A_LENS]), ["of 600", "100 outside every training view"]),
    (np.vstack([CLOUD, CLOUD[:55]]), []),
    (np.vstack([CLOUD, CLOUD[:56]]), ["of 556", "56 lost by merging"]),
]


@pytest.mark.parametrize("points, words", POINTS)
def test_starting_points_that_training_cannot_use_are_counted(points, words):
    told = advice.odd_points(scene(30), TINY.voxel, points)
    assert bool(told) == bool(words) and "\n" not in told
    assert [word for word in words if word not in told] == [], told


def test_points_at_the_right_edge_of_a_wide_picture_are_seen():
    points = [[0, 1.0, 0.7], [0, 1.25, 0.7]]  # 14.8 and 16.5 pixels from the left edge, of 16
    told = advice.odd_points(scene(1), 1e-3, np.array(points))
    assert "1 outside every training view" in told


@pytest.mark.parametrize("shift, is_told", [(0.9, False), (1.1, True)])
def test_cameras_that_look_past_the_starting_points_are_told_of_with_both_numbers(shift, is_told):
    """The cameras look at a place `shift` from the middle of points that reach as far as 1."""
    points = [[x, y, z + shift] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    told = advice.odd_points(scene(30), 1e-3, np.array(points))
    numbers = "cameras look at a place 1.1 from their middle, and they reach 1"
    assert (numbers in told) == is_told


@pytest.mark.parametrize("share, is_told", [(0, True), (0.36, True), (0.38, False), (1, False)])
def test_how_much_is_there_of_what_moves(share, is_told):
    """With this share of the truth, the error shrinks by the factor (1 - share)**2."""
    told = advice.warning_after(Share(moving(), share))
    assert bool(told) == is_told and "\n" not in told
    if is_told:
        mean, seen = Share(moving(), 0).mean, moving().test[0].image
        bar = seen[:, :, 0] < 1  # 2 of 16 columns
        flat = -10 * np.log10(np.mean((seen - mean)[bar] ** 2))
        there = f"{1 - (1 - share) ** 2:.0%}"
        view = f"{there} in the view images[4] (time 1): in these pixels of test views"
        assert f"only {there} of what moves is drawn, {view}" in told
        assert f"training pictures {flat:.2f} dB" in told and "larger bodies" in told
        assert "seed" in told
    without = replace(moving(), test=[])
    assert bool(advice.warning_after(Share(without, share))) == is_told


def test_a_mover_of_which_half_is_lost_is_told_of():
    """One of its two columns of pixels is drawn, the other one shows the mean: 3.0 dB."""
    bars = moving()
    half, whole, none = (Share(bars, share) for share in (1, 1, 0))
    columns = (np.arange(16) % 2 == 0)[:, None]
    half.render = lambda *at: np.where(columns, whole.render(*at), none.render(*at))
    told = advice.warning_after(half)
    assert "only 50% of what moves is drawn" in told, told


@pytest.mark.parametrize("at_the_end, is_told", [(0.2, True), (0.6, False)])
def test_a_limb_that_is_lost_in_some_views_is_told_of_by_the_worst(at_the_end, is_told):
    """Over all views nine tenths of what moves are there: the mean over views hides the loss."""
    bars = moving()
    views = [replace(bars.train[i % 4], name=f"{i}", time=i / 9) for i in range(10)]
    views = [replace(v, camera=replace(v.camera)) for v in views]
    whole, poor = (Share(replace(bars, test=views), share) for share in (1, at_the_end))
    last = views[-1].camera
    whole.render = lambda c, *at: (poor if c is last else Share(whole.scene, 1)).render(c, *at)
    told = advice.warning_after(whole)
    assert bool(told) == is_told
    assert "is drawn, 36% in the view 9 (time 1)" in told or not is_told


def noise(scene):
    """The scene with pictures that show something in every pixel, as photographs do."""
    rng = np.random.default_rng(0)
    views = [replace(v, image=rng.uniform(0, 0.8, v.image.shape)) for v in scene.train]
    return replace(scene, train=views)


def around(radius, outwards=False, turned=0.0, count=12):
    """Photographs of 53 degrees from a circle of cameras that look inwards, or outwards."""
    cameras = []
    for a in turned * np.linspace(0, 2 * np.pi, count, endpoint=False):
        place = radius * np.array([np.cos(a), np.sin(a), 0.1])
        cameras.append(p4.look_at(place, place * 2 if outwards else (0, 0, 0), 32, 32, 32, 32))
    image = np.zeros((32, 32, 3))
    return noise(p4.Scene.from_arrays([image] * count, cameras, [0.0] * count))


# Photographs of what surrounds an object, of a room from outside and from its middle, of a wall;
# then with a box that is large enough, and small things on a plain background.
SEEN = [
    (around(4, turned=1), 1, "within 1.9 of the origin, 71% outside"),
    (around(4, turned=0.2), 1, "outside the box of the first anchors; try --set extent=1.9"),
    (around(3, outwards=True, turned=1), 1, "100% outside"),
    (around(4, turned=1), 2, ""),
    (around(3, outwards=True, turned=1), 7, ""),
    (scene(30), 1, ""),
    (scene(30), 1000, "try --set extent=0."),
    (around(4, turned=0), 4, "all 12 training views are from one place"),
]


@pytest.mark.parametrize("given, extent, words", SEEN)
def test_what_cameras_see_outside_the_box_of_anchors_is_told_of(given, extent, words):
    told = advice.small_box(given, extent)
    assert bool(told) == bool(words) and words in told
    assert "\n" not in told and ("(--points)" in told or not words)


@pytest.mark.parametrize("name", packaged_scenes())
def test_packaged_scenes_lie_in_the_box(name):
    scene = p4.load_scene(name)
    if scene.points is None:
        assert not advice.small_box(scene, TINY.extent)


def test_points_are_asked_of_no_box():
    for points in (None, CLOUD):
        trainer = Trainer(replace(around(4, turned=1), points=points), TINY)
        lines = [line for line in advice.warnings_before(trainer) if "--set extent" in line]
        assert len(lines) == (points is None)


def test_that_nothing_is_drawn_is_told_after_the_first_round():
    told = messages(fit, moving(), "smoke", tau_alpha=1, stage_ends=(5, 6, 7, 8))
    assert len(told) == 1 and "after a round of all views" in told[0] and "tau_alpha=1" in told[0]
    assert not messages(fit, moving(), "smoke", stage_ends=(5, 6, 7, 8))


def test_a_mover_over_something_static_is_lost_though_the_picture_is_good():
    """A wall fills half of the picture: the whole picture has 14 dB more than its moving part."""
    wall = moving()
    for view in (*wall.train, *wall.test):
        view.image[:, :4] = 0.5
    seen = Share(wall, 0)
    assert "only 0% of what moves is drawn" in advice.warning_after(seen)


def at_one_time(scene):
    """The scene with all views at the time 0.5."""
    still = {
        part: [replace(v, time=0.5) for v in getattr(scene, part)] for part in ("train", "test")
    }
    return replace(scene, **still)


@pytest.mark.parametrize(
    "still", [replace(moving(), effects=("occlusion",)), at_one_time(moving())]
)
def test_a_still_scene_is_compared_with_the_mean_picture_in_all_pixels(still):
    """Its model at rest is the picture itself, which would leave the wrong pixels alone."""
    told = advice.warning_after(Share(still, 0.3))
    assert "only 51% of what is seen is drawn" in told and "moves" not in told
    assert "(extent) or points (--points)" in told and "bodies" not in told
    assert not advice.warning_after(Share(still, 0.5))


@pytest.mark.parametrize(
    "setting", [dict(tau_alpha=1), dict(min_opacity=1e9, mask_from=0, grow_every=2)]
)
def test_a_training_that_draws_nothing_says_so_once_with_its_settings(setting):
    told = messages(p4.train, moving(), "smoke", stage_ends=(1, 2, 3, 4), **setting)
    assert len(told) == 2 and "4 training views" in told[0]
    tau, least = setting.get("tau_alpha", 0), setting.get("min_opacity", TINY.min_opacity)
    assert "draws nothing: every child is masked" in told[1] and "\n" not in told[1]
    assert f"(min_opacity={least:g}), below tau_alpha={tau:g} or outside" in told[1]


def test_a_scene_in_which_nothing_is_wrong_is_not_told_of():
    still = Share(scene(3), 1)
    still.render = lambda camera, t, settings: scene(3).train[0].image
    assert not advice.warning_after(still)


WARNINGS = [
    "training views",
    "1 of 5 pictures show hardly more than one colour",
    "8 lost by merging",
    "of what moves is drawn",
]


def check_told(told):
    """Check that lines are the warnings with the words of WARNINGS, in their order."""
    missing = [word for word in WARNINGS if not any(word in line for line in told)]
    assert not missing, f"no warning says: {', '.join(missing)}"
    assert [word in line for word, line in zip(WARNINGS, told, strict=True)] == [True] * 4, told


def odd():
    """A scene of few views, a blank picture and points that merge, which nobody can learn."""
    view, *others = moving().train
    blank = replace(view, image=np.ones_like(view.image))
    return replace(moving(), train=[blank, *others], points=np.zeros((9, 3)))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("work", few([p4.train, p4.main_job], 1))
def test_training_warns_before_and_after(work, tmp_path):
    told = messages(work, odd(), "smoke", folder=tmp_path, stage_ends=(1, 2, 3, 4))
    overfitted = [line for line in told if "has learned the training" in line]
    assert len(overfitted) == (work is p4.main_job)
    check_told([line for line in told if line not in overfitted])


@pytest.mark.filterwarnings("error")
def test_the_command_line_prints_a_warning_at_once_and_as_one_line(capsys, monkeypatch):
    """Also under `python -W error`, which would make a traceback of it."""
    working = "the work goes on"
    monkeypatch.setattr(
        text,
        "preset",
        lambda *args: warnings.warn("views:\x1b\nfew") or cli.print_message(working),
    )
    assert cli.run(["presets", "tiny"], 0.0) == 0
    told = capsys.readouterr().err.splitlines()
    assert told == ["p4dgs-ref: warning: views:\\x1b\\nfew", f"p4dgs-ref: {working}"]
