"""The contract of the command line: every command once, and the same from Python."""

import io
import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref import cli as base
from p4dgs_ref.arithmetic import arithmetic
from p4dgs_ref.cli import job
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.report import figures
from p4dgs_ref.scenes.load import SceneFiles
from tests import ROOT, processes
from tests.processes import start
from tests.sampling import few

from .conftest import command, subcommands

HEADINGS = ["The main job", "Files", "Ports", "Measure", "Teach"]
DATA = "evaluate inspect stability effects grade"


DEMO = "demo --preset smoke --seed 3 --set Q_f=0.5"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The folder that a demo fills, and what it prints to stdout and stderr."""
    folder, out, err = tmp_path_factory.mktemp("demo") / "report", io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **how: None)  # nobody looks
        assert command(f"{DEMO} -o {folder}") == 0
    return folder, out.getvalue(), err.getvalue()


@pytest.fixture
def ok(run, monkeypatch, tmp_path):
    """Run a command in an empty folder; returns what it printed, parsed if it is JSON."""
    monkeypatch.chdir(tmp_path)

    def ok(line):
        code, out, err = run(line)
        assert code == 0, err
        return json.loads(out) if "--json" in line else out

    return ok


def names_in(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def test_demo(report):
    folder, out, err = report
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    assert f"test views: PSNR {metrics['psnr_db']:.2f} dB at 64x64 (object " in out
    assert f"training views: PSNR {metrics['train_psnr_db']:.2f} dB at 64x64\n" in out
    assert (metrics["scene"], metrics["preset"], metrics["seed"]) == ("bouncing", "smoke", 3)
    spent = [metrics[key] for key in ("train_seconds", "encode_seconds", "decode_seconds")]
    assert 0 < min(spent) and sum(spent) < metrics["seconds"]
    assert 5 < metrics["psnr_fg_db"] < metrics["psnr_db"] < 30 and 0 < metrics["ssim"] < 1
    *lines, warning = err.splitlines()
    # without a terminal about a dozen lines, not 45
    assert 10 <= len(lines) <= 16 and "of what moves is drawn" in warning  # after 45 steps
    assert lines[0].startswith(" 1/45  ") and " dB at 64x64  " in lines[0]
    assert lines[-1].startswith("45/45  ") and lines[-1].endswith(" ms/step")


def test_inspect_and_evaluate_agree_with_the_demo(report, ok):
    file = report[0] / "bouncing.p4dgs"
    metrics = json.loads((report[0] / "metrics.json").read_text(encoding="utf-8"))
    listed = ok(f"inspect {file} --json")
    assert sum(row["bytes"] for row in listed["sections"]) == listed["bytes"] == metrics["bytes"]
    scored = ok(f"evaluate {file} bouncing --json")
    same = "psnr_db psnr_fg_db ssim bytes explicit_bytes ratio components anchors gaussians size"
    same = same.split()
    assert {key: scored[key] for key in same} == {key: metrics[key] for key in same}
    assert scored["decode_seconds"] > 0
    shown = ok(f"evaluate {file} bouncing")
    assert f"mean of 10: PSNR {metrics['psnr_db']:.2f} dB at 64x64" in shown
    assert f"{metrics['bytes']:,} bytes" in shown and len(scored["views"]) == 10
    table = ok(f"inspect {file}")
    (total,) = (line.split() for line in table.splitlines() if line.startswith("file "))
    assert total[-1] == str(metrics["bytes"])
    assert all(why in table for why in listed["gaps"].values())


# What a command prints first, and the files in its folder.
WRITTEN = {
    "train bouncing -o run --preset smoke --downscale 4 --set k=3 --quiet": (
        "run: 45 iterations, 20 anchors",
        "checkpoint.npz training.csv training.png",
    ),
    "encode run -o out/x.p4dgs": ("out/x.p4dgs: ", "x.p4dgs"),
    "decode out/x.p4dgs -o arrays": ("arrays: model.npz with 59 arrays", "model.json model.npz"),
    "render out/x.p4dgs -o held --frames 3 --size 20 --azimuth -50": (
        "held: 3 images",
        "motion.gif t_000.png t_001.png t_002.png",
    ),
    "render out/x.p4dgs --scene bouncing --downscale 2 -o views": (
        "views: 10 images",
        " ".join(f"view_{i:03d}.png" for i in range(10)),
    ),
    "evaluate out/x.p4dgs bouncing -o scored": (
        "test/r_000  t 0.050  PSNR ",
        "comparison.csv comparison.png",
    ),
    "view out/x.p4dgs -o pages/x.html": ("pages/x.html: ", "x.html"),
}


@pytest.mark.usefixtures("undrawn")
def test_from_a_scene_to_a_file_and_back(ok):
    for line, (said, names) in WRITTEN.items():
        assert ok(line).startswith(said)
        folder = Path(line.split("-o ")[1].split()[0])
        assert names_in(folder.parent if folder.is_file() else folder) == names.split()
    model = p4.decode(Path("out/x.p4dgs").read_bytes())
    with np.load("arrays/model.npz") as arrays:
        assert len(arrays.files) == 59 and arrays["O_a"].shape == (20, 3, 3)
        np.testing.assert_array_equal(arrays["psi_c.W0"], model.networks["psi_c"][0][0])
        np.testing.assert_array_equal(arrays["psi_c.b1"], model.networks["psi_c"][1][1])
        np.testing.assert_array_equal(arrays["f_a"], model.anchors.f_a)
    assert json.loads(Path("arrays/model.json").read_text(encoding="utf-8"))["k"] == 3
    assert iio.imread("held/motion.gif").shape == (4, 20, 20, 3)  # 0, 1, 2, 1
    view = p4.load_scene("bouncing", downscale=2).test[2]
    want = np.clip(model.render(view.camera, view.time), 0, 1)
    np.testing.assert_allclose(iio.imread("views/view_002.png") / 255, want, atol=0.501 / 255)


@pytest.mark.usefixtures("undrawn")
def test_a_folder_named_like_the_home_folder(ok, scene, monkeypatch):
    """Only a shell replaces ~; nothing is read from the home folder or written to it."""
    Path("home").mkdir()
    monkeypatch.setenv("HOME", str(Path("home").resolve()))
    shutil.copytree(scene, "~/scene")
    bodies = json.loads((ROOT / "tiny_scenes/static/scene.json").read_text(encoding="utf-8"))
    bodies["resolution"] = [4, 4]
    Path("~/bodies.json").write_text(json.dumps(bodies), encoding="utf-8")
    for line in (
        "train ~/scene -o ~/run --preset smoke --quiet --set stage_ends=1,2,3,5",
        "encode ~/run -o ~/x.p4dgs",
        "evaluate ~/x.p4dgs ~/scene -o ~/compared",
        "render ~/x.p4dgs -o ~/held --frames 1 --size 4",
        "render ~/x.p4dgs -o ~/views --scene ~/scene",
        "simulate ~/bodies.json -o ~/drawn",
    ):
        ok(line)
    wanted = {"held/motion.gif", "held/t_000.png", "views/view_001.png", "drawn/test/r_009.png"}
    assert wanted <= {file.relative_to("~").as_posix() for file in Path("~").rglob("*")}
    assert not list(Path("home").iterdir())


@pytest.mark.usefixtures("undrawn")
def test_train_on_the_layout_of_nerf_ds(ok):
    options = "--preset smoke --downscale 4 --quiet --set stage_ends=1,2,3,5"
    assert "200 anchors" in ok(f"train twocams -o run {options}")
    ok("encode run -o twocams.p4dgs")
    assert ok("evaluate twocams.p4dgs twocams --json")["scene"] == "twocams"
    assert "12 images" in ok("render twocams.p4dgs -o views --scene twocams")
    assert Path("views/view_000.png").is_file()
    np.save("points.npy", np.arange(3.0)[:, None] * [1, 0, 0])
    assert "3 anchors" in ok(f"train twocams -o other --points points.npy {options}")
    with np.load("other/checkpoint.npz") as file:
        x = p4.load_scene("twocams").points  # what (x - center) scale made of the file's points
        raw = np.load(ROOT / "tiny_scenes/twocams/points.npy")
        scale = np.ptp(x[:, 0]) / np.ptp(raw[:, 0])
        assert np.ptp(file["p/x_a"][:, 0]) == pytest.approx(2 * scale, abs=0.05)


def test_tables(ok):
    keys = [*p4.EQUATIONS]
    table = ok("oracle equations")
    assert all(f"`{key}`" in table for key in keys) and "= \\|x_a - x_c\\|" in table
    star = ["*", "anchors", "200", "10000", "10000", "Scaffold-GS", "(Q28)"]
    assert star in [line.split() for line in ok("presets").splitlines()]
    same = ["voxel", "0.001", "0.001", "0.01", "paper"]
    assert same in [line.split() for line in ok("presets tiny").splitlines()]


def test_the_paper_presets_say_where_each_value_comes_from(ok):
    """The paper gives fewer than half of the fields; nothing else may pass as the paper's."""
    lines = ok("presets paper_synthetic").splitlines()[2:]
    sources = {line.split()[0]: line.split("  ")[-1].strip() for line in lines}
    known = {"paper", "Scaffold-GS", "HAC", "D3DGS", "3DGS", "chosen", "off"}
    assert {source.split()[0].strip(";,") for source in sources.values()} == known
    assert [*sources.values()].count("paper") == 11 and sources["lambda_rate"] == "HAC (Q12)"
    assert sources["lr_x"] == "Scaffold-GS (Q14)"


def test_the_version_says_which_kernels_are_in_force(run):
    code, out, _ = run("--version")
    line, promise = out.split("\n", 1)
    assert (code, line) == (0, arithmetic()) and promise == f"{cli.KEPT}\n"
    assert re.fullmatch(r"p4dgs_ref \S+, NumPy \S+, SciPy \S+, kernels: .+", line)


def every_command(parser):
    """{name: parser} of all commands and of those into which one is divided."""
    found = subcommands(parser)
    inner = {f"{name} {n}": c for name, part in found.items() for n, c in subcommands(part).items()}
    return {**found, **inner}


def test_help_has_five_groups_and_fits_a_screen(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    parser, printing = cli.parser(), set()
    lines = parser.format_help().splitlines()
    groups = [line for line in lines if line.endswith(":") and "," in line]
    assert [line.split(",")[0] for line in groups] == HEADINGS
    listed = [found[1] for line in lines if (found := re.match(r"  ([a-z][a-z-]*) ", line))]
    assert listed == [*subcommands(parser)]
    for name, part in every_command(parser).items():
        help = part.format_help().splitlines()
        assert len(help) <= 24 and max(map(len, [*help, *lines])) <= 100, name
        printing |= {name for line in help if line.startswith("  --json ")}
    assert printing == {*DATA.split(), "oracle check"}
    help = " ".join(subcommands(parser)["render"].format_help().split())
    camera = figures.fixed_camera(SimpleNamespace(box=np.zeros((2, 3))), size=100)
    angle = np.degrees(2 * np.arctan(50 / camera.f_x))
    assert f"with a field of view of {angle:.3g} degrees" in help


def test_every_command_has_its_function():
    for part in every_command(cli.parser()).values():
        if not subcommands(part):
            module, function = part.get_default("function").split(".")
            assert callable(getattr(import_module(f"p4dgs_ref.cli.{module}"), function))


@pytest.mark.slow
def test_a_reader_that_goes_away_is_no_error():
    with start("-m", "p4dgs_ref", "oracle", "equations") as process:
        process.stdout.close()  # before the first line is written
        assert process.stderr.read() == "" and process.wait(timeout=60) == 0


def test_a_terminal_shows_progress_until_something_else_is_printed(monkeypatch, capsys):
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    with redirect_stderr(terminal):
        base.progress("1 of 2\n\x1b[31m" + 500 * "x")
        base.print_result("done")
    shown, clear = terminal.getvalue().split("\x1b[K")[:2]
    assert shown.startswith("\r1 of 2\\n\\x1b[31mxx") and len(shown) <= 80 and clear == "\r"
    base.progress("nothing where no terminal is")
    assert capsys.readouterr() == ("done\n", "")


@pytest.mark.slow
def test_a_pipe_is_not_waited_for(tmp_path):
    (tmp_path / "answers").mkdir()
    os.mkfifo(tmp_path / "answers/likelihood.safetensors")
    line = "-m p4dgs_ref oracle check answers --only likelihood"
    with start(*line.split(), cwd=tmp_path) as process:
        assert process.wait(timeout=60) == 1


LONG = "--preset smoke --set stage_ends=9,9,9,90000000 --set anchors=2"
ESTIMATED = {  # what is said when the training is stopped
    f"train scene -o run {LONG}": "stopped; if the run folder has",
    f"demo scene -o run {LONG}": "--resume continues",
}


@pytest.fixture
def stopped(monkeypatch):
    """A training stops before its first step."""

    def stop(*arguments, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr("p4dgs_ref.training.fit.run", stop)


@pytest.mark.parametrize("line", ESTIMATED)
def test_long_trainings_need_a_yes_before_pictures_are_read(place, run, stopped, line, monkeypatch):
    """What is known before the first step is asked before 50 photographs are read."""
    with monkeypatch.context() as patch:
        patch.setattr(SceneFiles, "read", lambda *_: pytest.fail("pictures are read"))
        code, _, err = run(line)
    assert code == 2 and re.search(
        r"about 1\.4 days \(90,000,000 iterations at 12x8\): pass --yes to start\n", err
    )
    assert err.count("\n") == 1 and not Path("run").exists()
    code, _, err = run(f"{line} --yes")
    assert code == 130 and ESTIMATED[line] in err and not Path("run").exists()


EARLY = {  # what can be refused before a picture is read
    "train scene -o run --points none.ply": "none.ply: missing",
    "train scene -o run --points points.obj": "points.obj: expected a name that ends in .npy, .ply",
    "train scene -o run --resume": "run/checkpoint.npz: No such file",
    "train scene -o notes.txt/run": "notes.txt/run: expected a writable folder",
    "demo scene -o notes.txt/run": "notes.txt/run: expected a writable folder",
    "demo scene -o done": "done/metrics.json: exists",
    "train scene -o done": "done/checkpoint.npz: exists",
    "train scene -o run --seed one": "--seed",
}


@pytest.mark.parametrize("line", EARLY)
def test_names_are_refused_before_pictures_are_read(place, run, line, monkeypatch):
    monkeypatch.setattr(SceneFiles, "read", lambda *_: pytest.fail("pictures are read"))
    Path("notes.txt").write_text("", encoding="utf-8")
    Path("done").mkdir()
    for name in ("metrics.json", "checkpoint.npz"):
        Path("done", name).write_text("", encoding="utf-8")
    code, _, err = run(line)
    assert code == 2 and EARLY[line] in err and not Path("run").exists(), err


@pytest.mark.parametrize(
    "seconds, words",
    [(70, "1.2 minutes"), (3500, "58.3 minutes"), (71442, "19.8 hours"), (1e6, "11.6 days")],
)
def test_estimates_are_in_minutes_hours_or_days(seconds, words, capsys):
    base.ask(SimpleNamespace(yes=True), "a training", seconds)
    assert capsys.readouterr().err == f"p4dgs-ref: about {words} (a training)\n"


def test_the_estimate_counts_pixels_and_comes_before_the_first_step(place, run, stopped):
    """Pictures of 400 times as many pixels; `tiny` on them takes minutes, on 12x8 less than one."""
    for split in ("train", "test"):
        for file in Path("scene", split).iterdir():
            iio.imwrite(file, iio.imread(file).repeat(40, 0).repeat(40, 1))
    code, _, err = run("train scene -o run")
    (minutes,) = re.findall(r"about (.*) minutes \(3,800 iterations at 480x320\)", err)
    assert code == 130 and 5 < float(minutes) < 60
    assert "about" not in run("train scene -o run --downscale 40")[2]
    iterations = "--set stage_ends=9,9,9,38000"
    assert "(38,000 iterations at 480x320): pass" in run(f"train scene -o run {iterations}")[2]


def test_a_line_tells_how_far_the_reading_of_pictures_is(place, monkeypatch):
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    with redirect_stderr(terminal):
        scene = job.load(SimpleNamespace(scene="scene", downscale=1))
    lines = "".join(f"\rscene: {i}/4 pictures read\x1b[K" for i in range(4))
    assert len(scene.test) == 2 and terminal.getvalue() == lines


# Seconds of the processor of one step, as measured on a quiet machine, by children and side.
MEASURED = {
    (800, 64): 0.0175,
    (100_000, 100): 0.61,
    (100_000, 200): 1.16,
    (100_000, 400): 3.0,
    (100_000, 800): 17.5,
}


@pytest.mark.parametrize("children, side", MEASURED)
def test_the_estimate_is_right_within_a_factor_of_two(children, side):
    """Large pictures with many Gaussians need a term for their product."""
    assert 0.5 < job.step_seconds(children, side**2) / MEASURED[children, side] < 2


def test_python_face_lists_its_names():
    assert set(p4.__all__) <= set(dir(p4))
    with pytest.raises(AttributeError, match="no attribute 'teleport'"):
        p4.teleport


def test_importing_the_package_leaves_numpy_alone():
    code = "import sys, p4dgs_ref, p4dgs_ref.cli.parser; sys.exit('numpy' in sys.modules)"
    assert processes.run("-c", code).returncode == 0


@pytest.mark.parametrize(
    "before, after",
    few(
        [
            ("MPLBACKEND=module://matplotlib_inline.backend_inline", ""),  # of another environment
            ("", "2>&-"),
            ("", "<&- >&- 2>&-"),
            ("", "2>/dev/full"),
        ],
        0,
        2,
    ),
)
def test_a_notebook_may_start_commands_and_streams_may_be_closed_or_full(tmp_path, before, after):
    line = "-m p4dgs_ref demo --preset smoke --downscale 4 --set stage_ends=1,2,3,5 -o"
    command = f"{before} '{sys.executable}' {line} '{tmp_path}' {after}"
    done = subprocess.run(["sh", "-c", command], cwd=processes.ASIDE, **processes.CAPTURED)
    assert done.returncode == 0 and (tmp_path / "metrics.json").is_file(), done.stdout


@pytest.fixture
def place(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scene, "scene")
    return tmp_path
