"""The decimal equations against tables, identities and closed forms; NumPy against them."""

import json
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache

import numpy as np
import pytest

import tests.workshop.sixty_digits as sixty
from p4dgs_ref import EQUATIONS
from tests.sampling import few
from tests.workshop.cases import case_of, cases_of
from tests.workshop.sixty_digits import functions as f
from tests.workshop.sixty_digits.floats import exact
from tests.workshop.sixty_digits.gradients import FORMULAS
from tests.workshop.sixty_digits.record import FILE, SAMPLES, measure

RECORDED = json.loads(FILE.read_text(encoding="utf-8"))["errors"]
CASES = [(key, case.name) for key in EQUATIONS for case in cases_of(key)]

# From mpmath 1.4 with 70 digits; pi, e and log 2 as in OEIS A000796, A001113, A002162.
TABLE = [
    ("exp", "1", "2.71828182845904523536028747135266249775724709369995957496697"),
    ("log", "2", "0.693147180559945309417232121458176568075500134360255254120680"),
    ("sin", "1e22", "-0.852200849767188801772705893753029368261762150410043656256509"),
    ("tanh", "1", "0.761594155955764888119458282604793590412768597257936551596811"),
    ("erfc", "10", "2.08848758376254475700078629495778861156081811932116372701221E-45"),
]


def agree(got, want, digits=60):
    """Relative to `want`, in the working precision."""
    with f.working():
        assert abs(got - want) <= abs(want) * Decimal(10) ** (1 - digits), (
            f"{got:.70e} for {want:.70e}"
        )


# --- elementary functions ------------------------------------------------------------------------
@pytest.mark.parametrize("name, x, published", TABLE)
def test_published_constants(name, x, published):
    with f.working():
        agree(getattr(f, name)(Decimal(x)), Decimal(published), 59)
        agree(f.pi(), Decimal("3.14159265358979323846264338327950288419716939937510582097494"), 59)


# --- floats and decimals -------------------------------------------------------------------------
def test_conversion_is_exact_one_way_and_rounded_once_the_other():
    a = np.array([0.1, -1e300, 5e-324, np.inf]), np.array([0.1, 1e-45], np.float32)
    for b in a:
        assert (
            np.array_equal(sixty.to_float(exact(b), b.dtype), b)
            and sixty.to_float(exact(b), b.dtype).dtype == b.dtype
        )
    assert exact(0.1).as_integer_ratio() == Fraction(0.1).as_integer_ratio()
    tie = Decimal(1) + Decimal(2) ** -24  # half-way between two float32
    with f.working():
        above, below = tie + Decimal("1e-30"), tie - Decimal("1e-30")
        far = Decimal(2) ** 128 - Decimal(2) ** 103  # half-way beyond the largest float32
        values = [tie, above, below, -above, far, far - 1, Decimal("1e400"), Decimal("NaN")]
    ulp, top = 2.0**-23, np.finfo(np.float32).max
    assert np.float32(float(above)) == 1  # the result of rounding twice
    want = np.array([1, 1 + ulp, 1, -1 - ulp, np.inf, top, np.inf, np.nan], np.float32)
    assert np.array_equal(sixty.to_float(values, np.float32), want, equal_nan=True)


# --- another library ----------------------------------------------------------------------------
CONSTANTS = FILE.with_name("gaussian_bin_constants.json")
BINS = json.loads(CONSTANTS.read_text(encoding="utf-8"))["rows"]


@pytest.mark.parametrize("row", few([(row,) for row in BINS], 12, 60))
def test_bits_of_another_library(row):
    """The table of bins from mpmath: value and slopes, rounded once, are the same doubles."""
    z, w, *want = row
    one = np.ones((1, 1))
    inputs = dict(f_noisy=z * one, mu=0 * one, sigma=one, q=w * one)
    slopes = sixty.gradient("likelihood", inputs, {"bits_bar": one})
    got = sixty.value("likelihood", inputs)["bits"], slopes["f_noisy"], slopes["q"]
    got = [sixty.to_float(a)[0, 0] for a in got]
    normal = [[0.0 if abs(v) < 1e-308 else v for v in values] for values in (got, want)]
    assert normal[0] == normal[1]


# --- NumPy against the decimals ------------------------------------------------------------------
@lru_cache(None)
def measured(key, name, dtype, samples):
    return measure(key, case_of(key, name), np.dtype(dtype).type, samples)


# Allowed errors, in eps times the largest magnitude of the array, and why some cases need more.
ALLOWED = {
    "": (16, "a few roundings"),
    "projection/needle": (2**27, "the determinant cancels: length over width, squared, is 3e8"),
    "projection/one_behind": (64, "two large entries of the determinant cancel near the camera"),
    "ssim/flat": (2**12, "E[x^2] - mu^2 cancels: mu^2 / C2 is 900, in a denominator"),
    "likelihood/narrow": (64, "slopes: the Taylor series of a bin ends at 3e-15"),
    "likelihood/tail_of_narrow_bins": (64, "the same"),
    "likelihood/edge_of_a_wide_bin": (64, "slopes: tails by difference"),
}


# Visible in exact arithmetic, culled in floats: the determinant rounds to 0 or to infinity.
CULLED = ("projection/no_determinant", "projection/infinite_determinant")


def compare(key, name, dtype, samples):
    """A case is within the allowed error, and at most twice as wrong as recorded (or as 1 eps)."""
    errors, place = measured(key, name, dtype, samples), f"{key}/{name}"
    kept = RECORDED[key][dtype].get(name)
    assert (errors is None) == (kept is None), (
        f"{place}: run python -m tests.workshop.sixty_digits.record"
    )
    for side, e in (errors or {}).items():
        if kept[side] is None:
            assert e == np.inf and place in CULLED, f"{place}, {side}: record it again"
            continue
        assert e <= ALLOWED.get(place, ALLOWED[""])[0], f"{place}, {side}: off by {e:.3g} eps S"
        assert e <= 2 * max(kept[side], 1), (
            f"{place}, {side}: off by {e:.3g} eps S, recorded {kept[side]:.3g}"
        )


@pytest.mark.parametrize("key, name", [case for case in few(CASES, 10) if not case.marks])
def test_reference(key, name):
    """Four elements of each gradient; the slow test takes more, of every case."""
    compare(key, name, "float64", 4)


@pytest.mark.parametrize("key, name", few(CASES, 0, 40))
def test_reference_at_many_elements_and_in_float32(key, name):
    """The record has every element, which takes minutes for an image."""
    compare(key, name, "float64", SAMPLES)
    compare(key, name, "float32", SAMPLES)


def test_the_record_is_of_these_cases():
    assert set(RECORDED) == set(EQUATIONS) == set(FORMULAS) - {"render"}
    assert {(key, name) for key, by in RECORDED.items() for name in by["float64"]} == set(CASES)
    for key, eq in EQUATIONS.items():
        assert set(eq.gradients) == set(FORMULAS[key][1])
