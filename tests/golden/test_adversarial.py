"""The search finds no broken promise and would find one; NaN and infinity do as documented."""

import numpy as np
import pytest

from p4dgs_ref.lab.accuracy import formulas
from p4dgs_ref.table import EQUATIONS
from tests.golden import search
from tests.golden.arenas import ARENAS
from tests.golden.cases import cases_of
from tests.golden.checks import altered, edited
from tests.golden.promises import PROMISES
from tests.sampling import few

DTYPES = {"float64": np.float64, "float32": np.float32}
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])


def test_every_equation_has_an_arena_and_a_promise():
    assert set(ARENAS) == set(PROMISES) == set(EQUATIONS)
    assert all(promise.domain and promise.reason for promise in PROMISES.values())


@pytest.mark.parametrize("count", [6_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_search_finds_nothing(count):
    found = search.run(count, seed=int(count > 6_000))
    assert sum(f.inputs for f in found) >= count and min(f.inputs for f in found) >= count / 1000
    assert not [f"{search.describe(f)}, at {f.at}" for f in found if f.non_finite or f.beyond]


@pytest.mark.parametrize("beyond", [0, 1])
def test_the_command_counts_inputs_and_fails_on_trouble(capsys, monkeypatch, beyond):
    found, count = (
        search.Found("offsets", "float64", 128, 0, beyond, 2, "x", {}),
        2 * len(EQUATIONS),
    )
    monkeypatch.setattr(search, "search", lambda *args: found)
    assert search.main(["--count", "10", "--seed", "3"]) == beyond
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"{128 * count:,} inputs tried, {beyond * count} beyond what is promised"


# --- the search would find trouble ---------------------------------------------------------------
TEXTBOOK = [
    (
        "view",
        {
            "perpendicular(d_vc, d_vc_bar)": (
                "(d_vc_bar - d_vc * (d_vc * d_vc_bar).sum(axis=1, keepdims=True))"
            )
        },
    ),
    ("view", {"length(v)": "np.sqrt((v * v).sum(axis=1, keepdims=True))"}),
    ("opacity", {"tanh_slope(psi_alpha)": "(1 - np.tanh(psi_alpha) ** 2)"}),
]
LOSING = [(key, edited(key, changes)) for key, changes in TEXTBOOK] + [
    ("likelihood", altered(EQUATIONS["likelihood"], forward=forward))
    for forward in (formulas.literal, formulas.hac)
]


@BOTH
@pytest.mark.parametrize("key, losing", few(LOSING, 2))
def test_formulas_that_lose_digits_are_caught(key, losing, dtype, monkeypatch):
    """The printed formulas; their truth is asked from the sound ones."""
    sound, truth = EQUATIONS[key], search.truth
    monkeypatch.setitem(EQUATIONS, key, losing)

    def truth_of_the_sound_one(*args):
        with monkeypatch.context() as inner:
            inner.setitem(EQUATIONS, key, sound)
            return truth(*args)

    monkeypatch.setattr(search, "truth", truth_of_the_sound_one)
    found = search.search(key, dtype, 2000)
    assert found.beyond and found.worst > 1


# --- NaN and infinity ----------------------------------------------------------------------------
RAISES = {"rounding": OverflowError, "hash_grid": ValueError, "likelihood": ValueError}
ROWWISE = [
    key
    for key, arena in ARENAS.items()
    if arena.rows and key not in ("masking", "hash_grid", "rounding")
]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", EQUATIONS)
def test_nan_and_infinity_raise_only_as_documented(key, bad):
    eq, case = EQUATIONS[key], cases_of(key)[0]
    for name, a in case.inputs.items():
        first, *others = a if isinstance(a, list) else [a]
        is_array = isinstance(first, (np.ndarray, np.generic))
        if not is_array or np.asarray(first).dtype.kind != "f":
            continue
        wrong = np.array(first)
        wrong.reshape(-1)[wrong.size // 2] = bad
        inputs = {**case.inputs, name: [wrong, *others] if isinstance(a, list) else wrong}
        try:
            with np.errstate(all="ignore"):
                rng = np.random.default_rng(1)
                bars = search.draw_cotangents(eq, inputs, rng, np.float64)
                search.evaluate(eq, inputs, bars)
        except (ValueError, OverflowError) as error:
            assert type(error) is RAISES[key] and "expected" in str(error)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", ROWWISE)
def test_nan_and_infinity_stay_in_their_row(key, bad):
    eq, arena = EQUATIONS[key], ARENAS[key]
    rng, n = np.random.default_rng(3), 6
    genes = rng.random((n, arena.own)), rng.random(arena.shared)
    inputs = search.cast(arena.decode(*genes, np.float64), np.float64)
    bars = search.draw_cotangents(eq, inputs, rng, np.float64)
    clean = search.evaluate(eq, inputs, bars)
    others = np.arange(n) != 2

    def by_row(a):
        return isinstance(a, np.ndarray) and a.ndim and len(a) == n

    for name, a in inputs.items():
        if name in ("sigma", "q") or not by_row(a) or a.dtype.kind != "f":
            continue
        wrong = a.copy()
        wrong[2].reshape(-1)[-1] = bad
        with np.errstate(all="ignore"):
            got = search.evaluate(eq, {**inputs, name: wrong}, bars)
        for output, values in got.items():
            if by_row(values) and "." not in output:  # weights and biases sum over rows
                same = np.array_equal(values[others], clean[output][others], equal_nan=True)
                assert same, f"{name} -> {output}"


def test_a_nan_position_and_an_infinite_box_are_named():
    inputs = cases_of("hash_grid")[0].inputs
    x_a = inputs["x_a"].copy()
    x_a[4, 2] = np.nan
    with pytest.raises(ValueError, match=r"x_a\[4, 2\] is nan"):
        EQUATIONS["hash_grid"].forward(**{**inputs, "x_a": x_a})
    with pytest.raises(ValueError, match="finite corners"):
        EQUATIONS["hash_grid"].forward(**{**inputs, "hi": np.array([1, np.inf, 2])})
