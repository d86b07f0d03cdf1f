"""What accuracy costs in time: losses, the record, the picture; never the times of a machine."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.lab import accuracy
from p4dgs_ref.lab.accuracy import formulas, picture
from p4dgs_ref.lab.stability import plane
from tests import ROOT
from tests.tutorials import drawn

TABLE = json.loads(
    (Path(__file__).parents[1] / "workshop" / "data" / "gaussian_bin_constants.json").read_text(
        encoding="utf-8"
    )
)
Z, W, BITS, BITS_X, BITS_Q = (np.array(column) for column in zip(*TABLE["rows"]))


# --- Eq. (11) ------------------------------------------------------------------------------------
def test_the_truth_agrees_with_stored_constants_and_with_sixty_digits():
    log_p, slope_z, slope_w = formulas.truth(Z, W)
    assert np.all(np.abs(-log_p / math.log(2) - BITS) <= 1e-12 * np.maximum(BITS, 1e-6))
    largest = np.maximum(np.abs(BITS_X), np.abs(BITS_Q))
    for slope, wanted in ((slope_z, BITS_X), (slope_w, BITS_Q)):
        assert np.all(np.abs(-slope / math.log(2) - wanted) <= 1e-12 * largest + 1e-300)
    bits, slopes = formulas.check_truth()
    assert bits < 1e-15 and slopes < 2e-14


def test_errors_over_both_sides_of_the_plane_are_ordered():
    distances, widths = plane()
    assert np.array_equal(distances, -distances[::-1])
    distances = distances[distances > 0][::3]
    axes = np.append(-distances, distances), widths[::3]
    z, w = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    errors = {n: formulas.errors(f, z, w, "float64") for n, f in formulas.FORMULAS.items()}
    failed = {name: ~np.isfinite(bits) for name, (bits, _) in errors.items()}
    assert not failed["ours"].any() and not failed["HAC's floor"].any()
    assert errors["ours"][0].max() <= 1e-12 and errors["ours"][1].max() <= 1e-9
    above, below = z > 0, z < 0
    assert failed["as printed"][above].mean() > 1.3 * failed["as printed"][below].mean() > 0.2
    assert z[failed["as printed"]].min() < -37
    floored = -formulas.truth(z, w)[0] > -math.log(0.9e-6)
    assert floored.mean() > 0.4
    assert np.all(errors["HAC's floor"][1][floored] == 1)  # the gradient is 0


# --- the questions -------------------------------------------------------------------------------
# The loss of the reference, at most; of the other choices, from the second on.
LOSSES = {
    "renderer": (0, [(0, 1e-9), (0.04, 0.05), (5, 8)]),
    "precision": (0, [(1e-8, 1e-5)]),
    "Eq. (11)": (0, [(28.6, 28.8), (32, 33)]),
    "noise": (0.01, [(0.02, 0.03), (0.07, 0.08)]),
}


@pytest.mark.parametrize("name", LOSSES)
def test_a_cheaper_form_loses_as_much_as_we_say(name):
    """On the demo's file and its second test view, in which the fast renderer is off most."""
    model = p4.decode((ROOT / "tutorials" / "demo.p4dgs").read_bytes())
    with np.errstate(all="ignore"):
        choices = accuracy.QUESTIONS[name].measure(model, p4.load_scene("bouncing").test[1:2])
        losses = [loss(run()) for run, loss in choices.values()]
    most, ranges = LOSSES[name]
    assert losses[0] <= most
    assert all(low <= loss <= high for loss, (low, high) in zip(losses[1:], ranges, strict=True))
    assert {accuracy.QUESTIONS[name].ours, accuracy.QUESTIONS[name].answer} <= set(choices)


# --- what is said of rows ------------------------------------------------------------------------
def made_up(stretch=1.0):
    """Rows of all questions with numbers that nobody has measured."""
    rows = []
    for name, choices in {
        "renderer": {"loop": 0, "exact": 1e-12, "fast": 0.01, "3DGS's kernel": 1.7},
        "precision": {"float64": 0, "float32": 1e-6},
        "Eq. (11)": {
            **{"ours": 0, "as printed": 28.7, "p at least 1e-30": 28.0},
            accuracy.STEP: math.nan,
        },
        "noise": {"64 draws": 0.05, "8 draws": 0.1, "1 draw": 0.4},
    }.items():
        for i, (choice, loss) in enumerate(choices.items()):
            ms = 1000 / 7**i
            times = {"ms": ms, "ms_low": 0.9 * ms, "ms_high": 1.1 * ms, "stretch": stretch}
            rows.append({"question": name, "choice": choice, "loss": loss, **times})
    return rows


def test_a_row_is_compared_with_its_reference():
    loop, exact, *_ = rows = made_up()[:4]
    assert accuracy.comparison(exact, rows) == "7 times as fast as loop"
    assert accuracy.comparison(loop, [exact, loop]) == "7 times as slow as exact"
    near = {**exact, "ms": 1001, "ms_low": 990, "ms_high": 1010}
    assert accuracy.comparison(near, [loop, near]) == "not measurably faster or slower than loop"
    assert [accuracy.duration(ms) for ms in (0.1234, 999, 1e5)] == ["0.123 ms", "999 ms", "100 s"]
    assert accuracy.duration(1234, 1200, 1300) == "1.23 (1.2 to 1.3) s"
    text = accuracy.to_text(made_up(stretch=2.5))
    assert "off by 0.01 grey levels" in text and "Disturbed: the wall clock ran 2.5" in text
    # A training step of 1000 / 7**3 ms; the printed form spares 1000 - 1000 / 7.
    assert "7 times as fast as ours (by 2.9e+04 % of a training step)" in text
    assert len(text.split("\n\n")[0].splitlines()) == 1 + 13


def test_no_label_of_the_picture_covers_another(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(picture, "save_figure", lambda figure, path: figures.append(figure))
    rows = accuracy.read(ROOT / "tutorials" / "experiments" / "records" / "accuracy.csv")
    picture.draw(tmp_path / "picture.png", rows)
    (figure,) = figures
    labels = drawn.texts(figure)
    assert drawn.overlaps(labels) == []
    shown = " ".join(" ".join(text for text, _ in labels).split())
    assert "times as fast as loop, off by 0.047 grey levels" in shown
    assert all(row["choice"] in shown for row in rows)
    assert "grey levels" in shown and " ms" in shown
    axes = figure.axes[0]  # only the loop stands at 0
    ticks = dict(zip(axes.get_yticks(), (text.get_text() for text in axes.get_yticklabels())))
    assert ticks[0] == "0" and min(t for t in ticks if t) < 1e-11


# --- the command ---------------------------------------------------------------------------------
@pytest.fixture
def quick(monkeypatch):
    """Every form is called once."""

    def measure_in_turns(choices):
        times = {"ms": 1.0, "ms_low": 1.0, "ms_high": 1.0, "stretch": 1.0}
        with np.errstate(all="ignore"):
            return {c: {"loss": float(loss(run())), **times} for c, (run, loss) in choices.items()}

    monkeypatch.setattr(accuracy, "measure_in_turns", measure_in_turns)
    monkeypatch.setattr(picture, "draw", lambda path, rows: path.write_bytes(b""))


def test_the_command_writes_a_picture_and_its_numbers(tmp_path, quick, capsys):
    assert cli.run(["accuracy", "-o", str(tmp_path)], 0) == 0
    assert f"picture: {tmp_path}/accuracy.png" in capsys.readouterr().out
    rows = accuracy.read(tmp_path / "accuracy.csv")
    assert {row["question"] for row in rows} == set(accuracy.QUESTIONS)
    assert {file.name for file in tmp_path.iterdir()} == {"accuracy.csv", "accuracy.png"}


def test_studies_use_forward_and_backward_of_an_equation_alone():
    """So that another Eq. (11) in the place of ours does not end a command with an ImportError."""
    rooms = [ROOT / "p4dgs_ref" / room for room in ("report", "oracle", "lab", "cli")]
    for file in (file for room in rooms for file in room.rglob("*.py")):
        parts = re.findall(
            r"from \S*\.equations\.(?!numerics)\w+ import .*", file.read_text(encoding="utf-8")
        )
        assert not parts, f"{file.relative_to(ROOT)}: {parts}"
