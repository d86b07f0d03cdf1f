"""The catalogue of hard cases: complete, within its bounds, against digits that others confirm; and the stability map."""

import csv
import json
import math
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.equations import EQUATIONS, gaussian_bin, likelihood, view
from p4dgs_ref.studies.accuracy.timing import special_calls
from p4dgs_ref.studies import quadrature
from p4dgs_ref.studies.hard_cases import catalogue, entry, table
from p4dgs_ref.studies.hard_cases import map as stability_map
from tests.core import test_equations as generic

CASES = [
    pytest.param(EQUATIONS[e.equation], e.case, id=e.id)
    for e in catalogue.ENTRIES.values()
    if e.case is not None
]
EVERY = pytest.mark.parametrize("eq, case", CASES)
TABLE = json.loads(
    (Path(__file__).parents[1] / "golden" / "data" / "gaussian_bin_constants.json").read_text()
)


@pytest.fixture(scope="module")
def rows():
    return table.rows()


# --- the table -----------------------------------------------------------------------------------------------------------
def test_every_row_of_the_catalogue_is_there_in_both_precisions(rows):
    assert (
        len(catalogue.ROWS) == 43
        and len(rows) >= 86
        and len({(r["id"], r["dtype"]) for r in rows}) == len(rows)
    )
    for dtype in ("float64", "float32"):
        assert set(catalogue.ROWS) <= {
            row["id"].split(".")[0] for row in rows if row["dtype"] == dtype
        }


def test_nothing_is_beyond_its_bound(rows):
    assert not [
        f"{r['id']} {r['dtype']}: {r['error']}, gradient {r['grad_error']}"
        for r in rows
        if r["verdict"] != "ok"
    ]


def test_rows_are_what_scripts_expect(rows):
    wanted = {
        "id",
        "equation",
        "dtype",
        "literal",
        "ours",
        "true",
        "error",
        "grad_error",
        "verdict",
    }
    again = json.loads(json.dumps(rows, allow_nan=False))
    assert again == rows and all(wanted <= set(row) for row in rows)
    assert all(row["error"] >= 0 and row["bound"] <= 1e-3 for row in rows)
    text = table.describe(rows)
    assert (
        text.splitlines()[-1] == f"{len(rows)} rows, 0 beyond their bounds"
        and "H-R1.9sigma" in text
    )


def test_literal_formulas_fail_where_the_literature_says(rows):
    shown = {(row["id"], row["dtype"]): row["literal"] for row in rows}
    assert shown["H-R1.6sigma", "float32"] == "inf" == shown["H-R1.9sigma", "float64"]
    assert shown["H-R1.6sigma", "float64"] == pytest.approx(25.6533, abs=1e-4)
    assert (
        shown["H-R2.40sigma", "float64"] == "nan"
        and shown["H-R4.u-10", "float32"] == 0 == shown["H-R4.u-19", "float64"]
    )
    assert shown["H-R6.positive", "float64"] == "nan" and shown["H-G3.1e4px", "float32"] in (
        "inf",
        "-inf",
    )
    assert (
        shown["H-Q1.q1", "float64"] == 3
        and shown["H-E9.int16", "float64"] == -32768
        and shown["H-P1.inside", "float32"] == "nan"
    )
    assert abs(shown["H-R7.sum", "float32"] / 2.0037919e8 - 1) > 0.01


@pytest.mark.parametrize(
    "name, wrong",
    [
        ("forward", likelihood.literal),
        ("forward", likelihood.hac),
        (
            "backward",
            lambda res, bits_bar: {
                n: 1.001 * g for n, g in likelihood.backward(res, bits_bar).items()
            },
        ),
    ],
)
def test_a_formula_that_is_worse_fails(name, wrong, monkeypatch):
    broken = EQUATIONS["likelihood"]._replace(**{name: wrong})
    one = entry.hard(
        "H-R1.9sigma",
        "likelihood",
        "",
        catalogue.ENTRIES["H-R1.9sigma"].case.inputs,
        ("bits", (0, 0)),
        lambda v: 0.0,
        ("tail",),
        value=(1e-12, 2e-6),
        grad=(1e-12, 2e-6),
    )
    assert table._judged(one.measure("float64"))["verdict"] == "ok"
    monkeypatch.setitem(EQUATIONS, "likelihood", broken)
    monkeypatch.setattr(
        entry, "_cotangents", lambda eq, case: catalogue.ENTRIES["H-R1.9sigma"].case.cotangents
    )
    two = entry.hard(
        "H-R1.9sigma",
        "likelihood",
        "",
        one.case.inputs,
        ("bits", (0, 0)),
        lambda v: 0.0,
        ("tail",),
        value=(1e-12, 2e-6),
        grad=(1e-12, 2e-6),
    )
    judged = table._judged(two.measure("float64"))
    assert judged["verdict"] == "fails" and "H-R1.9sigma float64" in table.describe(
        [{"id": "H-R1.9sigma", "equation": "", "dtype": "float64", **judged}]
    )


def test_errors_are_counted_as_they_should_be():
    assert entry.relative(np.array([1.0, 2.2]), [1.0, 2.0], True) == pytest.approx(0.1)
    assert entry.relative(np.array([1.2, 20.0]), [1.0, 20.0], False) == pytest.approx(0.01)
    assert (
        entry.relative(np.array([0.5]), [0.0], True) == 0.5
        and entry.relative(np.zeros((2, 1)), [[0.0]], True) == np.inf
    )
    assert (
        entry.relative(np.array([np.nan, 1]), [1.0, 1], True) == np.inf
        and entry.relative(np.array([7.0, 1]), [np.nan, 1], True) == 0
    )
    assert entry.relative([np.ones(2), np.array([3.0])], [[1.0, 1], [2.0]], True) == 0.5


# --- the constants -------------------------------------------------------------------------------------------------------
def numbers(value):
    return [n for v in value for n in numbers(v)] if isinstance(value, list) else [value]


def test_constants_have_fifty_digits_and_cover_every_case():
    stored = json.loads(entry.CONSTANTS.read_text())
    assert stored["digits"] == 50 and "sixty_digits" in stored["provenance"]
    assert set(stored["cases"]) == {
        f"{e.equation}/{e.id}" for e in catalogue.ENTRIES.values() if e.case is not None
    }
    long = 0
    for key, arrays in stored["cases"].items():
        for number in (n for values in arrays.values() for n in numbers(values) if n is not None):
            mantissa = number.lower().split("e")[0].lstrip("-").replace(".", "").lstrip("0")
            long += len(mantissa) >= 50
            assert len(mantissa) >= 50 or Fraction(number).denominator < 2**200, (
                key,
                number,
            )  # short ones are exact
    assert long > 500


@pytest.mark.slow
def test_constants_are_made_again_the_same():
    from p4dgs_ref.studies.hard_cases.make_constants import make

    assert make()["cases"] == json.loads(entry.CONSTANTS.read_text())["cases"]


def test_constants_against_other_sources():
    """The bits that mpmath gave, and a distance by Pythagoras in whole numbers."""
    known = {(z, w): bits for z, w, bits, *_ in TABLE["rows"]}
    found = 0
    for key, arrays in entry.constants().items():
        if key.startswith("likelihood/H-R"):
            case = catalogue.ENTRIES[key.split("/")[1]].case.inputs
            for z, w, sigma, bits in zip(
                *(case[n].ravel() for n in ("f_noisy", "q", "sigma")), np.ravel(arrays["bits"])
            ):
                if (abs(z / sigma), w / sigma) in known:
                    found += 1
                    assert bits == pytest.approx(known[abs(z / sigma), w / sigma], rel=1e-15)
    assert found >= 8
    case = catalogue.ENTRIES["H-P1.beside"].case.inputs["x_a"][0]
    true = math.sqrt(sum(Fraction(x) ** 2 for x in case) * 10**60) / 1e30
    assert entry.constants()["view/H-P1.beside"]["delta_vc"][0][0] == pytest.approx(true, rel=1e-15)


@EVERY
def test_hard_cases_are_cases(eq, case):
    """What the tests of equations ask of their own cases: shapes, purity, a linear and finite backward."""
    assert (
        case.flags
        and set(case.flags) <= set(generic.FLAGS)
        and case.name not in {own.name for own in eq.cases()}
    )
    assert case in list(catalogue.cases(eq.key))
    generic.test_declared_shapes_hold.__wrapped__(eq, case) if hasattr(
        generic.test_declared_shapes_hold, "__wrapped__"
    ) else generic.test_declared_shapes_hold(eq, case)
    generic.test_pure_and_repeatable(eq, case)
    generic.test_backward_is_linear_and_finite(eq, case)
    for a in case.inputs.values():
        for b in a if isinstance(a, list) else [a]:
            if isinstance(b, np.ndarray) and b.dtype.kind == "f":
                assert np.array_equal(
                    b, b.astype(np.float32).astype(float)
                )  # both precisions hold it


# --- Eq. (11): the figures -------------------------------------------------------------------------------------------------
def draw(n, seed):
    rng = np.random.default_rng(seed)
    z, w = 10.0 ** rng.uniform(-4, 3, n) * rng.choice([-1, 1], n), 10.0 ** rng.uniform(-12, 6, n)
    sigma = 10.0 ** rng.uniform(-6, 2.6, n)
    return [a[None] for a in (sigma * z, 0 * z, sigma, sigma * w)]


@pytest.mark.parametrize("dtype, relative", [(np.float64, 1e-12), (np.float32, 2e-6)])
def test_likelihood_keeps_its_figures_over_the_plane(dtype, relative):
    inputs = dict(zip(("f_noisy", "mu", "sigma", "q"), (a.astype(dtype) for a in draw(4000, 5))))
    out, res = likelihood.forward(**inputs)
    bar = np.ones_like(out.bits)
    true, slopes = quadrature.likelihood(inputs, {"bits_bar": bar})
    bits = true["bits"].astype(float)
    terms = [
        np.abs(np.asarray(inputs[n], float) * slopes[n].astype(float))
        for n in ("f_noisy", "sigma", "q")
    ]
    condition = 4 * np.finfo(float).eps * sum(terms)
    assert ((bits > 1e-6).mean() > 0.5) and np.all(
        np.abs(out.bits - bits)[bits > 1e-6] <= np.maximum(relative * bits, condition)[bits > 1e-6]
    )
    grad_relative = 1e-9 if dtype == np.float64 else 2e-6
    for name, got in likelihood.backward(res, bar).items():
        size = np.abs(np.asarray(inputs[name], float)) if name == "sigma" else 1
        largest = (
            2 * np.abs(slopes["q"].astype(float))
            if name != "sigma"
            else (terms[0] + terms[2] + terms[1]) / size
        )
        assert np.all(
            np.abs(got - slopes[name].astype(float)) <= grad_relative * largest + 1e-37
        ), name


def test_the_twin_agrees_with_mpmath():
    z, w, bits, bits_x, bits_q = (np.array(column)[None] for column in zip(*TABLE["rows"]))
    got, slopes = quadrature.likelihood(
        dict(f_noisy=z, mu=0 * z, sigma=0 * z + 1, q=w), {"bits_bar": 0 * z + 1}
    )
    assert np.all(np.abs(got["bits"] - bits) <= 2e-15 * bits + 1e-300)
    assert np.all(np.abs(slopes["q"] - bits_q) <= 1e-14 * np.abs(bits_q) + 1e-300)
    assert np.all(np.abs(slopes["f_noisy"] - bits_x) <= 1e-14 * np.abs(bits_q) + 1e-300)


@pytest.mark.parametrize(
    "policy, comes_back",
    [(likelihood.forward, True), (likelihood.hac, False), (likelihood.literal, False)],
)
def test_an_outlier_and_its_way_back(policy, comes_back):
    """H-R2: forty sigma away, pulled by the gradient alone, a thousand small steps."""
    x, one = np.array([[40.0]]), np.ones((1, 1))
    for _ in range(1000):
        with np.errstate(all="ignore"):
            slope = likelihood.backward(policy(x, 0 * one, one, 0.5 * one)[1], one)["f_noisy"]
        x = x - 0.01 * np.nan_to_num(slope, nan=0, posinf=0, neginf=0)
    assert bool(abs(x[0, 0]) < 1) is comes_back and bool(x[0, 0] == 40) is not comes_back


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_stable_does_at_most_three_times_the_work_of_the_literal_formula(dtype):
    """Special function values are counted; time, alternating in one run, is the machine's: printed, not asserted."""
    inputs = [np.tile(a.astype(dtype), (100, 1)) for a in draw(600, 6)]
    ratios = []
    for _ in range(5):
        spent = {likelihood.forward: [], likelihood.literal: []}
        for _ in range(9):
            for formula, times in spent.items():
                start = time.perf_counter()
                likelihood.backward(formula(*inputs)[1], inputs[0])
                times.append(time.perf_counter() - start)
        ratios.append(np.median(spent[likelihood.forward]) / np.median(spent[likelihood.literal]))
    print(
        f"\n{np.dtype(dtype).name}: {min(ratios):.2f} to {max(ratios):.2f} times the literal formula's time"
    )
    ours, printed = (
        special_calls(gaussian_bin, lambda: formula(*inputs))
        for formula in (gaussian_bin.stable, gaussian_bin.literal)
    )
    assert 0 < printed < ours <= 3 * printed


# --- the map ---------------------------------------------------------------------------------------------------------------
def test_the_map_is_green_where_ours_and_red_where_literal(tmp_path):
    from imageio.v3 import imread

    stability_map.draw_map(tmp_path / "map.png")
    image = imread(tmp_path / "map.png")[:, :, :3].astype(int)
    assert image.shape[1] > 1000
    red = (image[:, :, 0] > 250) & (image[:, :, 1:].max(axis=2) < 5)
    left, right = np.array_split(red, [image.shape[1] * 3 // 10], axis=1)
    assert left.mean() > 0.2 > right[:, : -image.shape[1] // 8].mean()
    with open(tmp_path / "map.csv", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    for dtype, worst in (("float64", -12), ("float32", math.log10(2e-6))):
        of = lambda name: np.array(
            [
                float(r["log10_relative_error"])
                for r in found
                if (r["formula"], r["dtype"]) == (name, dtype)
            ]
        )
        assert (
            np.nanmax(of("ours")) <= worst
            and np.isinf(of("literal")).mean() > 0.2
            and np.nanmax(of("floor 1e-6")) > -2
        )
        assert np.isnan(of("ours")).mean() < 0.5


# --- what the search found, in figures a reader can follow ------------------------------------------------------------------
def test_a_direction_nearly_along_an_axis():
    """x = (1, h, 0): the gradient along x is h (h v_x - v_y) to first order in h, which 1 - d_x^2 cannot tell from 0."""
    h, bar = 2.0**-20, np.array([[3.0, -2, 5]])
    for dtype in (np.float64, np.float32):
        _, res = view.forward(np.array([[1, h, 0]], dtype), np.zeros(3, dtype))
        got = view.backward(res, d_vc_bar=bar.astype(dtype))["x_a"][0, 0]
        assert got == pytest.approx(h * (h * 3 + 2), rel=1e-5)
