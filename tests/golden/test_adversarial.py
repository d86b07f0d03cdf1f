"""The search for trouble finds none, would find it, and numbers that are none do what the docstrings say."""

import inspect

import numpy as np
import pytest

from p4dgs_ref.equations import EQUATIONS
from tests.golden.sixty_digits import gradient, value
from tests.golden import search
from tests.golden.arenas import ARENAS
from tests.golden.promises import LEAST, PROMISES

DTYPES = {"float64": np.float64, "float32": np.float32}
COUNT, MANY = 100_000, 1_000_000
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])


def complaints(found):
    return [
        f"{f.equation} {f.dtype}: {f.non_finite} not finite, {f.beyond} beyond, worst {f.worst:.3g} in {f.where} at {f.at}"
        for f in found
        if f.non_finite or f.beyond
    ]


def test_every_equation_has_an_arena_and_a_promise():
    assert set(ARENAS) == set(PROMISES) == set(EQUATIONS)
    assert all(promise.domain and promise.reason for promise in PROMISES.values())


def test_the_search_finds_nothing():
    found = search.run(COUNT, seed=0)
    assert sum(f.inputs for f in found) >= COUNT and min(f.inputs for f in found) >= 100
    assert not complaints(found)


@pytest.mark.slow
def test_a_million_inputs_and_nothing_found():
    found = search.run(MANY, seed=1)
    assert sum(f.inputs for f in found) >= MANY
    assert not complaints(found)


# --- the search would find trouble -----------------------------------------------------------------------------------
def textbook_view(res, delta_vc_bar=None, d_vc_bar=None):
    across = d_vc_bar - res.d_vc * (res.d_vc * d_vc_bar).sum(axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        return {
            "x_a": res.d_vc * delta_vc_bar + np.where(res.delta_vc > 0, across / res.delta_vc, 0)
        }


def textbook_opacity(res, alpha_bar):
    from p4dgs_ref.equations import mlp, opacity

    return opacity.split_view(mlp.backward(res.mlp, alpha_bar * (1 - res.alpha**2)), res.d)


def squared_view(x_a, x_c):
    from p4dgs_ref.equations import view

    v = x_a - x_c
    delta_vc = np.sqrt((v * v).sum(axis=1, keepdims=True))
    d_vc = v / np.where(delta_vc > 0, delta_vc, 1)
    return view.Out(delta_vc, d_vc), view.Res(delta_vc, d_vc)


@BOTH
@pytest.mark.parametrize(
    "key, changes",
    [
        ("view", dict(backward=textbook_view)),
        ("view", dict(forward=squared_view)),
        ("opacity", dict(backward=textbook_opacity)),
        ("likelihood", dict(forward=EQUATIONS["likelihood"].rungs["literal"])),
        ("likelihood", dict(forward=EQUATIONS["likelihood"].rungs["hac"])),
    ],
)
def test_formulas_that_were_given_up_are_caught(key, changes, dtype, monkeypatch):
    """The printed ones; asked for their truth, the sound ones answer."""
    sound, broken = EQUATIONS[key], EQUATIONS[key]._replace(**changes)
    truth = search.truth
    monkeypatch.setitem(EQUATIONS, key, broken)

    def of_the_sound_one(*args):
        with monkeypatch.context() as inner:
            inner.setitem(EQUATIONS, key, sound)
            return truth(*args)

    monkeypatch.setattr(search, "truth", of_the_sound_one)
    found = search.search(key, dtype, 2000)
    assert found.beyond and found.worst > 1


def test_it_climbs():
    """Mutants of the worst inputs are worse than inputs drawn afresh, by what they find in as many tries."""
    climbed = np.mean(
        [search.search("projection", np.float64, 1500, seed).worst for seed in range(4)]
    )
    rng = np.random.default_rng(0)
    arena, drawn = ARENAS["projection"], []
    for _ in range(4):
        worst = 0.0
        for _ in range(12):
            inputs = search.cast(
                arena.decode(rng.random((128, arena.own)), rng.random(arena.shared), np.float64),
                np.float64,
            )
            bars = search.draw_cotangents(EQUATIONS["projection"], inputs, rng, np.float64)
            worst = max(
                worst, search.judge("projection", inputs, bars, np.float64, rng, 128)[0].max()
            )
        drawn.append(worst)
    assert climbed > np.mean(drawn)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "key",
    [key for key in ARENAS if key not in ("compositing", "ssim", "render_loss", "likelihood")],
)
def test_the_worst_found_stands_before_sixty_digits(key, dtype):
    """The longer float that the search asks shares our formulas; decimals do not."""
    found = search.search(key, DTYPES[dtype], 600, seed=2)
    eq, promise = EQUATIONS[key], PROMISES[key]
    bound = promise.double if dtype == "float64" else promise.single
    names = [name for name in found.at if name in inspect.signature(eq.forward).parameters]
    inputs, bars = (
        {n: found.at[n] for n in names},
        {n: a for n, a in found.at.items() if n not in names},
    )
    got = search.evaluate(eq, search.cast(inputs, DTYPES[dtype]), search.cast(bars, DTYPES[dtype]))
    want = search._named(
        value(key, inputs), gradient(key, inputs, bars) if eq.differentiable else {}
    )
    own = search.truth(key, inputs, bars, DTYPES[dtype])
    with np.errstate(all="ignore"):
        S = search.sizes(
            key,
            inputs,
            bars,
            DTYPES[dtype],
            bound,
            own,
            np.random.default_rng(0),
            ARENAS[key].fixed,
        )
    largest = max([abs(float(v)) for a in want.values() for v in a.ravel() if v == v], default=0)
    for name, size in S.items():
        true = np.array([float(v) for v in want[name].ravel()]).reshape(want[name].shape)
        off = np.abs(got[name] - true)[
            ~np.isnan(true)
        ]  # NaN: a kink, where decimals give no gradient
        own_digits = 1e-45 * largest  # difference quotients trust 50 of the largest term
        allowed = (
            bound * np.finfo(DTYPES[dtype]).eps * size.astype(float)
            + LEAST[DTYPES[dtype]]
            + own_digits
        )
        allowed = np.broadcast_to(allowed, true.shape)
        assert np.all(off <= allowed[~np.isnan(true)]), name


# --- infinities and NaN at the door ------------------------------------------------------------------------------------
RAISES = {"rounding": OverflowError, "hash_grid": ValueError, "likelihood": ValueError}
ROWWISE = [
    key
    for key, arena in ARENAS.items()
    if arena.rows and key not in ("masking", "hash_grid", "rounding")
]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", EQUATIONS)
def test_numbers_that_are_none_raise_only_as_documented(key, bad):
    eq, case = EQUATIONS[key], next(EQUATIONS[key].cases())
    for name, a in case.inputs.items():
        arrays = a if isinstance(a, list) else [a]
        if not (
            isinstance(arrays[0], (np.ndarray, np.generic))
            and np.asarray(arrays[0]).dtype.kind == "f"
        ):
            continue
        wrong = np.array(arrays[0])
        wrong.reshape(-1)[wrong.size // 2] = bad
        inputs = {**case.inputs, name: [wrong, *arrays[1:]] if isinstance(a, list) else wrong}
        try:
            with np.errstate(all="ignore"):
                out, res = eq.forward(**inputs)
                if eq.differentiable:
                    eq.backward(
                        res,
                        **search.draw_cotangents(eq, inputs, np.random.default_rng(1), np.float64),
                    )
        except (ValueError, OverflowError) as error:
            assert type(error) is RAISES[key] and "expected" in str(error)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", ROWWISE)
def test_a_number_that_is_none_stays_in_its_row(key, bad):
    eq, arena = EQUATIONS[key], ARENAS[key]
    rng, n = np.random.default_rng(3), 6
    inputs = search.cast(
        arena.decode(rng.random((n, arena.own)), rng.random(arena.shared), np.float64), np.float64
    )
    bars = search.draw_cotangents(eq, inputs, rng, np.float64)
    clean = search.evaluate(eq, inputs, bars)
    for name, a in inputs.items():
        if (
            name == "sigma"
            or name == "q"
            or not (isinstance(a, np.ndarray) and a.ndim and len(a) == n and a.dtype.kind == "f")
        ):
            continue
        wrong = a.copy()
        wrong[2].reshape(-1)[-1] = bad
        with np.errstate(all="ignore"):
            got = search.evaluate(eq, {**inputs, name: wrong}, bars)
        for output, values in got.items():
            if (
                values.ndim
                and len(values) == n
                and output.removesuffix("_bar") not in ("weights", "biases")
                and "." not in output
            ):
                others = np.arange(n) != 2
                assert np.array_equal(values[others], clean[output][others], equal_nan=True), (
                    f"{name} -> {output}"
                )


@pytest.mark.parametrize("name", ["sigma", "q"])
@pytest.mark.parametrize("value", [0.0, -0.0, -1.0])
def test_deviations_and_steps_must_be_positive(name, value):
    a = {n: np.ones((2, 3)) for n in ("f_noisy", "mu", "sigma", "q")}
    a[name][1, 2] = value
    with pytest.raises(ValueError, match=rf"{name}\[1, 2\] is {value}: expected a positive number"):
        EQUATIONS["likelihood"].forward(**a)


def test_a_nan_anchor_and_a_box_without_corners_are_named():
    case = next(EQUATIONS["hash_grid"].cases())
    x_a = case.inputs["x_a"].copy()
    x_a[4, 2] = np.nan
    with pytest.raises(ValueError, match=r"x_a\[4, 2\] is nan: expected a coordinate"):
        EQUATIONS["hash_grid"].forward(**{**case.inputs, "x_a": x_a})
    with pytest.raises(ValueError, match="expected finite corners"):
        EQUATIONS["hash_grid"].forward(**{**case.inputs, "hi": np.array([1, np.inf, 2])})
