"""Hostile files: every damage is refused, and the memory of decoding is bounded by the header."""

from collections import Counter

import numpy as np
import pytest

from p4dgs_ref.codec.container import BitstreamError, read_container, write_container
from p4dgs_ref.codec.file import NETWORK_SECTIONS, decode, encode, quantised_of
from p4dgs_ref.codec.gaussian_table import SIGMA_MAX, SIGMA_MIN, gaussian_model
from p4dgs_ref.codec.quantise import without_silent_units
from p4dgs_ref.codec.streams import decode_symbols, encode_bits, encode_gaussian
from p4dgs_ref.limits import MAX_NUMBERS
from p4dgs_ref.model import join
from tests import ROOT
from tests.codec import fuzz
from tests.codec.models import changed, digest, refusal, traced, with_header
from tests.sampling import SEED, few
from tests.workshop.conformance_good import GOOD, stream_of
from tests.workshop.damage import damage_header, sections_in
from tests.workshop.sample_model import sample_model

LEVELS_3D = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)
LEVELS_2D = (130, 258, 514, 1026)
# The sizes of the paper's preset for real scenes.
REAL = dict(
    d=32,
    k=10,
    hidden=(64, 64),
    deformation=(192, 192),
    L_x=10,
    L_t=10,
    context=(64, 64),
    F=4,
    table=(2**13, 2**15),
    grid=(
        *(("xyz", n) for n in LEVELS_3D),
        *((axes, n) for axes in ("xy", "xz", "yz") for n in LEVELS_2D),
    ),
)

DEMO = [*ROOT.glob("tutorials/demo.p4dgs")]  # none where the paper stands alone


def damages(few, many):
    """Return (count, seed): `few` are the same always, `many` others for each P4DGS_TEST_SEED."""
    return [(few, 0), pytest.param(many, int(SEED), marks=pytest.mark.slow, id=f"{many}")]


@pytest.fixture(scope="module")
def least():
    return fuzz.good_files()[1]


@pytest.mark.parametrize("count, seed", damages(150, 1000))
def test_damage_is_refused_or_within_limits(count, seed):
    answers, failures = fuzz.fuzz(count, seed)
    assert not failures, f"seed {seed}"
    assert sum(sum(c.values()) for c in answers.values()) == count
    assert not any(c["within limits"] for kind, c in answers.items() if kind.startswith("raw"))
    if count == 1000:
        assert len(answers) == 28 and all(c["refused"] > count / 100 for c in answers.values())
        # Repaired checksums let some changes through, so decoded models were checked too.
        for kind in ("flip", "overwrite", "header field"):
            assert answers[f"repaired {kind}"]["within limits"]


# --- Encoding again ---


def edited(rng, data):
    """A file with another header or other weights, a box without extent, or no children."""
    sections = sections_in(data)
    name = rng.choice([name for name in NETWORK_SECTIONS if name in sections])
    box = np.frombuffer(sections["positions"], "<f4", 6).reshape(2, 3)
    flat, at = np.where(rng.random(3) < 0.5, box[0], box), 2 * rng.integers(len(sections[name]) / 2)
    changes = (
        {"positions": flat.tobytes() + sections["positions"][24:]},
        {"masks": bytes(4), "offsets": b""},
        {name: sections[name][:at] + rng.bytes(2) + sections[name][at + 2 :]},
        {name: bytes(len(sections[name]))},
        {"header": sections_in(damage_header(rng, data, True)[1])["header"]},
    )
    return write_container({**sections, **changes[rng.integers(5)]})


def kept(model):
    """What the page says that an encoder keeps: no anchors without children, no silent units."""
    alive = model.anchors.mask.any(axis=1)
    alive[0] |= not alive.any()
    anchors = {name: array[alive] for name, array in model.anchors._asdict().items()}
    return without_silent_units(changed(model, **anchors))


@pytest.mark.parametrize("count, seed", damages(60, 500))
@pytest.mark.filterwarnings("error")
def test_what_decodes_encodes_to_a_file_that_decodes_to_the_same(count, seed):
    """Where the box has no extent, 0 is stored, and attributes may move by half of another step."""
    good = [path.read_bytes() for path in DEMO]
    good += [write_container(stream_of(make)[1]) for _, make in GOOD.values()]
    seen = Counter()
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        data = edited(rng, good[rng.integers(len(good))])
        try:
            q = quantised_of(read_container(data))
        except BitstreamError:
            continue
        (lo, hi), expected = q.model.box, kept(q.model)
        lost = bool(q.positions[:, lo == hi].any())
        seen.update(
            decoded=1,
            flat=lost,
            fewer_anchors=len(expected.anchors.mask) < len(q.positions),
            fewer_units=expected.design != q.model.design,
        )
        try:
            again = encode(q.model)
        except OverflowError:
            assert lost, f"seed {seed}, mutant {i}"
            continue
        found = quantised_of(read_container(again))
        if lost:
            moved = np.abs(join(found.model.anchors) - join(expected.anchors))
            steps = np.repeat(found.context.q, expected.design.widths, axis=1)
            assert (moved <= steps / 2 * (1 + 1e-12)).all(), f"seed {seed}, mutant {i}"
        else:
            assert digest(found.model) == digest(expected), f"seed {seed}, mutant {i}"
            assert found.model.design == expected.design
        assert encode(found.model) == again, f"seed {seed}, mutant {i}"
    assert seen["decoded"] > count / 3 and seen["flat"] and seen["fewer_anchors"]
    assert count == 60 or seen["fewer_units"]


# --- Memory ---


def bytes_of_arrays(model):
    """The size of all arrays of a model, 8 bytes per number."""
    of_networks = [a for pair in model.networks.values() for part in pair for a in part]
    return 8 * sum(a.size for a in (*model.anchors, *model.grids, *of_networks))


LARGE = {
    "anchors of paper_real": (20_000, REAL),
    "narrow": (60_000, dict(d=1, k=1)),
    "wide features": (700, dict(d=4096)),
    "many children": (2000, dict(k=256)),
    "every level": (1500, dict(F=64, grid=(("xyz", 3),) * 64)),
    "wide context": (200, dict(context=(2**14,), d=1, k=1)),
    "large networks": (30, dict(hidden=(900, 1100))),
    "large grid": (30, dict(F=64, grid=(("xyz", 47),), table=(2**24, 2**24))),
}


@pytest.mark.parametrize("name", few(LARGE, 0, 3))
def test_large_models_stay_within_their_memory(name):
    """They even leave half of the 64 MiB unused."""
    anchors, fields = LARGE[name]
    data = encode(sample_model(1, anchors, **fields))
    bound = fuzz.memory_bound(data)
    with traced(bound - 2**25):
        model = decode(data)
    assert bound == 2**26 + 4 * bytes_of_arrays(model)
    assert len(model.anchors.mask) == anchors


def test_every_table_at_once_takes_five_eighths_of_the_64_mib():
    """This is the memory for all frequency tables and for decoding a symbol with each of them.

    Decoding takes at most 33 bytes per symbol beside the tables. For the largest model, the byte
    beyond four times 8 stays within the same five eighths.
    """
    deviations = np.arange(SIGMA_MIN, SIGMA_MAX + 1)
    sigma, mu = (a.ravel() for a in np.meshgrid(deviations, np.arange(1024), indexing="ij"))
    noise = np.random.default_rng(0).normal(size=mu.shape)
    symbols = np.rint(mu / 1024 + 2.0 ** (sigma / 16) * noise).astype(int)
    data = encode_gaussian(symbols, mu, sigma)
    with traced(2**26 * 5 // 8):
        model = gaussian_model(mu, sigma)
        assert np.array_equal(decode_symbols(data, model), symbols)
    assert len(model.first) > 65_000
    assert MAX_NUMBERS * (33 - 32) < 2**26 * 5 // 8


@pytest.mark.slow
def test_nothing_but_escapes_stays_within_its_memory():
    """Their codes have up to 67 bits; as one byte per bit they would take eight times a symbol."""
    mu = np.zeros(200_000, int)
    symbols = np.where(np.arange(len(mu)) % 2, 2**31, -(2**31))
    data = encode_gaussian(symbols, mu, mu)
    with traced(33 * len(mu) + 2**24):
        assert np.array_equal(decode_symbols(data, gaussian_model(mu, mu)), symbols)


def test_megabytes_of_nonsense_cost_no_memory(least):
    sections, much = sections_in(least), bytes(2**24)
    for name in sections:
        around = (sections[name] + much, much + sections[name])
        for body in (*around, b"[" * 2**24, b"[1," * 2**22, b"\xff" * 2**24):
            data = write_container({**sections, name: body})
            with traced(2**23):
                refusal(decode, data)


def test_hostile_headers_cost_no_memory():
    """Headers that declare more than the file holds are refused before arrays are allocated."""
    first = sections_in(fuzz.good_files()[1])
    full = {"hash_grid": encode_bits(np.ones(1, bool)), "masks": encode_bits(np.ones(1, bool))}
    large = dict(F=64, grid=[["xyz", 63]], table=[2**24, 2**24])
    for fields, where in (
        (dict(anchors=2**18), "positions"),
        (dict(anchors=2**21), "header"),
        (dict(d=4096), "anchor_mlps"),
        (dict(hidden=[2**14] * 2), "header"),
        (dict(context=[5000] * 2), "header"),
        (dict(large, grid=[["xyz", 2**16]] * 64), "header"),
        (dict(large, grid=[["xyz", 39]]), "context_mlps"),
        (large, "header"),
    ):
        data = write_container(with_header({**first, **full}, **fields))
        with traced(2**20):
            assert refusal(decode, data).section == where, fields
