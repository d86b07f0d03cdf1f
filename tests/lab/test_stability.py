"""The table of hard cases, the accuracy of Eq. (11), and the stability map."""

import json
import math

import numpy as np
import pytest

from p4dgs_ref.__main__ import main
from p4dgs_ref.equations import likelihood
from p4dgs_ref.lab import StudyError, stability
from p4dgs_ref.lab.accuracy import formulas
from p4dgs_ref.splatting.table import EQUATIONS
from tests.equations.rules import altered
from tests.workshop.hard_cases import catalogue


@pytest.fixture(scope="module")
def rows():
    return stability.rows()


# --- the table -----------------------------------------------------------------------------------
def test_every_case_of_an_equation_is_there_in_both_precisions(rows):
    assert len(catalogue.ENTRIES) == 85
    for dtype in ("float64", "float32"):
        assert [row["id"] for row in rows if row["dtype"] == dtype] == list(catalogue.ENTRIES)


def test_nothing_is_beyond_its_bound(rows):
    failed = [row for row in rows if row["verdict"] != "ok"]
    assert not [
        f"{row['id']} {row['dtype']}: {row['error']}, {row['grad_error']}" for row in failed
    ]


def test_rows_are_as_scripts_expect(rows):
    wanted = set("id equation dtype literal ours true error grad_error verdict".split())
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert all(wanted <= set(row) for row in rows)
    assert all(row["error"] >= 0 and row["bound"] <= 1e-3 for row in rows)
    text = stability.to_text(rows)
    assert text.splitlines()[0] == f"0 of {len(rows)} rows are beyond their error bounds"
    worst = stability.to_text(rows, every=False).splitlines()
    assert len(worst) == 5 + len({row["equation"] for row in rows})
    assert "H-R1.9sigma" in text


def test_only_selects_a_case_or_a_row():
    assert {row["id"] for row in stability.rows("H-P4.L10")} == {"H-P4.L10"}
    assert {row["id"] for row in stability.rows("H-P4")} == {"H-P4.L10", "H-P4.L16", "H-P4.L20"}
    with pytest.raises(StudyError, match="--only H-P: expected a case, or its beginning"):
        stability.rows("H-P")


def test_literal_formulas_fail_where_the_literature_says(rows):
    literal = {(row["id"], row["dtype"]): row["literal"] for row in rows}
    assert literal["H-R1.6sigma", "float32"] == "inf" == literal["H-R1.9sigma", "float64"]
    assert literal["H-R1.6sigma", "float64"] == pytest.approx(25.6533, abs=1e-4)
    assert literal["H-R2.40sigma", "float64"] == "nan"
    assert literal["H-R4.u-10", "float32"] == 0 == literal["H-R4.u-19", "float64"]
    assert literal["H-R6.positive", "float64"] == "nan"
    assert literal["H-G3.1e4px", "float32"] in ("inf", "-inf")
    assert literal["H-Q1.q1", "float64"] == 3
    assert literal["H-P1.inside", "float32"] == "nan"


def wrong_gradients(saved, bits_bar):
    right = likelihood.backward(saved, bits_bar)
    return {name: 1.001 * gradient for name, gradient in right.items()}


@pytest.mark.parametrize(
    "changes",
    [
        dict(forward=formulas.as_printed, backward=likelihood.backward),
        dict(forward=formulas.FORMULAS["HAC's floor"], backward=likelihood.backward),
        dict(forward=likelihood.forward, backward=wrong_gradients),
    ],
)
def test_a_formula_that_is_worse_fails(changes, monkeypatch):
    assert [row["verdict"] for row in stability.rows("H-R1.9sigma")] == ["ok", "ok"]
    worse = altered(EQUATIONS["likelihood"], **changes)
    monkeypatch.setitem(EQUATIONS, "likelihood", worse)
    with np.errstate(all="ignore"):
        rows = stability.rows("H-R1.9sigma")
    assert rows[0]["verdict"] == "fails"
    assert "  H-R1.9sigma float64" in stability.to_text(rows).splitlines()


@pytest.mark.parametrize(
    "got, want, each, error",
    [
        (np.array([1.0, 2.2]), [1.0, 2.0], True, 0.1),
        (np.array([1.2, 20.0]), [1.0, 20.0], False, 0.01),
        (np.array([0.5]), [0.0], True, 0.5),
        (np.array([2e-3]), [1e-3], True, 1.0),
        (np.array([2e-45]), [1e-45], True, 0),  # float32 cannot hold the difference
        (np.array([np.nan, 1]), [1.0, 1], True, math.inf),
        (np.array([7.0, 1]), [np.nan, 1], True, 0),
        ([np.ones(2), np.array([3.0])], [[1.0, 1], [2.0]], True, 0.5),
    ],
)
def test_errors_are_relative_to_the_right_number(got, want, each, error):
    assert stability.relative(got, want, each) == pytest.approx(error)


# --- Eq. (11) ------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "formula, comes_back",
    [
        (likelihood.forward, True),
        (formulas.FORMULAS["HAC's floor"], False),
        (formulas.as_printed, False),
    ],
)
def test_an_outlier_comes_back(formula, comes_back):
    """H-R2: a value 40 sigma away, moved by the gradient alone in a thousand small steps."""
    x, one = np.array([[40.0]]), np.ones((1, 1))
    for _ in range(1000):
        with np.errstate(all="ignore"):
            _, saved = formula(x, 0 * one, one, 0.5 * one)
            slope = likelihood.backward(saved, one)["f_noisy"]
        x = x - 0.01 * np.nan_to_num(slope, nan=0, posinf=0, neginf=0)
    assert bool(abs(x[0, 0]) < 1) is comes_back and bool(x[0, 0] == 40) is not comes_back


# --- the map -------------------------------------------------------------------------------------
def test_the_map_shows_both_sides_of_the_mean(monkeypatch):
    figures = []
    monkeypatch.setattr(stability, "save_figure", lambda figure, path: figures.append(figure))
    stability.draw_map(None)
    axes, *_ = figures[0].axes
    assert axes.get_ylim() == (-1000, 1000) and axes.get_title() == "as printed, float64"
    shown = axes.collections[0].get_array() > stability.LEVELS[1]  # red
    below, above = np.split(shown, 2)
    assert 0.2 < below.mean() < 0.25 and 0.33 < above.mean() < 0.35


# --- the command ---------------------------------------------------------------------------------
def test_the_command_fails_where_a_case_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stability, "draw_map", lambda path: path.write_bytes(b""))
    arguments = ["stability", "--json", "-o", str(tmp_path), "--only"]
    assert main([*arguments, "H-R1.9sigma"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["id"] for row in found["cases"]} == {"H-R1.9sigma"}
    assert main([*arguments, "H-R99"]) == 2
    assert "H-R99" in capsys.readouterr().err
    worse = altered(
        EQUATIONS["likelihood"],
        forward=formulas.FORMULAS["HAC's floor"],
        backward=likelihood.backward,
    )
    monkeypatch.setitem(EQUATIONS, "likelihood", worse)
    assert main([*arguments, "H-R1.9sigma"]) == 1
