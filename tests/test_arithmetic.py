"""The same bits on every processor: what `prepare` asks for, and what emulated processors compute.

`python -m tests.workshop.proof` prints the hashes that are compared here.
"""

import io
import json
import os
import platform
import shutil
import subprocess
import sys

import numpy as np
import pytest

import p4dgs_ref as p4
from p4dgs_ref import arithmetic
from p4dgs_ref.training import advice, fit
from tests import processes
from tests.sampling import of_the_day
from tests.workshop import demo
from tests.workshop.proof import proof

CORE = (getattr(np, "_core", None) or np.core)._multiarray_umath
PREPARED = """
import os, sys
import p4dgs_ref as p4
p4.prepare()
assert "numpy" not in sys.modules
p4.prepare()
from p4dgs_ref.arithmetic import CHOSEN, kernels
print(*(os.environ.get(name, "") for name in CHOSEN), kernels(), sep="; ")
p4.prepare()
"""
TOO_LATE = "import numpy, p4dgs_ref as p4; p4.prepare(); p4.prepare()"


def python(*options, **variables):
    """Run Python in a process of its own, in which only these variables choose kernels."""
    others = {
        name: value
        for name, value in os.environ.items()
        if name not in (*arithmetic.CHOSEN, "P4DGS_KERNELS")
    }
    return processes.run(*options, env={**others, **variables})


def pinned():
    """Skip a test of kernels or hashes where the surroundings use other kernels."""
    if arithmetic.kernels() == arithmetic.OWN:
        asked = {name: os.environ.get(name) for name in (*arithmetic.CHOSEN, "P4DGS_KERNELS")}
        pytest.skip(f"other kernels than those of AVX2 are in force: {asked}")


# --- what prepare asks for ---
@pytest.mark.slow
def test_prepare_chooses_the_kernels_without_a_warning():
    """An unknown name of a feature would be a warning, which -W error makes an exception."""
    pinned()
    done = python("-W", "error", "-c", PREPARED)
    assert done.stderr == "" and done.stdout.startswith("Haswell; ")
    assert done.stdout.endswith("; Haswell, AVX2, 1 thread\n")
    name, features = arithmetic.CHOSEN[1], done.stdout.split("; ")[1]
    inherited = python(
        "-W", "error", "-c", TOO_LATE, **{name: features, "OPENBLAS_CORETYPE": "Haswell"}
    )
    assert (inherited.stdout, inherited.stderr) == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize(
    "variables, asked",
    [
        ({"P4DGS_KERNELS": "native"}, ["", ""]),
        ({"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": ""}, ["Prescott", ""]),
    ],
)
def test_prepare_leaves_what_is_set_and_native_kernels(variables, asked):
    done = python("-c", PREPARED, **variables)
    assert done.stdout.split("; ")[:2] == asked, done.stderr


@pytest.mark.slow
def test_prepare_after_numpy_says_so_once():
    pinned()
    done = python("-c", TOO_LATE)
    own = python("-c", "from p4dgs_ref.arithmetic import *; print(kernels())").stdout.strip()
    assert done.stderr.count("the kernels are the processor's own") == (own == arithmetic.OWN)
    assert python("-c", TOO_LATE, P4DGS_KERNELS="native").stderr == ""


@pytest.mark.parametrize(
    "flags, has", [("avx avx2 fma", True), ("avx fma", False), ("avx2", False), (None, False)]
)
def test_kernels_are_chosen_where_the_system_knows_the_instructions(monkeypatch, flags, has):
    def opened(path, **how):
        if flags is None:
            raise FileNotFoundError(path)
        return io.StringIO(f"model name : avx2 fma\nflags\t\t: sse2 {flags}\n")

    monkeypatch.setattr(arithmetic, "open", opened, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    assert arithmetic.has_avx2() == has
    monkeypatch.setattr(
        platform, "machine", lambda: "aarch64"
    )  # emulated: the flags are the host's
    assert not arithmetic.has_avx2()
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not arithmetic.has_avx2()


@pytest.mark.parametrize("found", [[], [("SkylakeX", 1)], [("Haswell", 1), ("Zen", 1)]])
def test_other_kernels_are_never_called_those_of_avx2(monkeypatch, found):
    monkeypatch.setattr(arithmetic, "openblas", lambda: found)
    assert arithmetic.kernels() == arithmetic.OWN


@pytest.mark.parametrize(
    "found, has_avx2, libraries, is_told",
    [
        (arithmetic.PROMISED, True, [("Haswell", 1)], False),
        (arithmetic.OWN, True, [("SkylakeX", 1)], True),
        ("Haswell, AVX2, 2 threads", True, [("Haswell", 2)], True),
        (arithmetic.OWN, False, [("Nehalem", 1)], False),
        (arithmetic.OWN, True, [], False),  # another BLAS
    ],
)
def test_kernels_that_could_be_the_promised_ones_are_told_of(
    monkeypatch, found, has_avx2, libraries, is_told
):
    monkeypatch.setattr(arithmetic, "kernels", lambda: found)
    monkeypatch.setattr(arithmetic, "has_avx2", lambda: has_avx2)
    monkeypatch.setattr(arithmetic, "openblas", lambda: libraries)
    told = arithmetic.other_kernels()
    assert told.startswith(f"the kernels are {found}, not Haswell") == is_told and "\n" not in told


@pytest.mark.parametrize("function", [p4.train, p4.main_job])
def test_a_training_with_other_kernels_says_so(monkeypatch, tmp_path, function):
    """In a program that trains without `prepare`; the training itself is left out."""
    monkeypatch.setattr(advice, "other_kernels", lambda: "the kernels are others")
    monkeypatch.setattr(fit, "run", None)
    scene = p4.load_scene("static", downscale=8)
    with pytest.raises(TypeError), pytest.warns(UserWarning, match="^the kernels are others$"):
        function(scene, "smoke", folder=tmp_path)


def test_only_libraries_of_that_name_are_asked(monkeypatch):
    """A program may have mapped other files from a folder that is called so."""
    mapped = "7f00-7f01 r--p 00000000 08:01 42    /home/openblas/a picture.bin\n"
    monkeypatch.setattr(arithmetic, "open", lambda *_, **how: io.StringIO(mapped), raising=False)
    assert arithmetic.openblas() == []


def test_numpy_without_its_kernels_of_avx2_is_reported(monkeypatch):
    """NumPy 2.4 names these kernels X86_V3; whoever disables them leaves AVX2 itself as it is."""
    pinned()
    monkeypatch.setitem(CORE.__cpu_features__, "X86_V3", False)
    assert arithmetic.kernels() == arithmetic.OWN


def test_a_feature_above_avx2_is_reported(monkeypatch):
    pinned()
    known = {name for names in arithmetic.FEATURES.values() for name in names.split()}
    monkeypatch.setattr(arithmetic, "openblas", lambda: [("Haswell", 2)])
    assert arithmetic.kernels() == "Haswell, AVX2, 2 threads"
    monkeypatch.setitem(CORE.__cpu_features__, min(known.intersection(CORE.__cpu_dispatch__)), True)
    assert arithmetic.kernels() == arithmetic.OWN


def test_every_feature_above_avx2_is_disabled():
    """NumPy's own list: what follows AVX2, or the third level of x86-64; Xeon Phi is left out."""
    release = tuple(map(int, np.__version__.split(".")[:2]))
    names = next(names for since, names in arithmetic.FEATURES.items() if release >= since)
    phi = {"AVX512_KNL", "AVX512_KNM"}
    above = {name for name in CORE.__cpu_dispatch__ if name == "X86_V4" or "512" in name} - phi
    assert above == set(names.split())


# --- what processors compute ---
@pytest.fixture(scope="module")
def native():
    pinned()
    return proof()


def test_sixty_steps_have_the_bytes_that_are_kept():
    """Any other number in a preset, a step, the renderer or the codec leads to others."""
    kept = demo.kept()
    if demo.with_what() != kept["arithmetic"]:
        pytest.skip(f"the steps had {kept['arithmetic']}; other last bits lead to other bytes")
    made = proof()
    assert made.items() - kept.items() == {("arithmetic", made["arithmetic"])}


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("qemu-x86_64"), reason="no qemu-x86_64 (package qemu-user)")
@pytest.mark.parametrize("processor", of_the_day(["Haswell", "EPYC-Rome"]))
def test_an_emulated_processor_computes_the_same_bytes(native, processor):
    command = ["qemu-x86_64", "-cpu", processor, sys.executable, "-m", "tests.workshop.proof"]
    done = subprocess.run(command, cwd=processes.ASIDE, **processes.CAPTURED)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == native
