"""The report of a run: measures against independent sums, pictures, all files or none.

Trainings in two processes give the same results as in one, and no process is left behind.
"""

import csv
import io
import json
import math
import multiprocessing
import os
import time
import warnings
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.cli import text
from p4dgs_ref.designs import fit, paper_preset
from p4dgs_ref.output import OutputError
from p4dgs_ref.report import figures as report
from p4dgs_ref.report import jobs as job
from p4dgs_ref.report.evaluate import explicit_bytes, psnr, score
from p4dgs_ref.report.jobs import in_processes
from p4dgs_ref.training.progress import COLUMNS
from p4dgs_ref.training.presets import TINY
from p4dgs_ref.training.watch import NotFinite
from tests import processes
from tests.sampling import few
from tests.tutorials import drawn

pytestmark = pytest.mark.filterwarnings("ignore:.*scene bouncing")  # 45 steps learn nothing
PICTURES = {"comparison.png", "motion.gif", "size.png", "training.png"}
TABLES = {"comparison.csv", "size.csv", "training.csv"}
# Masks and statistics are in use when stage 4 begins.
CHANGES = {"Q_O": 0.2, "grow_every": 4, "mask_from": 10, "min_opacity": 0.2}
CODED = {"is_coded": True, "network_ramp": 10, "lr_step": (0.02, 0.002), "body": True}


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
    black = p4.load_scene("bouncing", "black", downscale=4)
    with pytest.warns(UserWarning, match="the file has the background 1 1 1, scene dark 0 0 0; "):
        p4.evaluate(model, replace(black, name="dark"))


def test_equal_images(tmp_path, recwarn):
    """A white scene and a threshold that keeps no Gaussian: the images are exact.

    Its few views are told once, though two designs are trained.
    """
    source = p4.load_scene("bouncing", downscale=4)
    views = [
        view.__class__(view.name, np.ones_like(view.image), None, view.camera, view.time)
        for view in source.train
    ]
    scene = p4.Scene("white", views[:4], views[4:7])
    metrics = p4.main_job(scene, "smoke", 0, tmp_path, tau_alpha=1.0, **CODED)
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
    assert written["paper_design"]["psnr_db"] is None and written["paper_design"]["exact"] is True
    assert "PSNR inf dB, SSIM 1.0000" in text.metrics(metrics, tmp_path)
    assert [row["psnr_db"] for row in table(tmp_path / "comparison.csv")] == ["inf"] * 3
    assert {path.name for path in tmp_path.glob("*.png")} == PICTURES - {"motion.gif"}


def test_a_preset_with_nothing_of_ours_is_trained_once(monkeypatch, tmp_path):
    """Also where it changes a field that only coded networks use."""
    monkeypatch.setattr(job, "one_design", lambda *arguments: "own")
    off = dict(is_coded=False, position_bits=16, body=False, network_ramp=5)
    preset = replace(p4.PRESETS["tiny_coded"], **off)
    assert preset != paper_preset(preset)
    assert job.designs(None, preset, 0, tmp_path / "a.p4dgs", None, 1) == ("own", None)


def test_a_coded_preset_is_compared_with_the_paper_design(scene, done, tmp_path):
    """The paper's design beside it has the same changes, and is what its own preset trains."""
    assert replace(paper_preset(p4.PRESETS["tiny_coded"]), name="tiny") == TINY
    metrics = p4.main_job(scene, "smoke", 2, tmp_path, **CHANGES, **CODED)
    assert [what[-4:] for what in metrics["beyond_the_paper"]] == ["(B1)", "(B3)"]
    folder, paper = done
    own = {key: paper[key] for key in ("bytes", "psnr_db", "ssim")}
    own["name"] = "the paper's design"
    assert metrics["paper_design"] == own == paper["paper_design"]
    files = {path.name: path.read_bytes() for path in tmp_path.glob("*.p4dgs")}
    assert files.keys() == {"bouncing.p4dgs", "bouncing_paper_design.p4dgs"}
    assert files["bouncing_paper_design.p4dgs"] == (folder / "bouncing.p4dgs").read_bytes()
    assert files["bouncing.p4dgs"] == p4.encode(p4.train(scene, "smoke", 2, **CHANGES, **CODED))
    assert len(files["bouncing.p4dgs"]) == metrics["bytes"] < 0.6 * own["bytes"]
    sizes = table(tmp_path / "size.csv")
    assert {row["component"]: int(row["bytes"]) for row in sizes} == metrics["components"]
    beside = {row["component"]: int(row["paper_design_bytes"]) for row in sizes}
    assert beside == paper["components"]
    said = text.metrics(metrics, tmp_path)
    assert f"file {own['bytes']:,} bytes" in said and f"file {metrics['bytes']:,} bytes" in said
    assert f"{metrics['bytes'] / own['bytes']:.3f} of the bytes" in said
    assert "ours: networks that pay for their bits (B1); more weight" in said
    single = {**metrics, "paper_design": {**own, "name": "the paper's design with k = 1"}}
    assert "  the paper's design with k = 1: PSNR " in text.metrics(single, folder)
    assert "against it" not in text.metrics(paper, folder) and "B1" not in text.metrics(
        paper, folder
    )
    assert "is lost" in metrics["warning"] and metrics["warning"] != paper["warning"]


@pytest.mark.slow
def test_both_designs_at_once(scene, tmp_path):
    """Two processes write the files of one, and none is left behind."""
    alone, at_once = (
        p4.main_job(scene, "smoke", 2, tmp_path / str(jobs), jobs=jobs, **CHANGES, **CODED)
        for jobs in (1, 2)
    )
    assert at_once["paper_design"] == alone["paper_design"] and at_once["bytes"] == alone["bytes"]
    files = sorted(path.name for path in (tmp_path / "1").glob("*.p4dgs"))
    assert len(files) == 2 and not multiprocessing.active_children()
    for name in files:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


@pytest.mark.parametrize("broken", few(["write_comparison", "write_motion", "write_training"], 1))
def test_a_failed_report_leaves_nothing(scene, tmp_path, monkeypatch, broken):
    def fail(*args):
        raise RuntimeError("no ink")

    monkeypatch.setattr(report, broken, fail)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "size.csv").write_text("{}", encoding="utf-8")
    for name in ("old", "new/deep"):
        with pytest.raises(RuntimeError, match="no ink"):
            p4.main_job(scene, "smoke", 0, tmp_path / name)
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")) == [
        "old",
        "old/size.csv",
    ]
    assert (tmp_path / "old" / "size.csv").read_text(encoding="utf-8") == "{}"


def test_folder_is_tried_before_the_work(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(job, "fit", lambda *args, **kwargs: pytest.fail("trained for nothing"))
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(OutputError, match="file/report: expected a folder"):
        p4.main_job(scene, "smoke", 0, tmp_path / "file" / "report")
    with pytest.raises(OSError, match="File name too long"):  # of the other file alone
        p4.main_job(replace(scene, name="a" * 240), "smoke", 0, tmp_path / "new")
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


def place(seconds):
    """A task that takes some time and says where it ran."""
    time.sleep(seconds)
    return seconds, os.getpid()


def explode(task):
    raise NotFinite(f"iteration {task}: f_a[3, 1] is nan")


def mutter(task):
    warnings.warn(f"task {task} is poor", stacklevel=1)
    return task


@pytest.mark.slow
def test_warnings_of_workers_are_given_by_this_process():
    with pytest.warns(UserWarning, match="is poor") as given:
        assert list(in_processes(mutter, [1, 2], 2)) == [1, 2]
    assert [str(one.message) for one in given] == ["task 1 is poor", "task 2 is poor"]


UNGUARDED = """
from p4dgs_ref.report.jobs import in_processes
print(list(in_processes(abs, [1, 2], 2)))
"""


@pytest.mark.slow
def test_a_script_that_a_worker_would_run_again_is_told_so(tmp_path):
    (tmp_path / "script.py").write_text(UNGUARDED, encoding="utf-8")
    lines = processes.run(tmp_path / "script.py").stderr.splitlines()
    assert lines[0].startswith("Traceback") and "__main__" in lines[-1] and len(lines) < 15
    assert lines[-1].startswith("ChildProcessError: a worker process ran the script")


@pytest.mark.slow
def test_no_process_is_left_behind():
    before = set(multiprocessing.active_children())
    results, start = in_processes(place, [0.0, 300.0, 300.0], 2), time.monotonic()
    assert next(results)[0] == 0.0
    assert set(multiprocessing.active_children()) - before
    results.close()  # as Ctrl-C does
    with pytest.raises(NotFinite, match=r"^iteration 7: f_a\[3, 1\] is nan$"):
        list(in_processes(explode, [7, 8], 2))
    assert set(multiprocessing.active_children()) <= before
    assert time.monotonic() - start < 150
