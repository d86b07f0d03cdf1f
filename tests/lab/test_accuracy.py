"""The knobs of accuracy: their forms, the harnesses that measure them, the page and its figures.

The tests look at errors, bytes and counted pairs, never at times.
"""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.arithmetic import kernels
from p4dgs_ref.designs import decode, encode
from p4dgs_ref.lab import clock
from p4dgs_ref.lab.accuracy import diagram, formulas, harness, knobs, report
from p4dgs_ref.lab.stability import plane
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.training.presets import TINY
from tests.golden.both import quantise
from tests.tutorials import drawn

TABLE = json.loads(
    (Path(__file__).parents[1] / "golden" / "data" / "gaussian_bin_constants.json").read_text(
        encoding="utf-8"
    )
)
Z, W, BITS, BITS_X, BITS_Q = (np.array(column) for column in zip(*TABLE["rows"]))
SMALL = load_scene("bouncing", downscale=8)
KNOBS = {knobs.file_name(knob): knob for knob in knobs.KNOBS}


# --- Eq. (11) ------------------------------------------------------------------------------------
def test_the_truth_agrees_with_stored_constants_and_with_sixty_digits():
    log_p, slope_z, slope_w = formulas.truth(np.abs(Z), W)
    assert np.all(np.abs(-log_p / math.log(2) - BITS) <= 1e-12 * np.maximum(BITS, 1e-6))
    largest = np.maximum(np.abs(BITS_X), np.abs(BITS_Q))
    for slope, wanted in ((slope_z * np.sign(Z), BITS_X), (slope_w, BITS_Q)):
        assert np.all(np.abs(-slope / math.log(2) - wanted) <= 1e-12 * largest + 1e-300)
    bits, slopes = formulas.check_truth()
    assert bits < 1e-15 and slopes < 2e-14


def test_errors_over_the_plane_are_ordered():
    z, w = (a.ravel() for a in np.meshgrid(*(axis[::3] for axis in plane()), indexing="ij"))
    errors = {n: formulas.errors(f, z, w, "float64") for n, f in formulas.FORMULAS.items()}
    failed = {name: np.mean(~np.isfinite(bits)) for name, (bits, _) in errors.items()}
    assert failed["stable"] == failed["log domain"] == failed["HAC, floor 1e-6"] == 0
    assert failed["literal"] > failed["tail-symmetric"] > 0.1
    assert errors["stable"][0].max() <= 1e-12 and errors["stable"][1].max() <= 1e-9
    assert errors["log domain"][0].max() > 1e-8  # narrow bins: two logarithms that agree
    floored = -formulas.truth(z, w)[0] > -math.log(0.9e-6)
    assert floored.mean() > 0.4
    assert np.all(errors["HAC, floor 1e-6"][1][floored] == 1)  # the gradient is 0
    assert np.isfinite(errors["tail-symmetric"][0][z < 30]).all()


# --- forms of functions --------------------------------------------------------------------------
def judged(name):
    """The errors of the forms of a knob, {(line, value): columns}, without times."""
    with np.errstate(all="ignore"):
        return {key: judge(run()) for key, (run, judge) in KNOBS[name].values(True).items()}


# The largest error of a line's first value, and the smallest of its last one.
ENDS = {
    ("renderer", ""): (0, 1 / 510),
    ("cut", "float32"): (1e-6, 1e-3),
    ("cut", "float64"): (1e-8, 1e-3),
    ("stop", "tiles of 8 pixels"): (1e-4, 1e-3),
    ("stop", "tiles of 16 pixels"): (1e-4, 1e-3),
    ("precision", "compositing"): (0, 1e-8),
    ("precision", "likelihood"): (0, 1e-8),
    ("precision", "opacity"): (0, 1e-8),
    ("likelihood", "the declared domain"): (1e-9, math.inf),
    ("likelihood", "up to 3 σ, bins of 0.01 to 10 σ"): (1e-13, 1e-13),
    ("likelihood_table", ""): (1e-13, 0.1),
    ("noise_draws", ""): (2e-3, 2e-3),
}


@pytest.fixture(scope="module")
def errors():
    return {name: judged(name) for name in dict.fromkeys(name for name, _ in ENDS)}


def test_cheaper_forms_err_more(errors):
    formula_knobs = [name for name, knob in KNOBS.items() if knob.harness == "formula"]
    assert set(errors) == set(formula_knobs)
    for (name, line), (most, least) in ENDS.items():
        along = [row["error"] for (of, _), row in errors[name].items() if of == line]
        assert along[0] <= most and along[-1] >= least, (name, line, along)
        if line != "up to 3 σ, bins of 0.01 to 10 σ":
            rises = np.diff(np.minimum(along, 1e9)) >= 0
            assert rises.all(), (name, line, along)


def test_forms_of_the_renderer_count_their_pairs(errors):
    exact, fast, paper = (
        errors["renderer"]["", name]["pairs"] for name in ("exact", "fast", "paper")
    )
    assert fast < paper < exact == 300 * 48 * 48
    pairs = [row["pairs"] for (line, _), row in errors["cut"].items() if line == "float32"]
    assert pairs == sorted(pairs, reverse=True) and pairs[-1] < 0.7 * pairs[0]
    of_8 = [row["pairs"] for (line, _), row in errors["stop"].items() if "8" in line]
    assert of_8[0] >= of_8[1] > of_8[2]


# --- one model, written otherwise ----------------------------------------------------------------
def test_fixed_steps_are_exactly_the_base_steps(short_model):
    Q_0 = np.array(short_model.design.Q_0)
    assert not np.all(quantise(short_model).context.q == Q_0)
    assert np.all(quantise(knobs.with_base_steps(short_model)).context.q == Q_0)
    four_times = knobs.steps(short_model)["one step for all", "4"]
    assert np.all(quantise(four_times).context.q == 4 * Q_0)


def test_without_context_the_symbols_stay_and_the_networks_go(short_model):
    with_context, alone = (decode(encode(m)) for m in knobs.context(short_model).values())
    assert all(map(np.array_equal, with_context.anchors, alone.anchors))
    rows = harness.measure_file(KNOBS["context"], short_model, SMALL)
    assert rows[0]["psnr_db"] == rows[1]["psnr_db"] and rows[0]["bytes"] > rows[1]["bytes"] + 3000
    q = quantise(knobs.without_context(short_model))
    measured = [q.symbols.mean(axis=0), 16 * np.log2(np.maximum(q.symbols.std(axis=0), 0.05))]
    predicted = q.context.mu_units[0] / 1024, q.context.sigma_units[0]
    for symbols, context, off in zip(measured, predicted, (0.05, 2)):
        assert np.allclose(symbols[:22], context[:22], atol=off), (symbols[:22], context[:22])
    made = {"bytes": 4900, "attribute_bytes": 1000, "anchors": 100}
    without = {"bytes": 1300, "attribute_bytes": 1200, "anchors": 100}
    assert report.pays_from([made, without]) == 1900  # 3,800 bytes at 2 an anchor


@pytest.mark.parametrize(
    "name, factor",
    [
        ("steps", 1.01),
        pytest.param("weight_bits", 2.5, marks=pytest.mark.slow),
        pytest.param("position_bits", 1.005, marks=pytest.mark.slow),
    ],
)
def test_coarser_files_need_fewer_bytes(short_model, name, factor):
    rows = harness.measure_file(KNOBS[name], short_model, SMALL)
    for line in diagram.lines_of(rows).values():
        sizes = [row["bytes"] for row in line]
        assert sizes == sorted(sizes, reverse=True) and sizes[0] > factor * sizes[-1], name


# --- trainings -----------------------------------------------------------------------------------
ONE = clock.Times(2.0, 1.0, 4.0, 1.5)


def test_trainings_are_done_once_and_timed_by_their_steps(monkeypatch):
    monkeypatch.setattr(harness, "alternate", lambda steps, _: dict.fromkeys(steps, ONE))
    small = [
        KNOBS["children_k"]._replace(values={"4": {}, "1": dict(k=1, anchors=20)}),
        KNOBS["image_size"]._replace(values={"64 px": {}, "16 px": dict(downscale=4)}),
    ]
    tasks, messages = [], []

    def train_one(task):
        tasks.append(task)
        return {"psnr_db": 20.0 + task[2], "bytes": 100, "anchors": 1}

    monkeypatch.setattr(harness, "train_one", train_one)
    rows, spread = harness.measure_trainings(small, 12, messages.append, 1)
    assert spread == harness.SEEDS - 1 and len(tasks) == 3 + harness.SEEDS
    assert rows["children k"][0] | {"value": ""} == rows["image size"][0] | {"value": ""}
    for row in (row for of_knob in rows.values() for row in of_knob):
        # 12 iterations; a step of stage 3 and one of stage 4 take 2 ms together.
        assert [row[f"seconds{end}"] for end in ("", "_low", "_high")] == [0.012, 0.006, 0.024]
        assert row["stretch"] == 1.5


ELSEWHERE = {"downscale", "settings"}  # changes that are no fields of a preset


def test_the_table_of_knobs_is_about_this_package():
    assert len(KNOBS) == len(knobs.KNOBS) and not set(KNOBS) & set(knobs.HARNESSES)
    bases = {}
    for knob in (knob for knob in knobs.KNOBS if knob.harness == "training"):
        for value, changes in knob.values.items():
            _, preset, _ = harness.prepared(changes, 38)
            assert (preset != harness.reduced(38)) == bool(changes.keys() - ELSEWHERE), value
        if knob.name != "iterations":
            (bases[knob.set_by],) = (value for value, changes in knob.values.items() if not changes)
    for field in ("k", "d", "L_x", "L_t", "anchors", "lambda_rate"):
        assert float(bases[f"`--set {field}`"]) == getattr(TINY, field)
    assert harness.prepared(knobs.steps_times(1), 38)[1] == harness.reduced(38)
    words = "--only colour: expected one of formula, kernels, file, training"
    with pytest.raises(ValueError, match=words):
        knobs.select(["renderer", "colour"])
    assert {knob.harness for knob in knobs.select(["file"])} == {"file"}


@pytest.mark.slow
def test_either_kernels_have_a_process_of_their_own():
    """Parameters differ where the processor's own kernels are others than those of AVX2."""
    before, knob = dict(os.environ), KNOBS["same_bytes_everywhere"]
    avx2, native = harness.measure_kernels(knob._replace(values=1))
    assert dict(os.environ) == before
    assert avx2["value"] == kernels() and avx2["error"] == 0
    assert (native["error"] > 0) == (native["value"] != avx2["value"])
    assert native["ms"] > 0 and avx2["ms"] > 0


# --- what the rows say ---------------------------------------------------------------------------
def rows_of(kind, *points):
    """Rows of (value, ms, error) or of (value, bytes, psnr_db)."""
    if kind == "bytes":
        return [dict(line="", value=v, bytes=size, psnr_db=psnr) for v, size, psnr in points]
    quartiles = [dict(ms=ms, ms_low=ms - 0.5, ms_high=ms + 0.5) for _, ms, _ in points]
    return [
        dict(line="", value=value, error=error, stretch=1.0, **times)
        for (value, _, error), times in zip(points, quartiles)
    ]


FINDINGS = [  # points; the report's value, its loss, its saving, the verdict
    ("ms", [("b", 3, 0.001), ("c", 1, 0.02)], ["b", "0.1 %", "9 → 3 ms", "always"]),
    ("ms", [("b", 3, 0.001), ("c", 4, 0)], ["b", "0.1 %", "9 → 3 ms", "always"]),
    ("ms", [("b", 3, 0.01)], ["b", "1 %", "9 → 3 ms", "for rough work"]),
    ("ms", [("b", 3, math.inf)], ["b", "inf %", "9 → 3 ms", "no"]),
    ("ms", [("b", 8.5, 0), ("c", 3, 0.01)], ["c", "1 %", "9 → 3 ms", "for rough work"]),
    ("ms", [("b", 8.5, 0)], ["b", "0 %", "9 → 8.5 ms", "cannot tell"]),
    ("ms", [("b", 12, 0)], ["b", "0 %", "9 → 12 ms", "saves nothing"]),
    ("bytes", [("b", 9000, 30)], ["b", "+0.00 dB", "9,000 → 9,000 bytes", "saves nothing"]),
    ("bytes", [("b", 4000, 30.01)], ["b", "+0.01 dB", "9,000 → 4,000 bytes", "always"]),
    ("bytes", [("b", 4000, 29.7)], ["b", "−0.30 dB", "9,000 → 4,000 bytes", "at low rates"]),
    ("bytes", [("b", 4000, 20)], ["b", "−10.00 dB", "9,000 → 4,000 bytes", "no"]),
]


@pytest.mark.parametrize("kind, points, wanted", FINDINGS)
def test_a_verdict_is_computed_from_the_numbers(kind, points, wanted):
    knob = {"ms": KNOBS["cut"], "bytes": KNOBS["weight_bits"]}[kind]
    reference = {"ms": ("a", 9, 0), "bytes": ("a", 9000, 30)}[kind]
    rows = rows_of(kind, reference, *points)
    row = report.finding(knob, rows)
    shown = [row[name] for name in ("cheaper", "lost", "saved", "verdict")]
    assert [text.removesuffix(" of the picture") for text in shown] == wanted
    if wanted[-1] == "at low rates":
        assert report.finding(knob, rows, spread=0.31) == row  # one model, no other seed
        trained = report.finding(KNOBS["features_d"], rows, spread=0.31)
        assert trained["verdict"] == report.HIDDEN
    assert row["verdict"] in report.ORDER and len(row["verdict"].split()) <= 5


# --- the page ------------------------------------------------------------------------------------
@pytest.fixture
def overlapping(monkeypatch):
    """The texts that overlap in any figure of a page, [(file, text, text)]."""
    pairs, save = [], diagram.save_figure

    def watched(figure, path):
        pairs.extend((path.name, *pair) for pair in drawn.overlaps(figure))
        save(figure, path)

    monkeypatch.setattr(diagram, "save_figure", watched)
    return pairs


def check_page(folder, result):
    """Every knob has a row, a section, its numbers and a figure."""
    page = (folder / report.PAGE).read_text(encoding="utf-8")
    assert json.dumps(result) and page.startswith("# What accuracy costs in time and bytes\n")
    table = page.split("\n\n")[1 + ("\nDisturbed" in page)]
    files = {report.PAGE, "knobs.csv"}
    assert len(table.splitlines()) == 2 + len(result["knobs"])
    verdicts = [row["verdict"] for row in result["knobs"] if row["knob"] != "context"]
    assert verdicts == sorted(verdicts, key=report.ORDER.index)
    for row in result["knobs"]:
        name = row["knob"].replace(" ", "_").replace("λ", "lambda")
        assert f"| {row['knob']} " in table and f"## {row['knob']}\n" in page
        assert f"![{row['knob']}]({name}.png)" in page
        files |= {f"{name}.csv", f"{name}.png"}
        assert len((folder / f"{name}.csv").read_text(encoding="utf-8").splitlines()) > 2
    assert {file.name for file in folder.iterdir()} == files
    assert report.to_text(result, folder).splitlines()[0] == table.splitlines()[0]
    return page


def test_chosen_knobs_make_a_page(tmp_path, overlapping, monkeypatch):
    monkeypatch.setattr(report, "stretch_of", lambda rows: 2.5)
    finding, no = report.finding, {"precision": {"verdict": "no"}}
    monkeypatch.setattr(report, "finding", lambda k, *rows: finding(k, *rows) | no.get(k.name, {}))
    result = report.run(["precision", "likelihood_table", "context"], tmp_path, True)
    page = check_page(tmp_path, result)
    assert page.splitlines()[2].startswith("Disturbed: ") and overlapping == []
    assert [row["knob"] for row in result["knobs"]] == ["likelihood table", "precision"]
    assert "it leaves out: context." in page and "dB" not in page.split("\n## ", 1)[1]


@pytest.mark.slow
def test_all_knobs_quickly(tmp_path, overlapping):
    result = report.run(None, tmp_path, True)
    shown = [row["knob"] for row in result["knobs"]]
    assert sorted(shown + result["left_out"]) == sorted(knob.name for knob in knobs.KNOBS)
    check_page(tmp_path, result)
    assert overlapping == []


@pytest.mark.slow
def test_a_full_page_tells_all_harnesses(tmp_path, overlapping, monkeypatch):
    monkeypatch.setattr(report, "ITERATIONS", 40)
    names = ["noise_draws", "weight_bits", "context", "hash_grid", "image_size"]
    result = report.run(names, tmp_path, jobs=2)
    page = check_page(tmp_path, result)
    assert "--quick" not in page and "anchors |" in page and "3 seeds" in page
    assert overlapping == []
