"""All methods in one table: files, measures, ratios and notes against independent sums."""

import dataclasses
import json
import pickle
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.lab import baselines
from p4dgs_ref.lab.tables import compare as study
from p4dgs_ref.lab.tables import methods
from p4dgs_ref.lab.tables.methods import OURS, StudyError, Task
from p4dgs_ref.report.evaluate import evaluate

CONTRACT = ("method", "scene", "psnr_db", "ssim", "bytes", "render_fps", "train_seconds", "seed")
# The large network takes as long as all others together.
OTHERS = [name for name in baselines.METHODS if name != "d3dgs"]
CHOSEN = (OURS, *OTHERS)


@pytest.fixture(scope="module")
def scene():
    whole = p4.load_scene("bouncing", downscale=8)
    return dataclasses.replace(whole, test=whole.test[:2])


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    """The folder and the result of a comparison of methods after a few steps."""
    folder = tmp_path_factory.mktemp("compare")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "TURNS", 1)
        return folder, study.compare([scene], folder, OTHERS, 2, 4, caps=(20,))


def test_every_method_has_a_row_of_the_contract_for_each_seed(done):
    folder, result = done
    assert json.loads((folder / "compare.json").read_text()) == json.loads(json.dumps(result))
    rows = result["methods"]
    assert [(row["seed"], row["method"]) for row in rows] == [
        (s, m) for s in (0, 1) for m in CHOSEN
    ]
    for row in rows:
        assert set(CONTRACT) <= set(row) and row["scene"] == "bouncing"
        assert min(row["render_fps"], row["train_seconds"], row["psnr_db"]) > 0
        assert row["iterations"] == 4
    assert {row["most"] for row in result["fewer"]} == {20}
    assert len(result["fewer"]) == 2 * len(OTHERS)
    image = iio.imread(folder / "compare.png")
    assert image.std() > 5


def test_rows_are_those_of_the_files(done, scene):
    folder, result = done
    for row in [*result["methods"], *result["fewer"]]:
        most = f"_{row['most']}" if row["most"] else ""
        ending = "p4dgs" if row["method"] == OURS else "ply"
        path = folder / f"bouncing_{row['method']}{most}_seed{row['seed']}.{ending}"
        assert path.stat().st_size == row["bytes"]
        kinds = [row[f"{kind}_bytes"] for kind in ("gaussians", "network", "other")]
        assert sum(kinds) == row["bytes"] and min(kinds) >= 0
        model = p4.decode(path.read_bytes()) if ending == "p4dgs" else baselines.load(path)
        metrics = evaluate(model, scene)[0]
        assert metrics["psnr_db"] == pytest.approx(row["psnr_db"], rel=1e-12)
        assert metrics["ssim"] == pytest.approx(row["ssim"], rel=1e-12)
        if row["most"]:
            assert model.primitives <= 20
    one, other = (row["psnr_db"] for row in result["methods"] if row["method"] == OURS)
    assert one != other


def test_summary_and_ratios(done):
    _, result = done
    psnr = {m: [r["psnr_db"] for r in result["methods"] if r["method"] == m] for m in CHOSEN}
    size = {m: np.mean([r["bytes"] for r in result["methods"] if r["method"] == m]) for m in CHOSEN}
    for own in result["summary"]:
        values = psnr[own["method"]]
        assert own["psnr_db"] == pytest.approx(np.mean(values))
        assert own["psnr_db_spread"] == pytest.approx(abs(values[0] - values[1]) / 2)
        assert own["bytes"] == size[own["method"]]
    for other in result["against"]:
        name = other["method"]
        assert other["ratio"] == pytest.approx(size[name] / size[OURS])
        assert 0 < other["ratio"] - other["network_share"] - other["gaussians_share"] < 0.2
        gains = np.subtract(psnr[OURS], psnr[name])
        assert other["psnr_gain"] == pytest.approx(gains.mean())
        assert other["psnr_gain_range"] == pytest.approx([gains.min(), gains.max()])
        assert len(other["curve"]) == 2


def test_the_tables_show_the_papers_numbers_apart(done):
    text = study.describe(done[1]).splitlines()
    heading = next(i for i, line in enumerate(text) if line.startswith("method"))
    assert text[heading].count("the paper's") == 2
    assert [line.split()[0] for line in text[heading + 1 :][: len(CHOSEN)]] == list(CHOSEN)
    ours = " ".join(text[heading + 1].split())
    assert ours.endswith("38.10 0.985 1.039 262 24.18 0.855 0.704 274")
    assert text[heading + 2].split()[0] == "d3dgs_small"
    assert text[heading + 2].split()[-2:] == ["-", "-"]


def test_every_scene_has_a_table_where_there_are_several(done):
    result = done[1]
    assert "bouncing  " not in study.describe(result)
    better = [{**row, "scene": "second", "psnr_db": 1.5} for row in result["methods"]]
    text = study.describe({**result, "methods": [*result["methods"], *better]}).splitlines()
    at = next(i for i, line in enumerate(text) if line.startswith("second "))
    lines = [line.split() for line in text[at + 1 :][: len(CHOSEN)]]
    assert [line[:3] for line in lines] == [[name, "1.50", "±0.00"] for name in CHOSEN]
    assert any(line.startswith("bouncing ") for line in text)


def rows_of(table):
    """Rows of one scene and seed from {(method, most): (bytes, psnr)}."""
    rest = {"scene": "s", "seed": 0, "ssim": 0.9, "render_fps": 100.0, "train_seconds": 1.0}
    sizes = {"network_bytes": 10, "gaussians_bytes": 20}
    return [
        {**rest, **sizes, "method": method, "most": most, "bytes": size, "psnr_db": psnr}
        for (method, most), (size, psnr) in table.items()
    ]


def test_a_ratio_at_unequal_quality_is_noted():
    def words(psnr, curve=()):
        full = rows_of({(OURS, None): (100, psnr), ("d3dgs", None): (800, 34.0)})
        fewer = rows_of({("d3dgs", cap): at for cap, at in curve})
        return study.sentence(study.against(full, fewer, "d3dgs"))

    assert "Note: ours is below" in words(33.0) and "33.0" not in words(33.0)
    assert "-1.00 dB" in words(33.0) and "+1.00 dB" in words(35.0)
    assert "Note" not in words(35.0)
    fair = words(33.0, [(200, (200, 32.0))])  # the middle of the curve: sqrt(200 * 800) bytes
    assert "Note" not in fair and "about 400 bytes, 4.0 times ours" in fair


def test_dates_of_all_presets_shorten_alike(scene):
    counted_otherwise = {
        *("gaussians", "sh_degree", "grow_every", "most", "L_x", "L_t"),
        *("nodes", "time_nodes", "features", "waves"),
    }
    for name in baselines.METHODS:
        full = baselines.choose(name)
        half = methods.preset_of(Task(scene, name, 0, None, full.iterations // 2))
        for field in dataclasses.fields(full):
            before, after = getattr(full, field.name), getattr(half, field.name)
            if field.name in methods.DATES:
                assert after == round(before / 2), (name, field.name)
            else:
                assert after == before
                assert type(before) is not int or field.name in counted_otherwise, (
                    f"{name}: {field.name} is a date or a count: add it to one of the lists"
                )
    assert methods.preset_of(Task(scene, OURS, 0, None, 1900)).stage_ends == (100, 150, 900, 1900)


def test_equal_times_give_a_slow_method_fewer_iterations(scene, monkeypatch):
    seconds = {OURS: 2.0, "d3dgs": 8.0, "d3dgs_small": 1.0}
    shares = []

    def clocked(function, task):
        shares.append(task.iterations)
        return None, np.array([seconds[task.method], 0.0])

    monkeypatch.setattr(methods, "clocked", clocked)
    tasks = [Task(scene, name, 0, None, 1000) for name in seconds]
    assert [task.iterations for task in methods.equal_times(tasks)] == [1000, 250, 2000]
    assert shares == [50, 50, 50]


def test_tasks_travel_to_other_processes(scene, tmp_path):
    task = pickle.loads(pickle.dumps(Task(scene, "d3dgs", 0, tmp_path, 3, 20)))
    assert task.path == tmp_path / "bouncing_d3dgs_20_seed0.ply"


def test_bytes_of_our_files_by_kind():
    sizes = {"header": 1, "positions": 2, "masks": 4, "hash_grid": 8, "anchor_mlps": 16}
    sizes["deformation_mlp"] = 32
    assert methods.kinds(sizes) == {"gaussians": 6, "network": 56, "other": 1}


def test_only_scenes_that_move_are_compared():
    names = set(study.dynamic_scenes())
    assert names >= {"bouncing", "figure", "glossy", "orbit"}
    assert not {"static", "orientation"} & names


def test_the_coded_design_is_compared_where_it_is_named():
    five = [OURS, "d3dgs", "d3dgs_small", "hexplane", "gaussian4d"]
    assert methods.known([]) == five
    assert methods.known(["hexplane", methods.CODED, OURS]) == [OURS, methods.CODED, "hexplane"]


def test_mistakes_are_named(scene, tmp_path):
    with pytest.raises(
        StudyError, match="method 'nerf': expected one of p4dgs, p4dgs_coded, d3dgs"
    ):
        study.compare([scene], tmp_path, ["nerf"])
    empty = SimpleNamespace(name="empty", test=())
    with pytest.raises(StudyError, match="scene empty: split 'test'"):
        study.compare([empty], tmp_path)
    assert not list(tmp_path.iterdir())
