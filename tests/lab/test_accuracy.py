"""The knobs of accuracy: their forms, the harnesses that measure them, the page and its figures.

The tests look at errors, bytes and counted pairs, never at times.
"""

import json
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
from p4dgs_ref.beyond import trainer
from p4dgs_ref.designs import PRESETS, choose, decode, encode

from p4dgs_ref.arithmetic import kernels
from p4dgs_ref.lab import clock
from p4dgs_ref.lab.accuracy import answers, diagram, formulas, harness, knobs, report, verdicts
from p4dgs_ref.lab.stability import plane
from p4dgs_ref.lab.writer import grouped
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.training.presets import TINY
from tests.golden.both import quantise
from tests.tutorials import drawn
from tutorials.tools import gallery, records
from tutorials.tools.shared import FOLDER

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


# The largest error of a line's first value, and the smallest of its last one, as in the rows.
ENDS = {
    ("renderer", "a frame"): (0, 1 / 510),
    ("renderer", "with gradients"): (0, 1 / 510),
    ("cut", "float32"): (1e-6, 1e-3),
    ("cut", "float64"): (1e-8, 1e-3),
    ("stop", "tiles of 8 pixels"): (1e-4, 1e-3),
    ("stop", "tiles of 16 pixels"): (1e-4, 1e-3),
    ("precision", "compositing"): (0, 1e-8),
    ("precision", "likelihood"): (0, 1e-8),
    ("precision", "opacity"): (0, 1e-8),
    ("likelihood", "the declared domain, float64"): (1e-13, math.inf),
    ("likelihood", "the declared domain, float32"): (1e-6, math.inf),
    ("likelihood", "up to 3 σ, bins of 0.01 to 10 σ, float64"): (1e-13, 1e-11),
    ("likelihood", "up to 3 σ, bins of 0.01 to 10 σ, float32"): (1e-6, 1e-3),
    ("likelihood_table", ""): (1e-13, 1e-3),
    ("noise_draws", ""): (2e-3, 2e-3),
    ("coder", "encode"): (1e-3, 1),
    ("coder", "decode"): (1e-3, 1),
}
UNORDERED = "up to 3 σ", "the declared domain, float32"


@pytest.fixture(scope="module")
def errors():
    return {name: judged(name) for name in dict.fromkeys(name for name, _ in ENDS)}


def test_cheaper_forms_err_more(errors):
    formula_knobs = [name for name, knob in KNOBS.items() if knob.harness == "formula"]
    assert set(errors) == set(formula_knobs)
    for (name, line), (most, least) in ENDS.items():
        column = KNOBS[name].losses[0].column
        along = [row[column] for (of, _), row in errors[name].items() if of == line]
        assert along[0] <= most and along[-1] >= least, (name, line, along)
        if not line.startswith(UNORDERED):
            rises = np.diff(np.minimum(along, 1e9)) >= 0
            assert rises.all(), (name, line, along)


def test_forms_of_the_renderer_count_their_pairs(errors):
    exact, fast, kernel = (
        errors["renderer"]["a frame", name]["pairs"] for name in ("exact", "fast", "kernel")
    )
    assert fast < kernel < exact == 300 * 48 * 48
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
    made = {"value": "a", "seed": 0, "bytes": 4900, "attribute_bytes": 1000, "anchors": 100}
    without = {"value": "b", "seed": 0, "bytes": 1300, "attribute_bytes": 1200, "anchors": 100}
    assert verdicts.pays_from([made, without]) == 1900  # 3,800 bytes at 2 an anchor


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
    for line in grouped(rows, "line").values():
        sizes = [row["bytes"] for row in line]
        assert sizes == sorted(sizes, reverse=True) and sizes[0] > factor * sizes[-1], name


# --- trainings -----------------------------------------------------------------------------------
ONE = clock.Times(2.0, 1.0, 4.0, 1.5)
FEW = [
    KNOBS["children_k"]._replace(values={"4": {}, "1": dict(k=1, anchors=20)}),
    KNOBS["image_size"]._replace(values={"64 px": {}, "16 px": dict(downscale=4)}),
]
CHEAP = KNOBS["position_bits"]._replace(values=knobs.context)


def test_trainings_are_done_once_kept_and_timed_by_their_steps(monkeypatch, tmp_path):
    monkeypatch.setattr(harness, "alternate", lambda steps, _: dict.fromkeys(steps, ONE))
    train_one, made = harness.train_one, []

    def stopped(training):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(training.path.name)
        train_one(training)

    def measured():
        return harness.measure_trainings(FEW, [CHEAP], tmp_path, 12, 2, lambda line: None, 1)

    monkeypatch.setattr(harness, "train_one", stopped)
    with pytest.raises(KeyboardInterrupt):
        measured()
    monkeypatch.setattr(harness, "train_one", lambda one: made.append(one.path) or train_one(one))
    rows = measured()
    assert len(made) == 6 and len({*map(str, made)}) == 6 == len([*tmp_path.iterdir()])
    assert rows == measured() and len(made) == 6
    full, small = rows["children k"][:2], rows["position bits"][::2]
    assert [row["seed"] for row in full] == [row["seed"] for row in small] == [0, 1]
    assert full == [row | {"value": "4"} for row in rows["image size"][:2]]
    assert full[0]["sha256"] != full[1]["sha256"] and full[0]["iterations"] == 12
    assert full[0]["arithmetic"] == small[0]["arithmetic"] and small[0]["bytes"] > 9000
    for row in (row for knob in FEW for row in rows[knob.name]):
        # 12 iterations; five steps of stage 3 and five of stage 4 take 2 ms together.
        times = [row[f"seconds{end}"] for end in ("", "_low", "_high")]
        assert times == pytest.approx([0.0024, 0.0012, 0.0048])
        assert row["stretch"] == 1.5
    (tmp_path / made[0]).write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match=f"{made[0]}: .* a training's rows"):
        measured()


def test_a_timed_step_leaves_out_what_a_stage_does_once(monkeypatch):
    found, find = [], trainer.Trainer.find_bodies
    monkeypatch.setattr(trainer.Trainer, "find_bodies", lambda t: found.append(t) or find(t))
    _, preset, _ = harness.prepared({"preset": "tiny_coded"}, 40)
    step = harness.step_at(SMALL, preset, 3)
    before = step().copy()
    assert len(found) == 1 and not np.array_equal(step(), before) and len(found) == 1


def test_a_training_at_full_length_is_that_of_its_preset():
    for name in ("tiny", "tiny_coded", "small_coded"):
        assert harness.prepared({"preset": name})[1] == PRESETS[name]
    assert harness.prepared({"k": 1})[1] == choose("tiny", {"k": 1})


ELSEWHERE = {"downscale", "settings"}  # changes that are no fields of a preset


def test_the_table_of_knobs_is_about_this_package():
    assert len(KNOBS) == len(knobs.KNOBS) and not set(KNOBS) & set(knobs.HARNESSES)
    bases = {}
    for knob in (knob for knob in knobs.KNOBS if knob.harness == "training"):
        for value, changes in knob.values.items():
            _, preset, _ = harness.prepared(changes, 38)
            assert (preset != harness.reduced(38)) == bool(changes.keys() - ELSEWHERE), value
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
    before = dict(os.environ)
    avx2, native = harness.measure_kernels(1)
    assert dict(os.environ) == before
    assert avx2["value"] == kernels() and avx2["error"] == 0
    assert (native["error"] > 0) == (native["value"] != avx2["value"])
    assert native["ms"] > 0 and avx2["ms"] > 0


# --- what the rows say ---------------------------------------------------------------------------
def rows_of(kind, *points):
    """Rows of (value, ms, error), or of (value, bytes, PSNR of each seed)."""
    if kind == "bytes":
        return [
            dict(value=value, seed=seed, bytes=size, psnr_db=psnr)
            for value, size, each in points
            for seed, psnr in enumerate(each)
        ]
    return [
        dict(value=v, seed=0, error=error, stretch=1.0, ms=ms, ms_low=ms - 0.5, ms_high=ms + 0.5)
        for v, ms, error in points
    ]


NEAR, FAR = (30, 31, 32), (29, 31.5, 31)
FINDINGS = [  # points; the report's value, its loss, its saving, the verdict
    ("ms", [("b", 3, 0.001), ("c", 1, 0.02)], ["b", "0.26", "9 → 3 ms", "always"]),
    ("ms", [("b", 3, 0.001), ("c", 4, 0)], ["b", "0.26", "9 → 3 ms", "always"]),
    ("ms", [("b", 3, 0.01)], ["b", "2.6", "9 → 3 ms", "for rough work"]),
    ("ms", [("b", 3, math.inf)], ["b", "unbounded", "9 → 3 ms", "no"]),
    ("ms", [("b", 8.5, math.inf)], ["b", "unbounded", "9 → 8.5 ms", "no"]),
    ("ms", [("b", 8.5, 0), ("c", 3, 0.01)], ["c", "2.6", "9 → 3 ms", "for rough work"]),
    ("ms", [("b", 8.5, 0)], ["b", "0", "9 → 8.5 ms", "cannot tell"]),
    ("ms", [("b", 12, 0)], ["b", "0", "9 → 12 ms", "saves nothing"]),
    ("bytes", [("b", 900, NEAR)], ["b", "+0.00 ± 0.00 dB", "900 → 900 bytes", "saves nothing"]),
    (
        "bytes",
        [("b", 400, (30.01, 31, 32.01))],
        ["b", "+0.01 ± 0.01 dB", "900 → 400 bytes", "always"],
    ),
    (
        "bytes",
        [("b", 400, (29.6, 30.7, 31.8))],
        ["b", "−0.30 ± 0.12 dB", "900 → 400 bytes", "at low rates"],
    ),
    ("bytes", [("b", 400, FAR)], ["b", "−0.50 ± 1.00 dB", "900 → 400 bytes", "cannot tell"]),
    ("bytes", [("b", 400, (20, 21, 22))], ["b", "−10.00 ± 0.00 dB", "900 → 400 bytes", "no"]),
    ("bytes", [("b", 400, (31,))], ["b", "+1.00 dB", "900 → 400 bytes", "cannot tell"]),
]


@pytest.mark.parametrize("kind, points, wanted", FINDINGS)
def test_a_verdict_is_computed_from_the_numbers(kind, points, wanted):
    knob = {"ms": KNOBS["cut"], "bytes": KNOBS["weight_bits"]}[kind]
    reference = {"ms": ("a", 9, 0), "bytes": ("a", 900, NEAR)}[kind]
    row = verdicts.finding(knob, knob.losses[0], rows_of(kind, reference, *points))
    shown = [row[name] for name in ("cheaper", "lost", "saved", "verdict")]
    assert [re.sub(r" \(?grey levels\)?$", "", text) for text in shown] == wanted
    assert row["verdict"] in verdicts.ORDER and len(row["verdict"].split()) <= 5


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
    """Every knob has a row, a section and a figure; the table follows from the record alone."""
    page = (folder / report.PAGE).read_text(encoding="utf-8")
    assert json.dumps(result) and page.startswith("# What accuracy costs in time and bytes\n")
    record = verdicts.read(folder / report.RECORD)
    table = "\n".join(report.markdown_table(verdicts.findings(knobs.KNOBS, record)))
    assert f"\n\n{table}\n\n" in page and report.to_text(result, folder).startswith(table)
    files = {report.PAGE, report.RECORD} | {report.PICTURE for _ in "x" if result["has_picture"]}
    assert (f"]({report.PICTURE})" in page.split("| knob")[0]) == result["has_picture"]
    order = [row["verdict"] for row in result["knobs"] if row["knob"] != "context"]
    assert order == sorted(order, key=verdicts.ORDER.index)
    for name in result["rows"]:
        file = f"{name.replace(' ', '_').replace('λ', 'lambda')}.png"
        assert f"| {name} " in table and f"## {name}\n" in page and f"![{name}]({file})" in page
        files.add(file)
    assert {file.name for file in folder.iterdir() if file.is_file()} == files
    for row in record:
        assert row["command"].startswith("p4dgs-ref accuracy --only ") and row["arithmetic"]
    return page


def test_chosen_knobs_make_a_page(tmp_path, overlapping, monkeypatch):
    monkeypatch.setattr(verdicts, "stretch_of", lambda rows: 2.5)
    result = report.run(["precision", "likelihood_table", "context"], tmp_path, tmp_path, True)
    page = check_page(tmp_path, result)
    assert page.splitlines()[2].startswith("Disturbed: ") and overlapping == []
    shown = sorted(row["lost"].split()[-1] for row in result["knobs"])
    assert shown == ["bits", "gradient", "slopes"] and not result["has_picture"]
    assert "it leaves out: context." in page and "dB" not in page.split("\n## ", 1)[1]


def test_the_reference_has_the_table_of_the_record():
    text = (FOLDER / "reference.md").read_text(encoding="utf-8")
    assert text.count("<!-- accuracy -->\n| knob ") == 1 and gallery.with_table(text) == text


def test_the_record_is_of_full_length_and_of_the_files_that_other_records_have():
    rows = [row for row in verdicts.read(gallery.ACCURACY) if "sha256" in row]
    tiny = [row for row in records.rows("beyond_networks") if row["label"] == "p4dgs"]
    shas = [row["sha256"] for row in tiny if row["scene"] == SMALL.name]
    files = [row for row in rows if row["knob"] == "weight bits" and row["value"] == "16"]
    assert [row["sha256"] for row in files] == shas and len(shas) == harness.SEEDS
    assert {row["iterations"] for row in rows if row["knob"] != "iterations"} <= {3800, 6500}


# What a record says of two trainings with three seeds; numbers that nobody has measured.
MADE_UP = [
    dict(knob=knob, value=value, seed=seed, psnr_db=psnr + 0.1 * seed, iterations=n, stretch=1.0)
    | {f"seconds{end}": n / 100 for end in ("", "_low", "_high")}
    for knob, value, psnr, n in (
        ("iterations", "3,800", 33.0, 3800),
        ("iterations", "1,900", 32.0, 1900),
        ("preset", "small_coded", 36.0, 6500),
    )
    for seed in range(3)
]


@pytest.mark.parametrize("added", [[], MADE_UP])
def test_the_picture_follows_from_the_record(tmp_path, monkeypatch, added):
    figures, save = [], answers.save_figure
    monkeypatch.setattr(
        answers, "save_figure", lambda figure, path: figures.append(figure) or save(figure, path)
    )
    monkeypatch.setattr(verdicts, "stretch_of", lambda rows: 1.5)
    rows = verdicts.read(gallery.ACCURACY)
    rows = [row for row in rows if row["knob"] not in ("iterations", "preset")]
    assert answers.draw_answers(tmp_path / "picture.png", [*rows, *added])
    (figure,) = figures
    shown = [text for text, _ in drawn.texts(figure)]
    assert drawn.overlaps(figure) == [] and drawn.smallest(figure) > 12
    assert figure.get_size_inches()[0] * figure.dpi == 900
    ours = ["fast", "stable, float32", "stable, float64", "1 draw", "encode", "decode"]
    ours = [*(f"ours: {name}" for name in ours), *["tiny: 3,800"] * bool(added)]
    assert {*ours} < {*shown} and not figure.legends
    said = {" ".join(text.split()) for text in shown}
    answer = "Half of the iterations: −1.00 ± 0.00 dB, 19 s instead of 38"
    missing = "not measured in this run: iterations, preset"
    assert ({answer, missing} & said) == {answer if added else missing}
    assert "Disturbed: the wall clock ran 1.5 times" in " ".join(said)
    assert not answers.draw_answers(tmp_path / "none.png", [])
    assert [file.name for file in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.slow
def test_all_knobs_quickly(tmp_path, overlapping):
    result = report.run(None, tmp_path, tmp_path, True)
    shown = [*result["rows"], *result["left_out"]]
    assert sorted(shown) == sorted(knob.name for knob in knobs.KNOBS)
    check_page(tmp_path, result)
    assert overlapping == []
    again = tmp_path / "again.png"
    answers.draw_answers(again, verdicts.read(tmp_path / report.RECORD))
    assert again.read_bytes() == (tmp_path / report.PICTURE).read_bytes()


@pytest.mark.slow
def test_a_full_page_tells_all_harnesses(tmp_path, overlapping):
    names = ["noise_draws", "weight_bits", "context", "hash_grid", "image_size"]
    result = report.run(names, tmp_path, tmp_path, jobs=2, iterations=40)
    page = check_page(tmp_path, result)
    assert "--quick" not in page and "anchors |" in page and "3 seeds and up to 40" in page
    assert overlapping == []
