"""The published vectors: complete, true, and met by this project's own code."""

import re
import struct
from collections import Counter

import numpy as np
import pytest

from p4dgs_ref.lessons import TUTORIALS
from p4dgs_ref.oracle import checker, published, safetensors
from p4dgs_ref.splatting.table import EQUATIONS
from tests.oracle.answers import Port, places_in
from tests.sampling import few
from tests.workshop import writer
from tests.workshop.cases import FLAGS
from tests.workshop.mistakes import MISTAKES
from tests.workshop.subjects import lacking, subjects
from tests.workshop.vectors import WRITTEN, damaged


@pytest.fixture(scope="module")
def manifest():
    return published.read_manifest()


@pytest.fixture(scope="module")
def golden(manifest):
    return {s["key"]: published.read(s) for s in manifest["subjects"]}


# --- the format ---------------------------------------------------------------------------------
def test_safetensors_come_back():
    rng = np.random.default_rng(0)
    arrays = {
        "a": rng.normal(size=(3, 2)),
        "none": np.zeros((0, 4), np.float32),
        "one": np.float64(2.5),
        "flag": np.array([True, False]),
        "i": np.arange(-3, 4),
        "u": np.array([[2**32 - 1]], np.uint32),
        "big": np.arange(3, dtype=">f8"),
    }
    data = writer.dump(arrays, {"license": "CC0-1.0"})
    places = places_in(data)
    back = safetensors.load(data)
    for name, a in arrays.items():
        assert np.array_equal(back[name], a) and back[name].shape == np.shape(a), name
        place = places[name]
        assert data[place["offset"] :][: place["bytes"]] == back[name].tobytes()
        assert place["offset"] % back[name].dtype.itemsize == 0
    assert struct.unpack("<Q", data[:8])[0] % 8 == 0


@pytest.mark.parametrize(
    "damage, says",
    [
        (lambda d: d[:5], "length"),
        (lambda d: struct.pack("<Q", 2**20 + 1) + b"{}" + b" " * 2**20, "at most 1048576"),
        (lambda d: writer.dump({"a" * 9000: np.ones(1)})[:-1], r"^a.{500,1020}got 7$"),
        (lambda d: d[:-1], "48 bytes"),
        (lambda d: d.replace(b'"F64"', b'"F65"'), "dtype"),
        (lambda d: d.replace(b"[0,48]", b"[-8,8]"), "data_offsets"),
        (lambda d: d.replace(b"[3,2]", b"[-6] "), "shape"),
    ],
)
def test_damaged_safetensors_are_refused(damage, says):
    data = writer.dump({"a": np.ones((3, 2))})
    with pytest.raises(safetensors.TensorError, match=says):
        safetensors.load(damage(data))


# --- what is published --------------------------------------------------------------------------
def test_files_are_those_of_the_manifest(manifest):
    assert damaged(published.FOLDER) == []
    files = {file.name for file in published.FOLDER.iterdir() if file.is_file()}
    assert files - {"manifest.json"} == set(manifest["files"])
    made = {name for name in files if name.endswith(".safetensors")}
    assert files - made == {"manifest.json", "FLAGS.json", *WRITTEN}


def test_the_header_of_every_file_leads_to_the_numbers_of_its_cases(manifest, golden):
    for subject in manifest["subjects"]:
        data, cases = (published.FOLDER / subject["file"]).read_bytes(), golden[subject["key"]]
        read = {f"{case.name}/{name}": a for case in cases for name, a in case.tensors.items()}
        places = places_in(data)
        assert read.keys() == places.keys()
        for name, place in places.items():
            raw = data[place["offset"] :][: place["bytes"]]
            a = np.frombuffer(raw, safetensors.DTYPES[place["dtype"]]).reshape(place["shape"])
            assert a.tobytes() == read[name].tobytes()


def test_the_manifest_has_values_and_gradients_of_every_level(manifest, golden):
    for subject in (row for row in manifest["subjects"] if row["level"] == "L1"):
        roles = {name.split(".")[0] for case in golden[subject["key"]] for name in case.tensors}
        assert {"in", "out", "scale"} <= roles
        assert bool(subject["differentiable"]) == ({"out_bar", "in_bar"} <= roles), subject["key"]
    assert {s["level"] for s in manifest["subjects"]} == {"L0", "L1", "L2", "L3", "L4"}
    assert len(published.stream_rows()) >= 60


def lacking_here(key):
    """One line on what an equation of the table lacks, step by step of CONTRIBUTING, or None."""
    if line := lacking(key):
        return line
    if key not in published.subjects():
        return f"{key}: no vectors; `python -m tests.workshop.vectors` publishes them"
    if sum(mistake.equation == key for mistake in MISTAKES) < 2:
        return f"{key}: fewer than two known mistakes in tests/workshop/mistakes"
    if not any(key in tutorial.keys for tutorial in TUTORIALS):
        return f"{key}: no tutorial in TUTORIALS of p4dgs_ref/lessons.py"
    return None


def test_no_equation_lacks_anything():
    assert "\n".join(filter(None, map(lacking_here, EQUATIONS))) == ""


def test_an_equation_that_lacks_something_leaves_the_others_alone(monkeypatch):
    monkeypatch.setitem(EQUATIONS, "volume", EQUATIONS["offsets"]._replace(key="volume"))
    assert lacking_here("volume") == "volume: no cases in tests/workshop/cases/volume.py"
    assert subjects.__wrapped__().keys() == subjects().keys()


def test_scalars_have_constants_of_their_equation_alone(manifest):
    for row in manifest["subjects"]:
        if row["level"] == "L0" and row["key"] != "gaussian_bin":
            of_equation = published.subjects()[row["equation"]]["constants"].items()
            assert row["constants"].items() <= of_equation, row["key"]


def test_ids_are_unique_and_records_complete(manifest):
    cases = [case for subject in manifest["subjects"] for case in subject["cases"]]
    ids = [row["id"] for row in cases + published.stream_rows()]
    assert len(set(ids)) == len(ids)
    for case in cases:
        assert case["result"] in ("valid", "acceptable")
        assert ("why" in case) == (case["result"] == "acceptable")
        assert set(case["flags"]) <= set(FLAGS) and case["flags"] and case["tests"]
        for precision in ("float64", "float32"):
            bound = case["tolerance"][precision]
            if bound:
                assert bound["eps_S"] >= 32 and bound["reason"]
            else:
                assert case["tolerance"]["float32_reason"]
    assert {"reference", "high-precision", "closed form"} == {c["provenance"] for c in cases}


def test_the_shapes_of_the_manifest_hold(manifest, golden):
    for subject in manifest["subjects"]:
        for case in golden[subject["key"]]:
            lengths = {}
            for tensor, a in case.tensors.items():
                role, name, *_ = tensor.split(".")
                if role in ("in", "out"):
                    axes = subject["shapes"][name].split(" -> ")[0 if role == "in" else -1]
                    is_list = axes.startswith("*")  # letters may differ from array to array
                    off = "off" in case.record["flags"]
                    bind(
                        axes.lstrip("*"), a, {} if is_list else lengths, off, f"{case.id} {tensor}"
                    )
            if "ordinary" in case.record["flags"]:
                text = " ".join(subject["shapes"].values())
                numbers = {int(n) for n in re.findall(r"\b[2-9]\b", text)}
                counts = Counter([*lengths.values(), *numbers])
                assert max(counts.values(), default=1) == 1, f"{case.id}: equal axes {lengths}"


def bind(axes, array, lengths, may_be_off, what):
    """Compare an array with its axes, "3 A 3k": numbers are lengths, letters keep theirs."""
    axes = axes.split()
    assert array.ndim == len(axes), f"{what}: shape {array.shape}, declared {axes}"
    for n, axis in zip(array.shape, axes):
        factor, letter = re.fullmatch(r"(\d*)([A-Za-z]*)", axis).groups()
        factor = int(factor or 1)
        if may_be_off and n == 0:  # an effect that is off has inputs and heads of zero width
            continue
        want = factor * (lengths.setdefault(letter, n // factor) if letter else 1)
        assert n == want, f"{what}: shape {array.shape}, declared {axes} with {lengths}"


def test_an_input_has_one_type():
    """In all cases of a subject; and whole numbers are whole in all subjects."""
    types, kinds = {}, {}
    for subject in published.read_manifest()["subjects"]:
        tensors = (pair for case in published.read(subject) for pair in case.tensors.items())
        for tensor, a in tensors:
            role, name, *_ = tensor.split(".")
            if role != "scale":
                at = subject["key"], role, name
                assert types.setdefault(at, a.dtype) == a.dtype, at
                assert role != "in" or kinds.setdefault(name, a.dtype.kind) == a.dtype.kind, at


# --- honest -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "key, dtype", few([(k, t) for k in published.subjects() for t in (np.float64, np.float32)], 16)
)
def test_the_reference_passes(golden, key, dtype):
    """Against numbers most of which are not its own: decimals, closed forms."""
    report = checker.Report(checker.check_subject(golden[key], Port(dtype=dtype)))
    assert not any(r.wrong for r in report.results), str(report)
