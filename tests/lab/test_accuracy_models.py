"""The studies of accuracy that train, those of gradients and sizes, and the page."""

import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from p4dgs_ref.codec.file import encode
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.lab import bench, clock
from p4dgs_ref.lab.accuracy import (
    diagram,
    fits,
    gradients,
    hash_grid,
    quantisation,
    report,
    size,
    training,
)
from p4dgs_ref.model import Context
from p4dgs_ref.report.inspect import components
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.splatting import fast
from p4dgs_ref.training import objective
from p4dgs_ref.training.trainer import Trainer
from tests.lab import drawn


@pytest.fixture(scope="module")
def scene():
    return load_scene("bouncing", downscale=2)


@pytest.fixture(scope="module")
def model(scene):
    """A model with so little training that only its arithmetic can be tested."""
    return fits.train(scene, fits.reduced(40, anchors=60)).model


# --- quantisation --------------------------------------------------------------------------------
def test_fixed_steps_are_exactly_the_base_steps(scene, model):
    Q_0 = np.array(model.design.Q_0)
    assert not np.all(quantise(model).context.q == Q_0)
    assert np.all(quantise(quantisation.fixed(model)).context.q == Q_0)
    assert np.all(
        quantise(quantisation.fixed(quantisation.scaled(model, 4.0))).context.q == 4 * Q_0
    )
    preset = quantisation.preset_at(2.0, False, 20)._replace(anchors=30)
    learnt = fits.train(scene, preset, prepare=quantisation.fix_steps).model
    assert np.all(quantise(learnt).context.q == 2 * Q_0)


def test_wider_steps_need_fewer_bytes(scene, model):
    sizes = [fits.judge(quantisation.scaled(model, scale), scene) for scale in (0.25, 1, 4)]
    attributes = [size_["attribute_bytes"] for size_ in sizes]
    assert attributes == sorted(attributes, reverse=True) and attributes[0] > 1.5 * attributes[-1]
    assert len({size_["network_bytes"] for size_ in sizes}) == 1


# --- training ------------------------------------------------------------------------------------
class Chosen:
    """Stands for a Generator that draws the given rows."""

    def __init__(self, rows):
        self.rows = rows

    def choice(self, A, count, replace):
        assert count == len(self.rows) and not replace
        return np.array(self.rows)


def rate_inputs(A=5):
    rng, design = (
        np.random.default_rng(7),
        Trainer(load_scene("static", downscale=4), fits.reduced(40, anchors=4)).design,
    )
    n = sum(design.widths)
    ctx = Context(rng.uniform(0.1, 1, (A, 4)), rng.normal(size=(A, n)), rng.lognormal(size=(A, n)))
    return (
        rng.normal(size=(A, n)),
        ctx,
        [rng.normal(size=(6, 2))],
        rng.random((A, design.k)) < 0.7,
        design,
    )


def test_a_sampled_rate_is_the_whole_rate_on_average():
    inputs = rate_inputs()
    (whole_bits, whole_rate), saved = objective.rate_forward(*inputs)
    wanted = objective.rate_backward(saved, 1.5, inputs[-1])
    outputs, gradients = [], []
    for anchor in range(5):
        rate = training.SampledRate(0.2)
        rate.rng = Chosen([anchor])
        output, saved = rate.forward(*inputs)
        outputs.append(output)
        gradients.append(rate.backward(saved, 1.5, inputs[-1], objective.rate_backward))
    bits, rates = zip(*outputs)
    assert np.isclose(np.mean(bits), whole_bits) and bits[0] != bits[1]
    assert np.isclose(np.mean(rates), whole_rate)
    for i in range(4):
        assert np.allclose(np.mean([g[i] for g in gradients], axis=0), wanted[i]), i
    assert np.allclose(np.mean([g[4] for g in gradients], axis=0), wanted[4])


def test_rating_a_share_counts_that_share_and_leaves_the_objective_alone(scene):
    preset, kept = fits.reduced(20, anchors=40), (objective.rate_forward, objective.rate_backward)
    whole = fits.train(scene, preset)
    with training.rated(0.05):
        assert objective.rate_forward is not kept[0]
        few = fits.train(scene, preset, rated_share=0.05)
    assert (objective.rate_forward, objective.rate_backward) == kept
    assert few.work["rated_symbols"] * 20 == whole.work["rated_symbols"] > 0
    assert [fits.sampled(A, 0.05) for A in (1, 9, 30, 200)] == [1, 1, 2, 10]
    A, n = 40, sum(whole.model.design.widths)
    assert whole.work["rated_symbols"] == A * n * (preset.stage_ends[3] - preset.stage_ends[2])


def test_wider_networks_are_more_multiply_adds(scene):
    design = Trainer(scene, fits.reduced(20, anchors=10, deformation=(8, 16))).design
    inputs = 3 * (1 + 2 * design.L_x) + 1 + 2 * design.L_t
    heads = sum(columns for _, columns in design.layers()["psi_d"][2:])
    assert fits.multiply_adds(design, ("psi_d",), 7) == 3 * 7 * (inputs * 8 + 8 * 16 + 16 * heads)


def test_a_reduced_preset_keeps_the_shares_of_the_stages():
    from p4dgs_ref.training.presets import TINY

    assert fits.reduced(TINY.iterations) == TINY
    short = fits.reduced(380, anchors=17)
    assert (
        short.stage_ends == (20, 30, 180, 380) and short.anchors == 17 and short.decay_from == 180
    )


# --- hash grid -----------------------------------------------------------------------------------
def test_a_context_learns_to_save_bits(model):
    held = quantisation.fixed(model)
    q = quantise(held)
    fit = hash_grid.ContextFit(held, q, hash_grid.LEVELS[4], 512)
    first = fit.step()[0]
    for _ in range(80):
        last = fit.step()[0]
    assert last < 0.97 * first
    assert fit.located.nnz == len(fit.values) * (8 + 3 * 4) and [
        len(g) for g in fit.p.listed("grid")
    ] == [512, 256, 256, 256]
    alone = hash_grid.without_context(held, q)
    sizes = hash_grid.written(held, fit.design, fit.networks, fit.p.listed("grid"))
    assert sizes["attribute_bytes"] < alone["attribute_bytes"] and sizes["grid_bytes"] > 4


def test_the_prior_without_context_has_the_moments_of_the_coded_values():
    values, kept = np.array([[1.0, 9], [3, 5], [8, 5]]), np.array([[1, 0], [1, 1], [0, 1]], bool)
    mu, raw = hash_grid.channel_moments(values, kept, np.full((3, 2), 0.2))
    assert np.allclose(mu, [2, 5]) and np.allclose(
        np.exp(raw), [1, 0.2 * hash_grid.LEAST_DEVIATION]
    )


def test_the_net_bytes_count_grid_and_networks_and_say_from_where_on_they_pay(model):
    held = quantisation.fixed(model)
    q = quantise(held)
    _, row = hash_grid.learnt(held, q, *hash_grid.COMMON, 5)
    plain = 4 * sum(held.design.widths)  # one mean and deviation per channel in float16
    assert row["mlp_bytes"] == components(encode(held))["context_mlps"] > 1000
    assert row["cost_bytes"] == row["grid_bytes"] + row["mlp_bytes"] - plain
    assert row["net_bytes"] == row["alone_bytes"] - row["attribute_bytes"] - row["cost_bytes"] < 0
    assert row["anchors"] == len(q.kept)

    def measured(*saved):
        return [
            {"anchors": A, "saved_bytes": A * s, "cost_bytes": 4000, "net_bytes": A * s - 4000}
            for A, s in zip((100, 1000, 2000), saved)
        ]

    assert hash_grid.pays_from(measured(2, 3, 5)) == pytest.approx(1000 + 1000 * 1000 / 7000)
    assert hash_grid.pays_from(measured(2, 1, 1)) == pytest.approx(4000)
    assert hash_grid.says(measured(2, 1, 1)).endswith("about 4,000 anchors on, extrapolated")


# --- more knobs of a training --------------------------------------------------------------------
def test_a_training_in_double_precision_is_one(scene):
    preset = fits.reduced(20, anchors=20)
    trainer = Trainer(scene, preset)
    training.in_float64(trainer)
    losses, seen, _ = trainer.step()
    assert trainer.parameters.vector.dtype == seen.image.dtype == float
    assert trainer.adam.first.vector.dtype == float
    single = Trainer(scene, preset).step()[0].L_total
    assert losses.L_total != single and losses.L_total == pytest.approx(single, rel=1e-4)


def test_the_loss_estimates_nearly_the_bytes_of_the_file(scene, model):
    row = fits.judge(model, scene)
    assert row["coded_bytes"] == row["attribute_bytes"] + row["grid_bytes"]
    assert 0 < row["coded_bytes"] - row["estimated_bytes"] < 0.03 * row["coded_bytes"] + 60


def test_every_stage_of_every_run_is_timed(monkeypatch):
    runs = [run for run in training.plan(True)[1] if run.method in ("precision", "anchors rated")]
    monkeypatch.setattr(training, "alternate", lambda steps, repeats: dict.fromkeys(steps, ONE))
    scene = load_scene("bouncing", downscale=4)
    for step in (fits.step_at(scene, runs[0].preset, stage) for stage in (1, 4)):
        step()
        step()
    for columns in training.seconds(runs):
        assert columns["seconds"] == pytest.approx(0.120 * 2)  # 120 iterations of 2 ms
        assert columns["seconds_low"] == pytest.approx(0.120)
        assert columns["seconds_high"] == pytest.approx(0.120 * 4)
        assert columns["stretch"] == pytest.approx(1.5)


def test_a_difference_smaller_than_that_of_seeds_is_no_reading():
    rows = [{"psnr_db": 20.0, "bytes": 900}, {"psnr_db": 19.9, "bytes": 1000}]
    assert training.difference(*rows, 0.05) == "+0.10 dB and -100 bytes"
    assert "we cannot tell: seeds differ by more" in training.difference(*rows, 0.2)


ONE = clock.Times(2.0, 1.0, 4.0, 1.5)


# --- gradients -----------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def curves():
    return gradients.sweep("compositing", True)


def errors_of(rows, method, dtype="float64"):
    return {
        round(-math.log10(row["step"])): row["error"]
        for row in rows
        if (row["method"], row["dtype"]) == (method, dtype)
    }


def test_errors_of_difference_quotients_fall_with_their_order(curves):
    for method, order in (("forward", 1), ("central", 2), ("fourth order", 4)):
        error = errors_of(curves, method)
        assert abs(math.log10(error[2] / error[3]) - order) < 0.35, method
    best = {method: min(errors_of(curves, method).values()) for method in gradients.METHODS}
    assert 1e-9 < best["forward"] < 1e-6 and best["central"] < 0.1 * best["forward"]
    assert best["fourth order"] < 0.1 * best["central"] and best["complex step"] < 1e-15
    assert min(errors_of(curves, "central", "float32").values()) > 1e3 * best["central"]
    assert errors_of(curves, "complex step")[20] < 1e-15  # no difference, no cancellation


def test_evaluations_are_counted(curves):
    n = curves[0]["inputs"]
    assert n == 7 * (2 + 3 + 1 + 3) + 3
    assert {row["method"]: row["evaluations"] for row in curves} == {
        "forward": n + 1,
        "central": 2 * n,
        "fourth order": 4 * n,
        "complex step": n,
    }


def test_a_wrong_backward_would_be_seen(monkeypatch):
    honest = gradients.Loss.backward

    def slightly_wrong(loss, x):
        gradient = honest(loss, x)
        gradient[np.abs(gradient).argmax()] *= 1 + 1e-9
        return gradient

    monkeypatch.setattr(gradients.Loss, "backward", slightly_wrong)
    assert min(errors_of(gradients.sweep("opacity", True), "complex step").values()) > 1e-11


def test_the_tolerance_in_the_figure_is_that_of_the_tests():
    text = (Path(__file__).parents[1] / "core" / "adjoint.py").read_text()
    assert f"allowed = {gradients.TOLERANCE:.0e} ".replace("e-07", "e-7") in text


# --- cost against size ---------------------------------------------------------------------------
def test_a_blown_up_view_shows_the_same_scene(scene):
    small, large = scene.train[0], size.blown_up(scene, 3, 2).train[0]
    assert large.image.shape == (96, 96, 3) and np.array_equal(large.image[1::3, 1::3], small.image)
    for a, b in ((small.camera.c_x, large.camera.c_x), (small.camera.c_y, large.camera.c_y)):
        assert np.isclose(3 * (a + 0.5), b + 0.5)  # the same point, seen from the image's corner


def test_parts_are_gauged_counted_and_left_as_they_were():
    rows_before = {
        (owner, name): getattr(owner, name)
        for places in bench.PARTS.values()
        for owner, name in places
    }
    scene_ = size.blown_up(load_scene("bouncing", downscale=4), 1, 2)
    found = {}
    for A in (20, 60):
        trainer = size.at_stage_4(scene_, A)
        times, memory = bench.step_times(trainer), size.part_memory(trainer)
        assert all(0 < times[part][0] <= times["whole step"][0] for part in bench.PARTS)
        assert all(0 < memory[part] <= memory["whole step"] for part in bench.PARTS)
        found[A] = size.counted(trainer, 256)
        assert found[A]["projection"] == size.LIVE * A and found[A]["loss"] == 256
    assert (
        found[60]["deformation"] == 3 * found[20]["deformation"]
        and found[60]["compositing"] > found[20]["compositing"]
    )
    assert all(getattr(owner, name) is function for (owner, name), function in rows_before.items())
    assert fast.forward is rows_before[fast, "forward"]


def test_pairs_at_the_goal_are_counted_in_windows():
    changed = dict(GOAL_ANCHORS=60, GOAL_SIDE=64, WINDOWS=4, WINDOW_SIDE=16)
    with bench.replaced(size, **changed):  # windows that cover the whole picture
        whole = size.work_at_goal()
    with bench.replaced(size, **changed | dict(WINDOWS=2)):  # its four corners alone
        corners = size.work_at_goal()
    trainer = size.prepared(size.blown_up(load_scene("bouncing", downscale=2), 2, 1), 60)
    trainer.settings = trainer.settings._replace(dtype="float64")
    real = size.counted(trainer, 64**2)
    assert 0.75 * real["compositing"] < whole["compositing"] < 1.25 * real["compositing"]
    assert corners["compositing"] < whole["compositing"]  # there is less to see in corners
    assert {**whole, "compositing": 0} == {**corners, "compositing": 0}
    assert {**whole, "compositing": 0} == {**real, "compositing": 0}


# --- the page ------------------------------------------------------------------------------------
@pytest.fixture
def overlapping(monkeypatch):
    """The texts that overlap in any figure of a study, [(file, text, text)]."""
    found, save = [], diagram.save_figure

    def watched(figure, path):
        found.extend((path.name, *pair) for pair in drawn.overlaps(figure))
        save(figure, path)

    monkeypatch.setattr(diagram, "save_figure", watched)
    return found


def check_page(folder, result):
    page = (folder / report.PAGE).read_text(encoding="utf-8")
    for name in ("CPU", "cores", "NumPy", "SciPy", "BLAS threads"):
        assert f"{name} {result['machine'][name]}" in page
    for study in result["studies"]:
        assert study["reading"] in page and study["reference"] in page and study["repeats"] in page
        assert study["figures"] and study["tables"]
        for file, caption in study["figures"]:
            assert f"![{caption}]({file})" in page
            height, width = iio.imread(folder / file).shape[:2]
            assert 850 <= width <= 1000 and height >= 500, file
        for file in study["tables"]:
            header, *rows = (folder / file).read_text().splitlines()
            assert f"({file})" in page and rows and "," in header
    assert {path.name for path in folder.iterdir()} == {
        report.PAGE,
        *(
            file
            for study in result["studies"]
            for file in (*study["tables"], *(figure for figure, _ in study["figures"]))
        ),
    }
    json.dumps(result)


@pytest.mark.slow
def test_chosen_studies_make_a_page(tmp_path, overlapping):
    said = []
    result = report.run(["gradients", "coder"], tmp_path, True, said.append)
    assert [study["name"] for study in result["studies"]] == ["coder", "gradients"]
    check_page(tmp_path, result)
    assert any("coder" in line for line in said) and "quick" in (tmp_path / report.PAGE).read_text()
    assert report.describe(result, tmp_path).endswith("s in all")
    assert overlapping == []


def test_an_unknown_study_is_refused_before_any_work(tmp_path):
    with pytest.raises(
        ValueError, match="study 'colour': expected one of rendering, likelihood, coder"
    ):
        report.run(["rendering", "colour"], tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_all_studies_quickly(tmp_path, overlapping):
    result = report.run(None, tmp_path, True)
    assert [study["name"] for study in result["studies"]] == list(report.STUDIES)
    assert len(report.STUDIES) == 8
    check_page(tmp_path, result)
    assert overlapping == []
