"""The contract of the command line: every command once, and the same from Python."""

import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.lab.baselines.table import ALL_EQUATIONS

ROOT = Path(p4.__file__).resolve().parents[1]
COMMANDS = (
    "demo",
    "simulate",
    "train",
    "encode",
    "decode",
    "render",
    "export-ply",
    "evaluate",
    "inspect",
    "equations",
    "presets",
    "bench",
)
METRICS = {
    "scene": str,
    "preset": str,
    "seed": int,
    "psnr_db": float,
    "psnr_fg_db": float,
    "ssim": float,
    "bytes": int,
    "seconds": float,
    "train_seconds": float,
    "encode_seconds": float,
    "decode_seconds": float,
    "render_fps": float,
    "anchors": int,
    "gaussians": int,
    "components": dict,
    "paper_design": dict,
}
COMPONENTS = {
    "header",
    "positions",
    "features",
    "scales",
    "offset_scales",
    "offsets",
    "masks",
    "hash_grid",
    "deformation_mlp",
    "anchor_mlps",
    "context_mlps",
}


def start(*argv, cwd=None, **options):
    """Start the command in a process of its own."""
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    return subprocess.Popen(
        [sys.executable, "-m", "p4dgs_ref", *map(str, argv)],
        cwd=cwd,
        env=env,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


def finish(process):
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out, err


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """The (report, stdout, stderr) of two runs of the same demo in different folders."""
    folders = [tmp_path_factory.mktemp(name) for name in ("one", "two")]
    options = ("demo", "--preset", "smoke", "--seed", "3", "--set", "Q_f=0.5", "--json")
    running = [
        start(*options, cwd=folders[0]),
        start(*options, "-o", "report", "--quiet", cwd=folders[1]),
    ]
    return [(folder / "report", *finish(process)) for folder, process in zip(folders, running)]


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run a command in an empty folder; returns what it printed, parsed if it is JSON."""
    monkeypatch.chdir(tmp_path)

    def run(line):
        assert cli.run(shlex.split(line), time.perf_counter()) == 0
        out = capsys.readouterr().out
        return json.loads(out) if "--json" in line else out

    return run


def test_demo_metrics(reports):
    folder, out, err = reports[0]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics == json.loads(out)
    assert {key: type(metrics[key]) for key in METRICS} == METRICS
    assert (metrics["scene"], metrics["preset"], metrics["seed"]) == ("bouncing", "smoke", 3)
    assert metrics["changes"] == {"Q_f": 0.5}
    paper = {key: metrics[key] for key in ("bytes", "psnr_db", "ssim")}
    assert metrics["paper_design"] == paper  # the preset itself is the paper's design
    assert set(metrics["components"]) == COMPONENTS
    files = list(folder.glob("*.p4dgs"))
    assert (
        [file.stat().st_size for file in files]
        == [metrics["bytes"]]
        == [sum(metrics["components"].values())]
    )
    spent = [metrics[key] for key in ("train_seconds", "encode_seconds", "decode_seconds")]
    assert 0 < min(spent) and sum(spent) < metrics["seconds"]
    assert 5 < metrics["psnr_fg_db"] < metrics["psnr_db"] < 30 and 0 < metrics["ssim"] < 1
    lines = err.splitlines()  # without a terminal about a dozen lines, not 45
    assert 10 <= len(lines) <= 16
    for word in (
        "45/45",
        "stage 4",
        "loss",
        "PSNR",
        "bits/parameter",
        "anchors",
        "Gaussians",
        "ms/step",
        "s left",
    ):
        assert word in lines[-1]


def test_demo_twice_is_the_same_to_the_byte(reports):
    (one, *_), (two, _, err) = reports
    assert err == ""  # --quiet
    names = sorted(path.name for path in one.iterdir())
    assert names == [
        "bouncing.p4dgs",
        "comparison.csv",
        "comparison.png",
        "metrics.json",
        "motion.gif",
        "size.csv",
        "size.png",
        "training.csv",
        "training.png",
    ]
    for name in set(names) - {"metrics.json"}:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


def test_inspect_and_evaluate_agree_with_the_demo(reports, run):
    file = next(reports[0][0].glob("*.p4dgs"))
    metrics = json.loads((reports[0][0] / "metrics.json").read_text())
    listed = run(f"inspect {file} --json")
    assert sum(row["bytes"] for row in listed["sections"]) == listed["bytes"] == file.stat().st_size
    assert all(row["name"] and row["bytes"] >= 0 for row in listed["sections"])
    scored = run(f"evaluate {file} bouncing --json -o scored")
    for key in ("psnr_db", "psnr_fg_db", "ssim"):
        assert scored[key] == pytest.approx(metrics[key], rel=1e-6)
    for key in ("bytes", "explicit_bytes", "ratio", "components", "anchors", "gaussians"):
        assert scored[key] == metrics[key]
    assert (
        scored["encode_seconds"] > 0 and scored["decode_seconds"] > 0 and len(scored["views"]) == 10
    )
    assert sorted(path.name for path in Path("scored").iterdir()) == [
        "comparison.csv",
        "comparison.png",
    ]
    text = run(f"evaluate {file} bouncing")
    assert (
        f"mean of 10: PSNR {metrics['psnr_db']:.2f} dB" in text
        and f"{metrics['bytes']:,} bytes" in text
    )
    table = run(f"inspect {file} -o sizes --heat --size 40")
    (total,) = (line.split() for line in table.splitlines() if line.startswith("file "))
    assert total[-1] == str(metrics["bytes"]) and all(
        why in table for why in listed["gaps"].values()
    )
    assert sorted(path.name for path in Path("sizes").iterdir()) == [
        "heat.csv",
        "heat.png",
        "size.csv",
        "size.png",
    ]
    assert len(Path("sizes/heat.csv").read_text().splitlines()) == metrics["anchors"] + 1


def test_train_encode_decode_render(run, capsys):
    trained = run(
        "train bouncing -o run --preset smoke --downscale 4 --set k=3 "
        "--background 0.2,0.3,0.4 --json"
    )
    assert trained["iterations"] == 45 and trained["anchors"] == 20
    names = sorted(path.name for path in Path("run").iterdir())
    assert names == ["checkpoint.npz", "run.json", "training.csv", "training.png"]
    encoded = run("encode run -o out/scene.p4dgs --json")
    data = Path("out/scene.p4dgs").read_bytes()
    assert encoded["bytes"] == len(data) and encoded["iteration"] == 45
    model = p4.decode(data)
    np.testing.assert_allclose(model.background, [0.2, 0.3, 0.4], rtol=1e-6)
    run("decode out/scene.p4dgs -o arrays")
    with np.load("arrays/model.npz") as arrays:
        assert arrays["O_a"].shape == (20, 3, 3)
        np.testing.assert_array_equal(arrays["psi_c.W0"], model.networks["psi_c"][0][0])
        np.testing.assert_array_equal(arrays["f_a"], model.anchors.f_a)
    assert json.loads(Path("arrays/model.json").read_text())["k"] == 3
    drawn = run("render out/scene.p4dgs -o held --frames 3 --size 20 --azimuth -50 --json")
    assert drawn["images"] == 3 and iio.imread("held/motion.gif").shape == (
        4,
        20,
        20,
        3,
    )  # 0, 1, 2, 1
    names = sorted(path.name for path in Path("held").iterdir())
    assert names == ["motion.gif", "t_000.png", "t_001.png", "t_002.png"]
    run("render out/scene.p4dgs -o views --scene bouncing --downscale 4 --settings exact")
    view = p4.load_scene("bouncing", downscale=4).test[2]
    want = np.clip(model.render(view.camera, view.time, p4.SETTINGS["exact"]), 0, 1)
    np.testing.assert_allclose(iio.imread("views/test_r_002.png") / 255, want, atol=0.501 / 255)


def test_train_on_the_layout_of_nerf_ds(run):
    assert run("train twocams -o run --preset smoke --json")["anchors"] == 200
    run("encode run -o twocams.p4dgs")
    assert run("evaluate twocams.p4dgs twocams --json")["scene"] == "twocams"
    assert run("render twocams.p4dgs -o views --scene twocams --json")["images"] == 12
    assert Path("views/000002_right.png").is_file()
    assert "view 000002_right" in run("export-ply twocams.p4dgs --camera 0")
    lines = [f"{i} {i} 0 0 0 0 0 0 1 1" for i in range(3)]
    Path("points3D.txt").write_text("\n".join(lines))
    again = run("train twocams -o other --preset smoke --points points3D.txt --json")
    assert again["anchors"] == 3
    with np.load("other/checkpoint.npz") as file:
        x = p4.load_scene("twocams").points  # what (x - center) scale made of the file's points
        raw = np.load(ROOT / "tiny_scenes/twocams/points.npy")
        scale = np.ptp(x[:, 0]) / np.ptp(raw[:, 0])
        assert np.ptp(file["p/x_a"][:, 0]) == pytest.approx(2 * scale, abs=0.05)


def test_simulate(run):
    description = json.loads((ROOT / "tiny_scenes/static/scene.json").read_text())
    description["resolution"] = [8, 8]
    description["lens"] = {key: value / 8 for key, value in description["lens"].items()}
    description["cameras"] = {**description["cameras"], "train": 2, "test": 1}
    Path("scene.json").write_text(json.dumps(description))
    assert run("simulate scene.json -o drawn --json")["output"] == "drawn"
    assert len(p4.load_scene("drawn").train) == 2


def test_tables(run):
    listed = run("equations --json")["equations"]
    assert [row["key"] for row in listed] == [*ALL_EQUATIONS]
    assert all(f"`{row['key']}`" in run("equations") for row in (listed[0], listed[-1]))
    differs = run("presets tiny --json")["tiny"]["differs"]
    assert {"field": "anchors", "paper": 10000, "here": 200} in differs
    star = ["*", "anchors", "200", "10000", "10000", "Scaffold-GS", "(Q28)"]
    assert star in [line.split() for line in run("presets").splitlines()]
    same = ["voxel", "0.001", "0.001", "0.01", "paper"]
    assert same in [line.split() for line in run("presets tiny").splitlines()]


def test_the_paper_presets_say_where_each_value_comes_from(run):
    """The paper gives fewer than half of the fields; nothing else may pass as the paper's."""
    fields = run("presets paper_synthetic --json")["paper_synthetic"]
    sources = fields["sources_of_paper_presets"]
    assert set(sources) == set(fields["fields"]) - {"name"}
    assert {source.split()[0].strip(";,") for source in sources.values()} == {
        "paper",
        "Scaffold-GS",
        "HAC",
        "D3DGS",
        "3DGS",
        "ours",
        "off",
    }
    shown = run("presets paper_synthetic")
    assert sum(line.endswith("  paper") for line in shown.splitlines()) == 11
    assert "lambda_rate" in shown and sources["lambda_rate"] == "HAC (Q12)"


@pytest.mark.slow
def test_bench(run):
    measured = run("bench --quick --json")
    rows = {row["what"]: row for row in measured["rows"]}
    assert rows["render 300 Gaussians, 64x64, with gradients"]["ratio"] > 1
    assert rows["training step of `tiny`, stage 4"]["ms"] > rows["  compositing, fast"]["ms"] > 0


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself_and_has_json(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.parser().parse_args([name, "--help"])
    text = capsys.readouterr().out
    assert stopped.value.code == 0 and "--json" in text
    for option in ("--preset", "--seed", "--set KEY=VALUE", "--quiet"):
        assert option in text or name not in ("demo", "train")


def test_a_reader_that_goes_away_is_no_error():
    process = start("equations")
    process.stdout.close()  # before the first line is written
    assert process.stderr.read() == "" and process.wait(timeout=60) == 0


def test_long_trainings_need_a_yes(run, monkeypatch, capsys):
    line = (
        "train bouncing -o run --preset smoke --downscale 8 "
        "--set stage_ends=9,9,9,90000000 --set anchors=2"
    )
    assert cli.run(shlex.split(line), time.perf_counter()) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert (
        "minutes for 90000000 iterations" in first
        and "--yes" in second
        and not Path("run").exists()
    )


def test_python_face():
    scene = p4.load_scene("bouncing", downscale=2)
    begin = time.perf_counter()
    model = p4.train(scene, preset="smoke", seed=1, Q_f=0.5)
    assert time.perf_counter() - begin < 5
    assert model.design.Q_0[0] == 0.5
    decoded = p4.decode(p4.encode(model))
    metrics, rows, images = p4.evaluate(decoded, scene)
    view = scene.test[0]
    np.testing.assert_array_equal(images[0], decoded.render(view.camera, view.time))
    assert rows[0]["name"] == view.name and images[0].shape == (32, 32, 3)
    assert metrics["gaussians"] <= len(decoded.anchors.x_a) * 2
    assert all(getattr(p4, name) is not None for name in p4.__all__) and set(p4.__all__) <= set(
        dir(p4)
    )
    with pytest.raises(AttributeError, match="no attribute 'teleport'"):
        p4.teleport


def test_importing_the_package_leaves_numpy_alone():
    code = "import sys, p4dgs_ref, p4dgs_ref.cli.parser; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
