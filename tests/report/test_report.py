"""The report of a run: measures against independent sums, pictures, all files or none."""

import csv
import io
import json
import math
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.cli import text
from p4dgs_ref.codec.container import EncodeError
from p4dgs_ref.output import OutputError
from p4dgs_ref.report import figures as report
from p4dgs_ref.report import jobs as job
from p4dgs_ref.report.evaluate import explicit_bytes, names_in_training, psnr, score
from p4dgs_ref.training import advice
from p4dgs_ref.training.fit import CHECKPOINT, fit
from p4dgs_ref.training.progress import COLUMNS
from tests.sampling import few
from tests.tutorials import drawn

pytestmark = pytest.mark.filterwarnings("ignore:.*scene bouncing")  # 45 steps learn nothing
PICTURES = {"comparison.png", "motion.gif", "size.png", "training.png"}
TABLES = {"comparison.csv", "size.csv", "training.csv"}
# Masks and statistics are in use when stage 4 begins.
CHANGES = {"Q_O": 0.2, "grow_every": 4, "mask_from": 10, "min_opacity": 0.2}


@pytest.fixture(scope="module")
def scene():
    return p4.load_scene("bouncing", downscale=4)


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    """A report and the metrics that the job returned."""
    folder = tmp_path_factory.mktemp("place") / "deep" / "report"
    return folder, p4.main_job(scene, "smoke", 2, folder, **CHANGES)


def table(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "place, name, error",
    [
        (job, "encode", EncodeError),
        (job, "decode", MemoryError),
        (job, "evaluate", ValueError),
        (advice, "warning_after", KeyboardInterrupt),
        (report, "write_motion", OSError),
    ],
)
def test_a_training_is_kept_whatever_fails_after_it(scene, tmp_path, place, name, error):
    """The checkpoint is saved before anything is measured; one line says where it is."""
    folder = tmp_path / "new"

    def fail(*args, **named):
        raise error("no ink")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(error, match="no ink"):
        patch.setattr(place, name, fail)
        with pytest.warns(UserWarning, match="the training is kept in .*new/checkpoint.npz"):
            job.main_job(scene, "smoke", 2, folder, **CHANGES)
    assert [path.name for path in folder.iterdir()] == [CHECKPOINT]
    trainer = fit(scene, "smoke", 2, folder=folder, resume=True, **CHANGES)
    assert trainer.iteration == 45 and trainer.history
    with pytest.raises(OutputError, match="checkpoint.npz: exists"):
        job.main_job(scene, "smoke", 2, folder, **CHANGES)


@pytest.mark.usefixtures("undrawn")
def test_a_scene_without_test_views_is_trained_and_says_what_is_not_measured(scene, tmp_path):
    metrics = p4.main_job(replace(scene, test=()), "smoke", np.int64(2), tmp_path, **CHANGES)
    assert metrics["psnr_db"] is metrics["psnr_fg_db"] is metrics["ssim"] is None
    assert metrics["train_psnr_db"] > 5 and metrics["gaussians"] > 0 and metrics["seed"] == 2
    written = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert written["psnr_db"] is None and "exact" not in written
    said = text.metrics(metrics, tmp_path)
    assert "decoded file on the test views: not measured: the scene has no test views\n" in said
    assert "on the training views: PSNR" in said
    assert (tmp_path / "bouncing.p4dgs").exists() and not (tmp_path / "comparison.csv").exists()


@pytest.mark.parametrize("seed", [-1, 1.5, "one", None, True])
def test_a_seed_that_is_no_integer_is_refused_before_the_first_step(scene, tmp_path, seed):
    for call in (p4.train, p4.main_job):
        with pytest.raises(ValueError, match="seed: .*; expected one integer"):
            call(scene, "smoke", seed, folder=tmp_path / "new")


def test_files_and_tables(done, scene):
    folder, metrics = done
    assert {path.name for path in folder.iterdir()} == PICTURES | TABLES | {
        "metrics.json",
        "bouncing.p4dgs",
    }
    rows = table(folder / "comparison.csv")
    assert [row["name"] for row in rows] == [view.name for view in scene.test]
    for key in ("psnr_db", "psnr_fg_db", "ssim"):  # means over views, of the decoded file
        assert np.mean([float(row[key]) for row in rows]) == pytest.approx(metrics[key], rel=1e-12)
    sizes = {row["component"]: int(row["bytes"]) for row in table(folder / "size.csv")}
    assert (
        sizes == metrics["components"]
        and sum(sizes.values()) == (folder / "bouncing.p4dgs").stat().st_size
    )
    history = table(folder / "training.csv")
    assert tuple(history[0]) == COLUMNS and [int(row["iteration"]) for row in history] == list(
        range(1, 46)
    )
    assert [int(row["stage"]) for row in history] == [1] * 10 + [2] * 5 + [3] * 15 + [4] * 15
    assert all((float(row["bits_per_parameter"]) > 0) == (row["stage"] == "4") for row in history)
    assert metrics["arithmetic"] == arithmetic()
    assert metrics["changes"] == CHANGES and metrics == json.loads(
        (folder / "metrics.json").read_text(encoding="utf-8")
    )


def test_pictures(done, scene):
    folder, _ = done
    for name in PICTURES - {"motion.gif"}:
        height, width = iio.imread(folder / name).shape[:2]
        assert 500 < width < 1400 and 300 < height < 1200, name
    film = iio.imread(folder / "motion.gif")
    decoded, view = p4.decode((folder / "bouncing.p4dgs").read_bytes()), scene.test[0]
    assert np.array_equal(film[1:], film[:0:-1])  # forth and back; a GIF joins equal pictures
    for i, t in ((0, 0.0), (len(film) // 2, 1.0)):
        want = np.clip(decoded.render(view.camera, t), 0, 1).repeat(4, 0).repeat(4, 1)
        assert np.abs(film[i] / 255 - want).mean() < 0.01


def test_pictures_are_the_same_in_a_program_with_other_settings(done, tmp_path):
    folder, _ = done
    history = [[*row.values()] for row in table(folder / "training.csv")]
    with drawn.with_other_settings():
        report.write_training(tmp_path, history, (10, 15, 30, 45))
    assert (tmp_path / "training.png").read_bytes() == (folder / "training.png").read_bytes()


def test_letters_that_the_font_lacks_give_one_clean_title(done, scene, tmp_path):
    """Warnings are errors here, and matplotlib warns of every letter without a glyph."""
    assert report.literal("Bär 日本 $1") == r"Bär ?? \$1"
    _, rows, images = p4.evaluate(p4.decode((done[0] / "bouncing.p4dgs").read_bytes()), scene)
    report.write_comparison(tmp_path, replace(scene, name="日本"), rows, images)


def test_a_film_of_what_does_not_move_goes_around_it(done, scene, monkeypatch, tmp_path):
    moving = p4.decode((done[0] / "bouncing.p4dgs").read_bytes())
    still = replace(moving, design=replace(moving.design, effects=("occlusion",)))
    for model, count in ((moving, 1), (still, 12)):
        film = report.film_views(model, frames=12, azimuth=10, size=16)
        centers = {tuple(np.round(camera.center, 6)) for camera, _ in film}
        assert len(centers) == count and [t for _, t in film] == list(np.linspace(0, 1, 12))
        seen = []
        monkeypatch.setattr(
            type(model), "render", lambda self, c, t: seen.append(c) or np.ones((16, 16, 3))
        )
        report.write_motion(tmp_path / "film.gif", model, scene, frames=12)
        assert len({id(camera) for camera in seen}) == (1 if model is moving else 12)


def test_measures_against_sums_by_hand(scene):
    rng, view = np.random.default_rng(0), scene.test[1]
    image = view.image + rng.normal(size=view.image.shape) * 0.2
    square = [
        [
            (min(max(float(image[i, j, c]), 0), 1) - float(view.image[i, j, c])) ** 2
            for c in range(3)
        ]
        for i in range(16)
        for j in range(16)
    ]
    inside = [sum(s) / 3 for s, a in zip(square, view.alpha.ravel()) if a > 0.5]
    got = score(image, view)
    assert got["psnr_db"] == pytest.approx(-10 * math.log10(sum(map(sum, square)) / 768), rel=1e-9)
    assert got["psnr_fg_db"] == pytest.approx(-10 * math.log10(sum(inside) / len(inside)), rel=1e-9)
    same = score(view.image, view)
    assert same["psnr_db"] == same["psnr_fg_db"] == math.inf and same["ssim"] == pytest.approx(1)
    black = np.zeros((2, 2, 3))
    assert psnr(black, black) == math.inf and psnr(black + 0.1, black) == pytest.approx(20)


def test_bytes_of_the_plain_gaussians(done):
    folder, metrics = done
    model = p4.decode((folder / "bouncing.p4dgs").read_bytes())
    weights = sum(np.size(a) for arrays in model.networks["psi_d"] for a in arrays)
    assert metrics["explicit_bytes"] == 4 * (59 * metrics["gaussians"] + weights)
    assert explicit_bytes(model, 10, 14) == 4 * (140 + weights)
    assert metrics["ratio"] == metrics["explicit_bytes"] / metrics["bytes"]
    assert (
        metrics["ratio_without_sh"] == 4 * (14 * metrics["gaussians"] + weights) / metrics["bytes"]
    )


def test_a_scene_over_another_background_than_the_file_is_told_of(done):
    model = p4.decode((done[0] / "bouncing.p4dgs").read_bytes())
    black = p4.load_scene("bouncing", (0, 0, 0), downscale=4)
    with pytest.warns(UserWarning, match="the file has background 1 1 1, scene dark has 0 0 0; "):
        p4.evaluate(model, replace(black, name="dark"))


def altered(scene, **changes):
    """The scene with its first test view after a training view, but for some changes."""
    same = replace(scene.train[2], **{name: getattr(scene.test[0], name) for name in changes})
    return replace(scene, test=[same, *scene.test[1:]])


@pytest.mark.parametrize("other", [("image",), ("camera", "time"), ("camera",), ()])
def test_test_views_that_are_training_views_are_told_of(done, scene, other, monkeypatch, tmp_path):
    """The same picture, or the same camera at the same time."""
    model = p4.decode((done[0] / "bouncing.p4dgs").read_bytes())
    twice = altered(scene, **dict.fromkeys(other))
    with pytest.warns(
        UserWarning, match="1 of 10 test views are also training views .* train/r_002"
    ):
        _, rows, images = p4.evaluate(model, twice)
    titles = []
    monkeypatch.setattr(report, "draw_pictures", lambda path, title, rows: titles.append(title))
    for drawn_scene in (twice, scene):
        report.write_comparison(tmp_path, drawn_scene, rows, images)
    of = "bouncing: test views of 16x16 pixels"
    assert titles == [of, f"{of}, not used in training"]


def test_a_view_of_another_camera_or_time_is_a_test_view(scene, recwarn):
    for changes in (("image", "camera"), ("image", "time")):
        assert not names_in_training(altered(scene, **dict.fromkeys(changes)))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("dim, is_told", few([(0.4, True), (0.0, False)], 1))
def test_training_views_that_are_far_better_than_test_views(scene, tmp_path, dim, is_told, recwarn):
    """Test pictures that are darker than what training saw."""
    darker = [replace(v, image=v.image * np.float32(1 - dim)) for v in scene.test]
    metrics = p4.main_job(replace(scene, test=darker), "smoke", 0, tmp_path)
    told = [str(one.message) for one in recwarn if "the model has learned the" in str(one.message)]
    assert len(told) == is_told
    numbers = f"{metrics['train_psnr_db']:.2f} dB at 16x16, test views {metrics['psnr_db']:.2f} dB"
    assert all(numbers in line for line in told)


@pytest.mark.usefixtures("undrawn")
def test_equal_images(tmp_path, recwarn):
    """A white scene and a threshold that keeps no Gaussian: the images are exact."""
    source = p4.load_scene("bouncing", downscale=4)
    views = [
        view.__class__(view.name, np.ones_like(view.image), None, view.camera, view.time)
        for view in source.train
    ]
    scene = p4.Scene("white", views[:4], views[4:7])
    metrics = p4.main_job(scene, "smoke", 0, tmp_path, tau_alpha=1.0)
    assert ["4 training views" in str(one.message) for one in recwarn].count(True) == 1
    assert (
        metrics["psnr_db"] == math.inf
        and metrics["gaussians"] == 0
        and metrics["psnr_fg_db"] is None
    )
    written = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert (
        written["psnr_db"] is None
        and written["exact"] is True
        and written["ssim"] == pytest.approx(1)
    )
    assert "PSNR inf dB at 16x16, SSIM 1.0000" in text.metrics(metrics, tmp_path)
    assert [row["psnr_db"] for row in table(tmp_path / "comparison.csv")] == ["inf"] * 3
    assert {path.name for path in tmp_path.glob("*.png")} == PICTURES - {"motion.gif"}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("broken", few(["write_comparison", "write_motion", "write_training"], 1))
def test_a_failed_report_leaves_nothing_but_the_training(scene, tmp_path, monkeypatch, broken):
    def fail(*args):
        raise RuntimeError("no ink")

    monkeypatch.setattr(report, broken, fail)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "size.csv").write_text("{}", encoding="utf-8")
    with pytest.raises(RuntimeError, match="no ink"), pytest.warns(UserWarning, match="is kept"):
        p4.main_job(scene, "smoke", 0, tmp_path / "old")
    assert {path.name for path in (tmp_path / "old").iterdir()} == {"size.csv", CHECKPOINT}
    assert (tmp_path / "old" / "size.csv").read_text(encoding="utf-8") == "{}"


def test_folder_is_tried_before_the_work(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(
        job, "fit_with_advice", lambda *args, **kwargs: pytest.fail("trained for nothing")
    )
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(OutputError, match="file.report: expected a writable folder"):
        p4.main_job(scene, "smoke", 0, tmp_path / "file" / "report")
    with pytest.raises(OSError, match="File name too long"):
        p4.main_job(replace(scene, name="a" * 260), "smoke", 0, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_progress_on_a_terminal(scene, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    fit(scene, "smoke", 0, stream=stream)
    lines = stream.getvalue().split("\r")
    assert (
        lines[0] == "" and stream.getvalue().count("\n") == 1 and stream.getvalue().endswith("\n")
    )
    assert all(len(line.split("\x1b")[0].rstrip("\n")) <= 59 for line in lines)
    assert lines[-1].startswith("45/45  0 s left  stage 4  loss ")
