"""Warnings about trainings that cannot learn or did not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.cli import text
from p4dgs_ref.scenes.load import find_scene
from p4dgs_ref.training import advice
from p4dgs_ref.training.presets import TINY
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
    (CLOUD, 1, []),
    (CLOUD / 1e6, 1, ["of 500 starting points", "499 sharing the voxel", "(voxel 0.001)"]),
    (np.vstack([CLOUD, [[0, 1e5, 0]]]), 1, ["of 501", "1 more than 10 times as far"]),
    (np.vstack([CLOUD, OUTSIDE]), 1, ["of 600", "100 outside every training view"]),
    (np.vstack([CLOUD, BEFORE_A_LENS]), 1, ["of 600", "100 outside every training view"]),
    (np.vstack([CLOUD, CLOUD[:55]]), 1, []),
    (np.vstack([CLOUD, CLOUD[:56]]), 1, ["of 556", "56 sharing the voxel"]),
    (None, 1, []),
    (None, 1000, ["of 200 starting points", "outside every training view"]),
]


@pytest.mark.parametrize("points, extent, words", POINTS)
def test_starting_points_that_training_cannot_use_are_counted(points, extent, words):
    preset = replace(TINY, extent=extent)
    told = advice.odd_points(replace(scene(30), points=points), preset, 0, None)
    assert bool(told) == bool(words) and "\n" not in told
    assert [word for word in words if word not in told] == [], told
    assert advice.odd_points(scene(30), preset, 0, points) == told


def test_points_at_the_right_edge_of_a_wide_picture_are_seen():
    points = [[0, 1.0, 0.7], [0, 1.25, 0.7]]  # 14.8 and 16.5 pixels from the left edge, of 16
    told = advice.odd_points(scene(1), replace(TINY, voxel=1e-3), 0, np.array(points))
    assert "1 outside every training view" in told


def test_points_that_a_camera_sees_are_not_projected_again(monkeypatch):
    """100,000 points in 48 views would take a quarter of a minute before the first step."""
    project, rows = advice.render.project, []
    monkeypatch.setattr(
        advice.render, "project", lambda x, *rest: rows.append(len(x)) or project(x, *rest)
    )
    assert not advice.odd_points(scene(30), TINY, 0, CLOUD)
    assert len(rows) == 30 and sum(rows) < 2 * len(CLOUD)


@pytest.mark.parametrize("shift, is_told", [(0.9, False), (1.1, True)])
def test_cameras_that_look_past_the_starting_points_are_told_of_with_both_numbers(shift, is_told):
    """The cameras look at a place `shift` from the middle of points that reach as far as 1."""
    points = [[x, y, z + shift] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    told = advice.odd_points(scene(30), replace(TINY, voxel=1e-3), 0, np.array(points))
    numbers = "cameras look 1.1 from their middle, they reach 1"
    assert (numbers in told) == is_told


@pytest.mark.parametrize("share, is_told", [(0, True), (0.36, True), (0.38, False), (1, False)])
def test_how_much_is_there_of_what_moves(share, is_told):
    """With this share of the truth, the error shrinks by the factor (1 - share)**2."""
    told = advice.after(Share(moving(), share))
    assert bool(told) == is_told and "\n" not in told
    if is_told:
        mean, seen = Share(moving(), 0).mean, moving().test[0].image
        bar = seen[:, :, 0] < 1  # 2 of 16 columns
        flat = -10 * np.log10(np.mean((seen - mean)[bar] ** 2))
        assert f"only {1 - (1 - share) ** 2:.0%} of what moves is there: in these pixels" in told
        assert f"training pictures {flat:.2f} dB" in told and "of test views" in told
        assert "seed" in told
    without = replace(moving(), test=[])
    assert bool(advice.after(Share(without, share))) == is_told


def test_a_mover_of_which_half_is_lost_is_told_of():
    """One of its two columns of pixels is drawn, the other one shows the mean: 3.0 dB."""
    bars = moving()
    half, whole, none = (Share(bars, share) for share in (1, 1, 0))
    columns = (np.arange(16) % 2 == 0)[:, None]
    half.render = lambda *at: np.where(columns, whole.render(*at), none.render(*at))
    told = advice.after(half)
    assert "only 50% of what moves is there" in told, told


def test_a_mover_over_something_static_is_lost_though_the_picture_is_good():
    """A wall fills half of the picture: the whole picture has 14 dB more than its moving part."""
    wall = moving()
    for view in (*wall.train, *wall.test):
        view.image[:, :4] = 0.5
    seen = Share(wall, 0)
    assert "only 0% of what moves is there" in advice.after(seen)


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
    told = advice.after(Share(still, 0.3))
    assert "only 51% of what is seen is there" in told and "moves" not in told
    assert not advice.after(Share(still, 0.5))


@pytest.mark.parametrize(
    "setting", [dict(tau_alpha=1), dict(min_opacity=1e9, mask_from=0, grow_every=2)]
)
def test_a_training_that_draws_nothing_says_so_once_with_its_settings(setting):
    told = messages(p4.train, moving(), "smoke", stage_ends=(1, 2, 3, 4), **setting)
    assert len(told) == 2 and "4 training views" in told[0]
    tau, least = setting.get("tau_alpha", 0), setting.get("min_opacity", TINY.min_opacity)
    assert "draws nothing: every child is masked" in told[1] and "\n" not in told[1]
    assert f"(min_opacity={least:g}) or below tau_alpha={tau:g}" in told[1]


def test_a_scene_in_which_nothing_is_wrong_is_not_told_of():
    still = Share(scene(3), 1)
    still.render = lambda camera, t, settings: scene(3).train[0].image
    assert not advice.after(still)


WARNINGS = [
    "training views",
    "1 of 5 pictures show hardly more than one colour",
    "8 sharing the voxel",
    "of what moves is there",
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
    overfitted = [line for line in told if "knows the pictures better" in line]
    assert len(overfitted) == (work is p4.main_job)
    check_told([line for line in told if line not in overfitted])


def test_the_command_prints_every_warning_beside_its_result(tmp_path, capsys, monkeypatch):
    given = replace(odd(), source=find_scene("static"))
    monkeypatch.setattr(p4, "load_scene", lambda *_, **__: given, raising=False)
    short = ["--preset", "smoke", "--set", "stage_ends=1,2,3,4", "--quiet"]
    assert cli.run(["train", "static", *short, "-o", str(tmp_path / "run")], 0.0) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "warning: " in line]
    check_told(told)


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
