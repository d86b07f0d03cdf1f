"""The studies of accuracy against time: how they measure, rendering, likelihood and coder.

The tests look at counted work and at the order of errors, never at times.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.codec.streams import decode_symbols
from p4dgs_ref.equations import likelihood
from p4dgs_ref.lab import bench
from p4dgs_ref.lab.accuracy import coder, diagram, formulas, rendering, report, timing
from p4dgs_ref.lab.accuracy import likelihood as likelihood_study
from p4dgs_ref.splatting.settings import Settings

TABLE = json.loads(
    (Path(__file__).parents[1] / "golden" / "data" / "gaussian_bin_constants.json").read_text()
)
Z, W, BITS, BITS_X, BITS_Q = (np.array(column) for column in zip(*TABLE["rows"]))


# --- how it is measured --------------------------------------------------------------------------
def test_special_functions_are_counted_and_left_as_they_were():
    before = dict(vars(formulas))
    x = np.linspace(0.1, 2, 7)[None]
    one = np.ones_like(x)
    assert timing.special_calls(formulas, lambda: formulas.literal(x, 0 * x, one, one)) == 35
    assert dict(vars(formulas)) == before
    with pytest.raises(ZeroDivisionError), bench.replaced(formulas, ndtr=None):
        1 / 0
    assert formulas.ndtr is before["ndtr"]


def test_failures_are_drawn_in_red_at_the_edge_and_stay_out_of_the_line():
    rows = [
        {"method": "stable", "knob": i, "ms": 1.0 + i, "error": e}
        for i, e in enumerate((0.1, math.inf, 0.001, 0.0))
    ]
    figure, (ax,) = diagram.figure()
    diagram.lines(ax, rows, diagram.TIME)
    line, *marks = ax.lines
    assert list(line.get_ydata()) == [0.1, 0.001]
    assert [(mark.get_color(), mark.get_ydata()[0] > 0.1) for mark in marks] == [
        ("red", True),
        (diagram.STYLES["stable"]["color"], False),
    ]
    diagram.pyplot().close(figure)


@pytest.mark.parametrize(
    "value, text",
    [
        (0, "0"),
        (0.5, "0.5"),
        (3.2e-7, "3.2e-07"),
        (math.inf, "infinite"),
        (math.nan, "not a number"),
        (250000, "2.5e+05"),
    ],
)
def test_numbers_for_sentences(value, text):
    assert diagram.number(value) == text


# --- rendering -----------------------------------------------------------------------------------
def rendered(name="small splats", n=120, side=32, **settings):
    """The errors and pairs of the fast renderer under some settings."""
    scene = rendering.splat_scene(name, n, side)
    settings = {"dtype": "float64", "footprint": "ellipse", **settings}
    found = rendering.tiled(scene, Settings("test", **settings))
    return rendering.errors(found, rendering.exact(scene))


def test_listing_everything_costs_every_pair_and_errs_by_rounding_alone():
    row = rendered(footprint="all")
    _, _, pairs = rendering.exact(rendering.splat_scene("small splats", 120, 32))
    assert row["pairs"] == pairs == 120 * 32 * 32
    assert row["error"] < 1e-13 and row["gradient_error"] < 1e-12
    assert 1e-9 < rendered(footprint="all", dtype="float32")["gradient_error"] < 1e-5


def test_a_lower_cut_costs_pairs_and_buys_accuracy():
    rows = [rendered(cut=cut) for cut in rendering.CUTS.values()]
    assert list(rendering.CUTS.values()) == sorted(rendering.CUTS.values(), reverse=True)
    for key in ("error", "rms_error", *(f"{name}_error" for name in rendering.GRADIENTS)):
        values = [row[key] for row in rows]
        assert values == sorted(values, reverse=True) and values[-1] < 1e-6 < values[0], key
    pairs = [row["pairs"] for row in rows]
    assert pairs == sorted(pairs) and pairs[0] < pairs[-1] < 120 * 32 * 32


def test_the_stop_saves_pairs_where_splats_are_opaque():
    without, early = (rendered("large, opaque", 400, cut=5e-5, stop=stop) for stop in (0.0, 1e-2))
    assert early["pairs"] < 0.8 * without["pairs"] and without["error"] < early["error"] <= 0.02


def test_fast_is_more_accurate_than_paper_with_fewer_pairs():
    rows, text = report.summary(1)
    exact, paper, fast_ = rows
    assert [row["settings"] for row in rows] == ["exact", "paper", "fast"] and json.dumps(rows)
    for key in ("error", "rms_error", *(f"{name}_error" for name in rendering.GRADIENTS)):
        assert exact[key] == 0 < fast_[key] < 0.1 * paper[key], key
    assert fast_["pairs"] < paper["pairs"] < exact["pairs"] == 1000 * 64 * 64
    assert len(text.splitlines()) == 5 + ("Disturbed" in text)
    assert all(f"\n{name}" in text for name in ("exact", "paper", "fast"))


# --- likelihood ----------------------------------------------------------------------------------
def test_the_truth_of_the_plane_agrees_with_stored_constants():
    log_p, slope_z, slope_w = formulas.truth(np.abs(Z), W)
    assert np.all(np.abs(-log_p / math.log(2) - BITS) <= 1e-12 * np.maximum(BITS, 1e-6))
    largest = np.maximum(np.abs(BITS_X), np.abs(BITS_Q))
    for slope, wanted in ((slope_z * np.sign(Z), BITS_X), (slope_w, BITS_Q)):
        assert np.all(np.abs(-slope / math.log(2) - wanted) <= 1e-12 * largest + 1e-300)


def test_the_truth_of_the_plane_agrees_with_sixty_digits():
    for quick in (True, False):
        bits, slopes = likelihood_study.check_truth(quick)
        assert bits < 1e-13 and slopes < 1e-12


def test_formulas_agree_where_all_of_them_work():
    rng = np.random.default_rng(3)
    mu, sigma = rng.normal(size=(2, 9)), rng.lognormal(size=(2, 9))
    x, q = mu + sigma * rng.uniform(-3, 3, (2, 9)), sigma * rng.uniform(0.3, 2, (2, 9))
    wanted, wanted_slopes = likelihood.forward(x, mu, sigma, q)
    for name, formula in formulas.FORMULAS.items():
        bits, slopes = formula(x, mu, sigma, q)
        tolerance = 1e-2 if name.startswith("table") else 1e-9
        assert np.allclose(bits, wanted, rtol=tolerance), name
        for got, want in zip(slopes, wanted_slopes, strict=True):
            assert np.allclose(got, want, rtol=5 * tolerance, atol=tolerance), name
        single, slopes = formula(*(a.astype(np.float32) for a in (x, mu, sigma, q)))
        assert {a.dtype for a in (single, *slopes)} == {np.dtype(np.float32)}


def test_errors_over_the_plane_are_ordered():
    z, w = (a.ravel() for a in np.meshgrid(*likelihood_study.plane(True), indexing="ij"))
    found = {
        name: likelihood_study.errors(formula, z, w, "float64")
        for name, formula in formulas.FORMULAS.items()
    }
    failed = {name: np.mean(~np.isfinite(bits)) for name, (bits, _) in found.items()}
    assert failed["stable"] == failed["log domain"] == failed["HAC, floor 1e-6"] == 0
    assert failed["literal"] > failed["tail-symmetric"] > 0.1
    assert found["stable"][0].max() <= 1e-12 and found["stable"][1].max() <= 1e-9
    assert found["log domain"][0].max() > 1e-8  # narrow bins: two logarithms that agree
    floored = -formulas.truth(z, w)[0] > -math.log(0.9e-6)
    assert floored.mean() > 0.4
    assert np.all(found["HAC, floor 1e-6"][1][floored] == 1)  # the gradient is 0
    assert np.isfinite(found["tail-symmetric"][0][z < 30]).all()


def test_rows_of_the_diagram_count_and_order():
    rows = likelihood_study.timed_rows(300, 1)
    near, far = (
        {(row["method"], row["knob"]): row for row in rows if row["reach"] == reach}
        for reach in likelihood_study.REACHES
    )
    work = {key: row["special_per_value"] for key, row in near.items()}
    assert work["literal", "float64"] == work["tail-symmetric", "float32"] == 5
    assert work["log domain", "float64"] == 6
    assert work["table, float64", "256/σ"] == 1 < work["stable", "float64"] < 10
    table = [near["table, float64", f"{n}/σ"]["bits_error"] for n in formulas.TABLES]
    assert table == sorted(table, reverse=True) and table[-1] < 1e-3 * table[0]
    assert far["literal", "float64"]["bits_error"] == math.inf
    assert far["stable", "float64"]["bits_error"] < 1e-12
    assert far["stable", "float32"]["bits_error"] < 2e-6


# --- entropy coder -------------------------------------------------------------------------------
def test_frequencies_add_up_to_their_precision():
    symbols, mu, sigma, _ = coder.message(200)
    for precision in (12, 24):
        model_ = coder.model_of(mu, sigma, precision, 4, 2, 5.0)
        unit = 1 << 24 - precision
        assert np.all(np.diff(model_.keys) >= unit) and not np.any(model_.keys % unit)
        assert np.array_equal(
            model_.keys[np.append(model_.first, len(model_.keys) - 1)] >> 24,
            np.arange(len(model_.first) + 1),
        )
        escapes = model_.first + model_.blocks
        assert np.all(
            np.diff(model_.keys)[escapes] == unit
        )  # one count, so all others are the window's
        deviation = sigma.max()
        assert (
            model_.blocks.max()
            == 2 * (1 + math.ceil(5 * 2 ** (round(4 * math.log2(deviation)) / 4))) + 1
        )
    with pytest.raises(ValueError, match="does not fit"):
        coder.model_of(mu, sigma, 8, 4, 2, 12.0)


def test_symbols_and_escapes_are_decoded():
    symbols, mu, sigma, _ = coder.message(400, seed=5)
    symbols[::50] += np.array([1, -1] * 4) * np.array([100, 40, 7000, 9, 12, 33, 2**20, 2**30])
    model_ = coder.model_of(mu, sigma, 10, 3, 3, 3.0)
    data, ideal, escapes = coder.encode(symbols, model_)
    assert escapes >= 5 and np.array_equal(decode_symbols(data, model_), symbols)
    assert 0 <= 8 * len(data) - ideal < 200


def test_more_bits_never_cost_more_than_they_save():
    rows = coder.code(1500, 1, lambda line: None)
    for method, least in (
        ("frequencies, 12σ window", 5),
        ("frequencies, fitted window", 9),
        ("mean", 8),
        ("log2 deviation", 6),
    ):
        line = [row["model_percent"] for row in rows if row["method"] == method]
        assert len(line) >= least and line[0] > line[2] > line[-1], method
    codec = diagram.at(rows, method="the codec")
    own = diagram.at(rows, method="mean", knob=10)
    assert (
        abs(codec["model_percent"] - own["model_percent"]) < 0.05
        and codec["table_entries"] < own["table_entries"] / 2
    )
    assert all(
        row["symbols"] == 1500 and row["percent"] > row["model_percent"] - 1e-9 for row in rows
    )


def test_lanes_cost_bytes_and_decode_to_the_same_symbols():
    rows = coder.code(3000, 1, lambda line: None)
    laned = diagram.select(rows, method=coder.LANED)
    sizes = [row["bytes"] for row in laned]
    assert [row["knob"] for row in laned] == [1, 8, 32, 128]  # too few symbols for 512
    assert sizes == sorted(set(sizes)) and sizes[0] == diagram.at(rows, method=coder.CODEC)["bytes"]
    # Closing a lane takes about 4.5 bits, and the tail is coded in the first lane alone.
    assert all(row["bytes"] - sizes[0] < 8 + 4 * row["knob"] for row in laned)
