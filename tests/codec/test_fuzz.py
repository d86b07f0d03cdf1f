"""Hostile files: damage of many kinds is refused, and no file takes more memory than its header declares, times four."""

import contextlib
import dataclasses
import json
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest

from p4dgs_ref.codec import container, file
from p4dgs_ref.codec.container import (
    BitstreamError,
    open_container,
    read_container,
    write_container,
)
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.gaussian_table import SIGMA_MAX, SIGMA_MIN, gaussian_model
from p4dgs_ref.codec.header import LIMITS, declared_numbers
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.codec.streams import decode_symbols, encode_bits, encode_gaussian
from p4dgs_ref.studies.random_inputs import sample_model
from tests.golden import fuzz
from tests.golden.damage import Mutation, assemble, mutation

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
        *(("xyz", n) for n in (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514)),
        *((axes, n) for axes in ("xy", "xz", "yz") for n in (130, 258, 514, 1026)),
    ),
)


@pytest.fixture(scope="module")
def least():
    return fuzz.good_files()[1]


@pytest.mark.parametrize(
    "seed, count", [(0, 2000), pytest.param(1, 20_000, marks=pytest.mark.slow)]
)
def test_damage_is_refused_or_within_limits(seed, count):
    answers, failures = fuzz.fuzz(count, seed)
    assert not failures
    assert len(answers) == 28 and sum(sum(c.values()) for c in answers.values()) == count
    assert all(c["refused"] > count / 100 for c in answers.values())
    assert not any(c["within limits"] for kind, c in answers.items() if kind.startswith("raw"))
    for kind in (
        "flip",
        "overwrite",
        "header field",
    ):  # what repaired checksums let through was looked at
        assert answers[f"repaired {kind}"]["within limits"]


def refused(data):
    try:
        decode(data)
    except BitstreamError:
        return True


@pytest.mark.parametrize("i", range(3))
def test_every_prefix_is_refused(i):
    data = fuzz.good_files()[i]
    assert decode(data) and all(refused(data[:n]) for n in range(len(data)))


@pytest.mark.parametrize("i", range(2))
def test_every_flipped_bit_is_refused(i):
    data = bytearray(fuzz.good_files()[i])
    for at in range(len(data)):
        for bit in range(8):
            data[at] ^= 1 << bit
            assert refused(data), (at, bit)
            data[at] ^= 1 << bit
    assert decode(data)


def test_a_mutation_is_always_the_same():
    files = fuzz.good_files()
    assert mutation(3, 17, files) == mutation(3, 17, files) != mutation(3, 18, files)
    assert all(
        assemble(
            [
                (container.SECTIONS.index(name) + 1, body)
                for name, body in read_container(data).items()
            ]
        )
        == data
        for data in files
    )


@pytest.mark.parametrize(
    "fault, found",
    [
        (lambda data: [][1], "IndexError"),
        (lambda data: np.float64(1e308) * 10, "RuntimeWarning"),
        (lambda data: np.ones(2**24), "bytes of memory"),
        (lambda data: time.sleep(0.02), "seconds"),
    ],
)
def test_a_decoder_with_a_fault_is_found_out(monkeypatch, fault, found):
    """The judge can fail: by an exception, a warning, too much memory, too much time."""
    monkeypatch.setattr(fuzz, "PATIENCE", 0.015 if found == "seconds" else 60)
    monkeypatch.setattr(
        fuzz, "quantised_of", lambda sections: (fault(sections), file.quantised_of(sections))
    )
    _, failures = fuzz.fuzz(12)
    assert failures and all(found in failure for failure in failures)


def test_an_accepted_change_is_found_out(monkeypatch, least, capsys):
    """A reader that does not look at checksums takes a weight with another bit; the program ends with 1."""
    sections = read_container(least)
    body = bytearray(sections["anchor_mlps"])
    body[0] ^= 1
    monkeypatch.setattr(container.zlib, "crc32", lambda data: 0)
    good, bad = (
        write_container({**sections, "anchor_mlps": bytes(b)})
        for b in (sections["anchor_mlps"], body)
    )
    assert fuzz.judge(Mutation("raw flip", bad, good)) == ("failed", "changed, and yet decoded")
    assert fuzz.judge(Mutation("repaired flip", bad, good)) == ("within limits", "")
    monkeypatch.setattr(fuzz, "mutation", lambda seed, i, files: Mutation("raw flip", bad, good))
    assert (
        fuzz.main(["--count", "2"]) == 1
        and "mutation 1, raw flip: changed" in capsys.readouterr().out
    )


def test_models_beyond_their_header_are_found_out(least):
    q = file.quantised_of(open_container(least))
    assert fuzz.beyond_limits(q) == []
    anchors = q.model.anchors
    for name, model in (
        ("f_a", dataclasses.replace(q.model, anchors=anchors._replace(f_a=anchors.f_a * np.inf))),
        ("O_a", dataclasses.replace(q.model, anchors=anchors._replace(O_a=anchors.O_a[0]))),
        ("grid 0", dataclasses.replace(q.model, grids=[q.model.grids[0][1:]])),
    ):
        assert fuzz.beyond_limits(q._replace(model=model)) == [name]
    assert fuzz.beyond_limits(q._replace(positions=q.positions + 65536)) == ["positions"]
    assert fuzz.beyond_limits(q._replace(symbols=q.symbols * 0 + 2**31 + 1)) == ["symbols"]
    case = Mutation("raw flip", least[:-1], least[:-1])
    assert fuzz.judge(case) == ("failed", "a good file was refused")


def test_the_program_says_what_it_did(tmp_path, least):
    good, bad = tmp_path / "good.p4dgs", tmp_path / "bad.p4dgs"
    good.write_bytes(least), bad.write_bytes(least[1:])
    run = [sys.executable, "-m", "tests.golden.fuzz"]
    done = subprocess.run(
        [*run, "--count", "100", "--seed", "4", good], capture_output=True, text=True
    )
    assert done.returncode == 0 and not done.stderr
    lines = done.stdout.splitlines()
    assert sum(map(int, lines[-2].split()[1:])) == 100 and lines[-1].startswith(
        "no unexpected exception"
    )
    for wrong, why in (
        (bad, "at least 18 bytes|not a P-4DGS file"),
        (tmp_path / "none", "No such file"),
    ):
        done = subprocess.run([*run, wrong], capture_output=True, text=True)
        assert done.returncode == 2 and "Traceback" not in done.stderr
        assert (
            any(part in done.stderr.splitlines()[-1] for part in why.split("|"))
            and str(wrong) in done.stderr
        )


# --- memory -------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def traced(most):
    """The block allocates at most this many bytes at any time."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= most, f"{peak / 2**20:.1f} MiB, at most {most / 2**20:.1f} expected"


def declared_bytes(model):
    arrays = [
        *model.anchors,
        *model.grids,
        *(a for pair in model.networks.values() for part in pair for a in part),
    ]
    return 8 * sum(a.size for a in arrays)


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


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_large_models_stay_within_their_memory(name):
    """And well within: a large model takes nearly what each of its numbers may, a small one a part of the 64 MiB."""
    anchors, fields = LARGE[name]
    data = encode(sample_model(1, anchors, **fields))
    bound = fuzz.memory_bound(data)
    with traced(bound - 2**25):
        model = decode(data)
    assert bound == 2**26 + 4 * declared_bytes(model) and len(model.anchors.mask) == anchors


def test_every_table_at_once_takes_a_third_of_the_room():
    """Whatever frequencies symbols ask for, beside at most 33 bytes a symbol (LIMITS["numbers"] keeps that within 4 * 8)."""
    sigma, mu = (
        a.ravel()
        for a in np.meshgrid(np.arange(SIGMA_MIN, SIGMA_MAX + 1), np.arange(1024), indexing="ij")
    )
    symbols = np.rint(
        mu / 1024 + 2.0 ** (sigma / 16) * np.random.default_rng(0).normal(size=mu.shape)
    ).astype(int)
    data = encode_gaussian(symbols, mu, sigma)
    with traced(2**26 * 5 // 8):
        model = gaussian_model(mu, sigma)
        assert np.array_equal(decode_symbols(data, model), symbols)
    assert len(model.first) > 65_000 and LIMITS["numbers"] * (33 - 32) < 2**26 * 5 // 8


@pytest.mark.slow
def test_nothing_but_escapes_stays_within_its_memory():
    """Their codes take up to 67 bits, eight times what a symbol has in memory."""
    mu = np.zeros(200_000, int)
    symbols = np.where(np.arange(len(mu)) % 2, 2**31, -(2**31))
    data = encode_gaussian(symbols, mu, mu)
    with traced(33 * len(mu) + 2**24):
        assert np.array_equal(decode_symbols(data, gaussian_model(mu, mu)), symbols)


def test_megabytes_that_belong_to_nothing_cost_no_memory(least):
    sections, much = read_container(least), bytes(2**24)
    for name in sections:
        for body in (
            sections[name] + much,
            much + sections[name],
            b"[" * 2**24,
            b"[1," * 2**22,
            b"\xff" * 2**24,
        ):
            data = write_container({**sections, name: body})
            with traced(2**23), pytest.raises(BitstreamError):
                decode(data)


def test_hostile_headers_cost_no_memory(least):
    """Each declares far more than its file holds; nothing is allocated before positions and networks have their length."""
    sections = read_container(least)
    header = json.loads(sections["header"])
    full = {"hash_grid": encode_bits(np.ones(1, bool)), "masks": encode_bits(np.ones(1, bool))}
    large = dict(F=64, grid=[["xyz", 63]], table=[2**24, 2**24])
    for fields, where in (
        (dict(anchors=2**21), "positions"),
        (dict(anchors=2**22), "header"),
        (dict(d=4096), "anchor_mlps"),
        (dict(k=256), "anchor_mlps"),
        (dict(hidden=[2**14] * 2), "header"),
        (dict(context=[5000] * 2), "header"),
        (dict(large, grid=[["xyz", 2**16]] * 64), "header"),
        (dict(hidden=[5000]), "anchor_mlps"),
        (large, "context_mlps"),
        (dict(large, grid=[["xyz", 63]] * 2), "header"),
    ):
        data = write_container(
            {**sections, **full, "header": json.dumps({**header, **fields}).encode()}
        )
        with traced(2**20), pytest.raises(BitstreamError) as caught:
            decode(data)
        assert caught.value.section == where, fields


def test_the_largest_model_is_what_the_limits_say():
    """256 MiB; 400,000 anchors of the paper's larger preset, not 500,000."""
    design = quantise(sample_model(0, 1, **REAL)).model.design
    assert (
        sum(declared_numbers(design, 390_000))
        <= LIMITS["numbers"]
        == 2**28 // 8
        < sum(declared_numbers(design, 400_000))
    )
