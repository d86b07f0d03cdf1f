"""Vectors of level L3 for a port of the encoder, step by step.

quantiser     a model -> positions, signs, steps, means, deviations and symbols, all integers
frequencies   symbols, means, deviations -> the interval of every symbol, and its raw bits
rans          intervals -> the bytes of a message
encoder       a model -> the bytes of every section, and of the file
"""

from dataclasses import fields, replace
from functools import cache

import numpy as np

from p4dgs_ref.codec import rans
from p4dgs_ref.codec.container import write_container
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS, attribute_columns, sections_of
from p4dgs_ref.codec.gaussian_table import SIGMA_MAX, SIGMA_MIN, gaussian_model
from p4dgs_ref.codec.header import write_header
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.codec.streams import find_entries
from p4dgs_ref.model import Anchors, Design, Model
from tests.workshop.cases import Case
from tests.workshop.decoded import arrays_of
from tests.workshop.flat import NETWORKS, flat_networks, networks_of, shapes_of
from tests.workshop.sample_model import sample_model
from tests.workshop.subjects import Subject, no_pullback

PRECISION = 24
ARRAYS = Anchors._fields
STILL = ("view_color", "occlusion", "background")
# The vectors also say that psi_d has no time net and no skip, as D3DGS has them.
NOT_OURS = {"time_net": (), "skip": False}
DESIGN = [*(field.name for field in fields(Design)), *NOT_OURS]


def model_of(x_a, f_a, s_a, l_a, O_a, mask, lo, hi, grids, background, networks, **design):
    """The Model that flat inputs describe."""
    anchors = Anchors(x_a, f_a, s_a, l_a, O_a, mask)
    design = {name: value for name, value in design.items() if name not in NOT_OURS}
    return Model(Design(**design), anchors, networks_of(networks), grids, (lo, hi), background)


def flat_model(model):
    """Undo `model_of`."""
    lo, hi = model.box
    return dict(
        **model.anchors._asdict(),
        lo=lo,
        hi=hi,
        grids=model.grids,
        background=model.background,
        **flat_networks(model.networks),
        **vars(model.design),
        **NOT_OURS,
    )


def apart(inputs):
    """The flat inputs of `model_of`, with the arrays of the networks in one dictionary."""
    others = {name: a for name, a in inputs.items() if not name.startswith("psi_")}
    return others, {name: a for name, a in inputs.items() if name.startswith("psi_")}


def quantiser_vjp(**inputs):
    """A model -> its integers, Eqs. (8) to (10) and (12) as the codec computes them.

    Anchors without a kept child are left out: B of A anchors remain.
    """
    others, networks = apart(inputs)
    quantised = quantise(model_of(**others, networks=networks))
    arrays = {name: a for name, (_, a) in arrays_of(quantised).items()}
    names = ("positions", "signs", "h", "q_units", "mu_units", "sigma_units", "symbols")
    outputs = {name: np.asarray(arrays[name]).astype(np.int32) for name in names}
    return {**outputs, "kept": quantised.kept}, no_pullback


def frequencies_vjp(symbols, mu_units, sigma_units):
    """Symbols -> what is coded of them: an interval of 2^24, low bits, and v of the escapes."""
    model = gaussian_model(mu_units, sigma_units)
    entries, gamma = find_entries(symbols, model)
    low = model.low[model.table]
    escape = entries - model.first[model.table] == model.blocks[model.table]
    v = np.zeros(len(symbols), np.int64)
    v[escape] = gamma
    return {
        "start": (model.keys[entries] % 2**PRECISION).astype(np.int32),
        "freq": np.diff(model.keys)[entries].astype(np.int32),
        "low": low.astype(np.int32),
        "low_bits": (symbols & (1 << low) - 1).astype(np.int32),
        "escape": escape,
        "v": v,
    }, no_pullback


def rans_vjp(start, freq, lanes):
    """Intervals -> the bytes of a message, in so many lanes."""
    # A table for each symbol, in which it is entry 1: whatever stands before it is entry 0.
    edges = np.stack([0 * start, start, start + freq], axis=1).astype(np.int64)
    keys = edges + (np.arange(len(start))[:, None] << PRECISION)
    keys = np.append(keys.ravel(), len(start) << PRECISION)
    entries = 3 * np.arange(len(start)) + 1
    return {"message": np.frombuffer(rans.encode(entries, keys, lanes), np.uint8)}, no_pullback


def encoder_vjp(header, **inputs):
    """A model and the text of its header -> the bytes of all other sections and of the file."""
    others, networks = apart(inputs)
    sections = sections_of(quantise(model_of(**others, networks=networks)))
    sections["header"] = header.encode()
    bodies = {name: a for name, a in sections.items() if name != "header"}
    outputs = {**bodies, "file": write_container(sections)}
    return {name: np.frombuffer(a, np.uint8) for name, a in outputs.items()}, no_pullback


# --- cases --------------------------------------------------------------------------------------
@cache
def models():
    """Return {name: (Model, flags)}: one that moves, and one that rests and loses anchors."""
    moving = sample_model(471, 9, d=5, k=2, hidden=(5,), F=2)
    moving.anchors.mask[4] = False
    still = sample_model(472, 7, d=3, k=2, effects=STILL, grid=(("xyz", 4), ("xz", 3)))
    mask = np.random.default_rng(473).random(still.anchors.mask.shape) < 0.6
    mask[[2, 5]] = False
    still = replace(still, anchors=still.anchors._replace(mask=mask))
    return {"ordinary": (moving, ("ordinary",)), "masked_and_still": (still, ("masked", "off"))}


def quantiser_cases():
    for name, (model, flags) in models().items():
        yield Case(name, flat_model(model), flags)


def encoder_cases():
    for name, (model, flags) in models().items():
        header = write_header(quantise(model).model).decode()
        yield Case(name, dict(flat_model(model), header=header), flags)


def frequencies_cases():
    model = quantise(models()["ordinary"][0])
    _, columns = attribute_columns(model.model.design)[0]
    parts = (model.symbols, model.context.mu_units, model.context.sigma_units)
    yield Case("features", integers(*(a[:, columns].ravel() for a in parts)))
    rng, every = np.random.default_rng(474), np.arange(SIGMA_MIN, SIGMA_MAX + 1, 3)
    mu = rng.integers(-(2**17), 2**17, len(every))
    near = np.rint(mu / 1024 + 2.0 ** (every / 16) * rng.normal(size=len(every)))
    yield Case("every_deviation", integers(near, mu, every), ("wide", "narrow"))
    far = rng.choice([-1, 1], 40) * 2.0 ** rng.uniform(3, 31, 40)
    sigma, mu = rng.integers(-100, 100, 40), rng.integers(-(2**30), 2**30, 40)
    yield Case("escapes", integers(np.append(far, [-(2.0**31), 2.0**31])[2:], mu, sigma), ("tail",))


def integers(symbols, mu_units, sigma_units):
    """The inputs of `frequencies` in the codec's types."""
    named = dict(symbols=symbols, mu_units=mu_units, sigma_units=sigma_units)
    return {name: np.asarray(a).astype(np.int64) for name, a in named.items()}


def rans_cases():
    for name, n, lanes, flags in (
        ("one_lane", 37, 1, ("ordinary",)),
        ("one_symbol", 1, 1, ("single",)),
        ("two_lanes", 60, 2, ("ordinary",)),
        ("eight_lanes", 300, 8, ("ordinary",)),
    ):
        rng = np.random.default_rng(475 + lanes)
        freq = np.rint(2.0 ** rng.uniform(0, 24, n)).astype(np.int32).clip(1, 2**24 - 2)
        start = rng.integers(1, 2**24 - freq).astype(np.int32)
        yield Case(name, dict(start=start, freq=freq, lanes=lanes), flags)


MODEL_SHAPES = {
    "x_a": "A 3",
    "f_a": "A d",
    "s_a": "A 3",
    "l_a": "A 3",
    "O_a": "A k 3",
    "mask": "A k",
    "lo": "3",
    "hi": "3",
    "grids": "*T F",
    "background": "3",
    **shapes_of(*NETWORKS),
    **dict.fromkeys(DESIGN, ""),
}
SECTION_NAMES = (
    "positions",
    *ATTRIBUTE_SECTIONS,
    "masks",
    "hash_grid",
    "deformation_mlp",
    "anchor_mlps",
    "context_mlps",
)
SUBJECTS = (
    Subject(
        "quantiser",
        "L3",
        "rounding",
        "8 to 10, 12",
        "model -> integers of the file",
        {
            **MODEL_SHAPES,
            "positions": "B 3",
            "signs": "G",
            "h": "B L",
            "q_units": "B 4",
            "mu_units": "B n",
            "sigma_units": "B n",
            "symbols": "B n",
            "kept": "B n",
        },
        (),
        quantiser_vjp,
        quantiser_cases,
    ),
    Subject(
        "frequencies",
        "L3",
        "likelihood",
        "",
        "symbols, means, deviations -> intervals of 2^24 and raw bits",
        dict.fromkeys(
            (
                *("symbols", "mu_units", "sigma_units"),
                *("start", "freq", "low", "low_bits", "escape", "v"),
            ),
            "M",
        ),
        (),
        frequencies_vjp,
        frequencies_cases,
    ),
    Subject(
        "rans",
        "L3",
        "likelihood",
        "",
        "intervals of 2^24 -> bytes of a message",
        {"start": "M", "freq": "M", "lanes": "", "message": "B"},
        (),
        rans_vjp,
        rans_cases,
    ),
    Subject(
        "encoder",
        "L3",
        "rounding",
        "",
        "model -> bytes of all sections and of the file",
        {
            **MODEL_SHAPES,
            "header": "",
            **{name: f"B{letter}" for name, letter in zip(SECTION_NAMES, "abcdefghij")},
            "file": "B",
        },
        (),
        encoder_vjp,
        encoder_cases,
    ),
)
