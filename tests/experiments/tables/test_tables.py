"""The tables: what a row has, and what differs from one step to the next."""

import dataclasses

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.codec.container import read_container
from p4dgs_ref.codec.file import quantised_of
from tutorials.experiments.baselines import d3dgs
from tutorials.experiments.tables import ablate, compare
from tutorials.experiments.tables.methods import lasting, preset_of
from tutorials.experiments.tables.rows import rows


def shown(table, scene, iterations, folder, capsys):
    """The tasks of a table, its rows and its lines."""
    tasks = table.plan(scene, 1, iterations)
    found = rows(tasks, "table", folder)
    capsys.readouterr()
    table.show(scene, tasks, found, folder)
    return tasks, found, capsys.readouterr().out.splitlines()


def test_compare_has_all_methods_beside_the_papers_numbers(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(compare, "TURNS", 1)
    _, found, lines = shown(compare, scene, 6, tmp_path, capsys)
    start = next(i for i, line in enumerate(lines) if line.startswith("method"))
    body = [line.split() for line in lines[start + 1 :][:4]]
    assert [cells[0] for cells in body] == ["p4dgs", "d3dgs", "hexplane", "gaussian4d"]
    assert body[0][-8:] == "38.10 0.985 1.039 262 24.18 0.855 0.704 274".split()
    for cells, row in zip(body, found):
        assert cells[4] == f"{row['bytes']:,}"
        assert cells[7] == f"{row['bytes'] / found[0]['bytes']:.1f}" and float(cells[8]) > 0
    assert iio.imread(tmp_path / "compare.png").std() > 5


@pytest.fixture(scope="module")
def ablated(scene, tmp_path_factory):
    """The models and files of all steps after a few iterations."""
    folder, tasks = tmp_path_factory.mktemp("ablate"), ablate.plan(scene, 1, 12)
    rows(tasks, "ablate", folder)
    files = {task.label: folder / task.file for task in tasks}
    return {task.label: task.load(folder / task.file) for task in tasks}, files


def test_each_step_of_table_3_changes_its_part(ablated, scene):
    models, files = ablated
    spatial, compact, whole = (models[name] for name in [*ablate.PAPER][1:])
    assert [*models] == [*ablate.STEPS] and models["D3DGS"].METHOD == "d3dgs"
    assert spatial.design.deformation == d3dgs.Preset().deformation
    assert compact.design.deformation == whole.design.deformation == (64, 64)
    for model, half in ((spatial, False), (compact, True)):
        W, other = model.networks["psi_d"][0][0], model.networks["psi_c"][0][0]
        assert (W == W.astype(np.float16)).all() == half and (W == W.astype(np.float32)).all()
        assert (other != other.astype(np.float16)).any()
        assert model.anchors.mask.all() and "psi_p" not in model.networks
    sizes = [files[name].stat().st_size for name in ablate.PAPER]
    assert sizes == sorted(sizes, reverse=True)
    for task in ablate.plan(scene, 1, 400)[1:3]:
        preset = preset_of(task)
        assert preset.stage(399) == 3 and preset.mask_from == preset.iterations == 400
        assert max(preset.Q_f, preset.Q_s, preset.Q_l, preset.Q_O) < 1e-12


def test_parts_left_out(ablated, scene):
    models, files = ablated
    assert "psi_d" in models[ablate.WHOLE].networks
    assert "psi_d" not in models["no deformation"].networks
    assert models["no masking"].anchors.mask.all()
    contexts = {
        name: quantised_of(read_container(files[name].read_bytes())).context
        for name in ("fixed step", "global prior")
    }
    base = preset_of(ablate.plan(scene, 1, 12)[3])
    q, steps = contexts["fixed step"].q, (base.Q_f, base.Q_s, base.Q_l, base.Q_O)
    np.testing.assert_allclose(q, np.tile(steps, (len(q), 1)), rtol=1e-4)
    for name, same in (("global prior", True), ("fixed step", False)):
        assert (np.ptp(contexts[name].mu_units, axis=0) == 0).all() == same


def test_changes_are_against_the_step_before_and_said_to_be_none_within_the_spread():
    def row(name, seed, size, psnr):
        return {"label": name, "seed": seed, "bytes": size, "psnr_db": psnr}

    names, gains = [*ablate.PAPER][:2], (0.1, 0.2, 0.3)
    found = [row(names[0], seed, 1000, 30) for seed in range(3)]
    found += [row(names[1], seed, 500, 30 + gain) for seed, gain in enumerate(gains)]
    first, second = ablate.summaries(found)
    assert "gain" not in first and second["paper"] == "7.27 38.36 -87.1 +0.32"
    assert (second["percent"], second["gain"]) == ("-50.00", "+0.20")
    # Differences of 0, 0.2 and 0.4 dB have a standard error of 0.115 dB.
    assert ablate.change([0, 0.2, 0.4]) == "none (+0.20)" and ablate.change([0.2]) == "+0.20 ?"
    found += [row(name, 0, size, 29) for name, size in ((ablate.WHOLE, 200), ("fixed step", 210))]
    found += [row(ablate.NETWORK, 0, 400, 29)]
    changes = {one["label"]: one.get("percent") for one in ablate.summaries(found)}
    assert (changes[ablate.WHOLE], changes["fixed step"]) == ("-50.00 ?", "+5.00 ?")


def test_all_dates_of_a_preset_are_stretched_alike(scene):
    for task in compare.plan(scene, 1, 3800):
        if task.method == "p4dgs":
            preset = preset_of(task)
            assert lasting(preset, 3800) == preset
            assert lasting(preset, 7600).stage_ends == (400, 600, 3600, 7600)
            assert lasting(preset, 7600).mask_from == 2 * preset.mask_from
    long = lasting(dataclasses.replace(d3dgs.Preset(), iterations=100), 50)
    assert (long.iterations, long.warm_up, long.grow_every) == (50, 100, 100)
