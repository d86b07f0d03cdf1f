"""Level L3: our own answers pass as files and through a process; every wrong one is found."""

import json
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.codec.container import BitstreamError
from p4dgs_ref.codec.file import quantised_of
from p4dgs_ref.oracle import checker, safetensors, streams
from p4dgs_ref.oracle.adapter import Adapter, pack
from p4dgs_ref.oracle.ports import FolderPort, PortError
from tests.sampling import few
from tests.workshop import decoded, writer
from tests.workshop.decoded import write_answers
from tests.workshop.mistakes import MISTAKES
from tests.workshop.mistakes.__main__ import answers

ROWS = streams.read_rows()
GOOD, BAD = ([row["name"] for row in ROWS[key]] for key in ("good", "bad"))

DECODER = """
import base64, json, sys
sys.path.insert(0, ROOT)
from p4dgs_ref.codec.container import BitstreamError
from p4dgs_ref.oracle.adapter import pack
from tests.workshop.decoded import decoded
for text in sys.stdin:
    request = json.loads(text)
    answer = {"p4dgs_oracle": 1} if "id" not in request else {"id": request["id"]}
    if "stream" in request:
        try:
            arrays = decoded(base64.b64decode(request["stream"]))
            answer["arrays"] = {name: pack(a) for name, a in arrays.items()}
        except BitstreamError as error:
            answer["refused"] = str(error)
    print(json.dumps(answer), flush=True)
"""


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    """What this project's decoder finds, as files; nothing may write into it."""
    folder = tmp_path_factory.mktemp("ours")
    write_answers(folder)
    return folder


@pytest.fixture
def folder(ours, tmp_path):
    """A copy to be damaged."""
    shutil.copytree(ours / "codec", tmp_path / "codec")
    return tmp_path


def check(folder, *names):
    """{name: Result} of those of all streams, or of those named, that do not pass."""
    asked = [name for name in GOOD + BAD if not names or name in names]
    results = streams.check(FolderPort(folder), asked)
    assert [r.id for r in results] == [f"codec/{name}" for name in asked]
    assert all(r.level == "L3" and r.required for r in results)
    return {r.id[6:]: r for r in results if r.verdict != "pass"}


def change(folder, name, **arrays):
    """Replace arrays of one answer; None takes one away."""
    path = folder / "codec" / f"{name}.safetensors"
    kept = {**safetensors.load(path.read_bytes()), **arrays}
    path.write_bytes(writer.dump({n: a for n, a in kept.items() if a is not None}))


def read(folder, name):
    return safetensors.load((folder / "codec" / f"{name}.safetensors").read_bytes())


def test_our_own_answers_pass(ours):
    assert not check(ours)
    assert sorted(path.stem for path in (ours / "codec").iterdir()) == sorted([*GOOD, "refusals"])
    assert set(json.loads((ours / "codec" / "refusals.json").read_text(encoding="utf-8"))) == set(
        BAD
    )


def test_they_come_from_the_decoder(tmp_path, monkeypatch):
    """With a decoder that loses a bit of the positions, what it writes fails."""

    def lossy(*given):
        quantised = quantised_of(*given)
        return quantised._replace(positions=quantised.positions ^ 1)

    monkeypatch.setattr(decoded, "quantised_of", lossy)
    write_answers(tmp_path)
    wrong = check(tmp_path)
    assert set(wrong) == set(GOOD)
    assert {r.findings[0].tensor for r in wrong.values()} == {"positions"}


def test_other_types_for_the_same_numbers(folder):
    """Whole numbers of any type, bits as bytes, any order in memory, npz instead of safetensors."""
    for name in ("static", "full", "escapes"):
        arrays = {
            n: a if a.dtype.kind == "f" else a.astype(int) for n, a in read(folder, name).items()
        }
        (folder / "codec" / f"{name}.safetensors").unlink()
        turned = {n: np.asfortranarray(a) for n, a in arrays.items()}
        np.savez(folder / "codec" / f"{name}.npz", **turned)
        assert not check(folder, name)


ARRAYS = [(name, array) for name in ("static", "full", "escapes") for array in streams.BLAMED]


@pytest.mark.parametrize("name, array", few(ARRAYS, 2))
def test_every_array_counts(folder, name, array):
    """The smallest change of one number of any array is found and blamed on what makes it."""
    if array not in read(folder, name):  # static: no motion
        return
    value = read(folder, name)[array]
    wrong, index = value.copy(), tuple(n - 1 for n in value.shape)
    is_float = value.dtype.kind == "f"
    wrong[index] = np.nextafter(value[index], value.dtype.type(9)) if is_float else value[index] ^ 1
    for kind, replaced in {
        "value": wrong,
        "missing": None,
        "shape": value[..., None],
        "dtype": np.ones(value.shape, np.float16),
    }.items():
        change(folder, name, **{array: replaced})
        (result,) = check(folder, name).values()
        (finding,) = result.findings
        assert (result.verdict, finding.tensor, finding.kind) == ("fail", array, kind)
        assert result.equation == streams.BLAMED[array]
        assert kind != "value" or finding.index == index and "1 of" in finding.message
    change(folder, name, **{array: value})
    assert not check(folder, name)


def test_the_sign_of_zero_counts(folder):
    attributes = read(folder, "all_masked")["attributes"].copy()
    index = tuple(np.argwhere(attributes == 0)[0])
    attributes[index] = -attributes[index]
    change(folder, "all_masked", attributes=attributes)
    assert check(folder, "all_masked")["all_masked"].findings[0].index == index


@pytest.mark.parametrize(
    "array, value",
    [("signs", 2), ("masks", 257), ("positions", 65536), ("symbols", 2**32), ("h", -(2**32))],
)
def test_numbers_beyond_their_type_are_not_wrapped(folder, array, value):
    """What would be right after a conversion to the stored type is wrong."""
    wide = read(folder, "full")[array].astype(int)
    change(folder, "full", **{array: wide + value * (wide == wide.flat[0])})
    assert [(f.tensor, f.kind) for f in check(folder, "full")["full"].findings] == [
        (array, "value")
    ]


def test_findings_stand_in_the_order_of_the_data(folder):
    of = read(folder, "full")
    wrong = {"attributes": of["attributes"] + 1, "context_mlps": -of["context_mlps"]}
    change(folder, "full", **wrong, q=None, extra=of["q"])
    result = check(folder, "full")["full"]
    assert [(f.tensor, f.kind) for f in result.findings] == [
        ("context_mlps", "value"),
        ("attributes", "value"),
        ("extra", "extra"),
        ("q", "missing"),
    ]
    assert result.equation == "codec"
    change(folder, "full", context_mlps=of["context_mlps"], q=-of["q"], extra=None)
    assert check(folder, "full")["full"].equation == "step"


def test_what_is_not_there_or_damaged(folder):
    (folder / "codec" / "full.safetensors").unlink()
    (folder / "codec" / "ties.safetensors").write_bytes(b"no tensors")
    wrong = check(folder)
    assert {name: r.verdict for name, r in wrong.items()} == {"full": "missing", "ties": "damaged"}
    assert "codec/full.safetensors" in wrong["full"].explanation
    shutil.rmtree(folder / "codec")
    wrong = check(folder)
    assert {r.verdict for r in wrong.values()} == {"missing"}
    assert [*wrong] == GOOD + BAD


def test_refusals(folder):
    path = folder / "codec" / "refusals.json"
    reasons = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(
        json.dumps({**reasons, "nothing": None, "truncated": 3, "full": "too large"}),
        encoding="utf-8",
    )
    wrong = check(folder, "nothing", "truncated", "full")
    verdicts = {name: (r.verdict, r.explanation) for name, r in wrong.items()}
    assert [verdict for verdict, _ in verdicts.values()] == ["fail", "damaged", "fail"]
    assert "too large" in verdicts["full"][1] and "a file of no bytes" in verdicts["nothing"][1]
    path.write_text(
        json.dumps({name: why for name, why in reasons.items() if name != "no_json"}),
        encoding="utf-8",
    )
    assert {name: r.verdict for name, r in check(folder).items()} == {"no_json": "missing"}
    shutil.copy(folder / "codec" / "full.safetensors", folder / "codec" / "no_json.safetensors")
    assert check(folder, "no_json")["no_json"].verdict == "fail"
    for data in (b"[]", b"{", b"\xff"):
        path.write_bytes(data)
        assert {r.verdict for r in check(folder, "full", "nothing").values()} == {"damaged"}
    path.unlink()
    assert set(check(folder)) == set(BAD)


class Decoder:
    """A port in this process that accepts all, refuses all, or is right."""

    def __init__(self, option):
        self.option = option

    def decode(self, _, data):
        try:
            arrays = decoded.decoded(data)
        except BitstreamError as error:
            return ({}, None) if self.option == "--lenient" else (None, str(error))
        return (None, "never seen this") if self.option == "--strict" else (arrays, None)


@pytest.mark.parametrize("option, failing", [("", []), ("--lenient", BAD), ("--strict", GOOD)])
def test_who_accepts_or_refuses_all_fails(option, failing):
    """Valid and invalid streams are counted apart."""
    report = checker.check_port(Decoder(option), only="codec")
    assert [r.id[6:] for r in report.results if r.verdict == "fail"] == failing
    levels = report.levels().items()
    of = {row: f"{count['passed']} of {count['of']}" for row, count in levels}
    right = {"L3": GOOD, "invalid": BAD}
    assert of == {
        row: f"{0 if names == failing else len(names)} of {len(names)}"
        for row, names in right.items()
    }


def test_a_decoder_that_fails_shows_what_it_has_so_far(folder):
    """The first array that differs comes before those that are missing, and the refusal is said."""
    has = read(folder, "full")
    missing = dict.fromkeys([name for name in has if name not in ("masks", "h")])
    change(folder, "full", **missing, h=has["h"] + 1)
    path = folder / "codec" / "refusals.json"
    reasons = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**reasons, "full": "features: final state"}), encoding="utf-8")
    result = check(folder, "full")["full"]
    assert result.findings[0][:2] == ("h", "value") and result.equation == "hash_grid"
    assert {f.kind for f in result.findings[1:]} == {"missing"}
    lines = str(checker.Report([result])).splitlines()
    at = lines.index("    because: refused a valid stream: features: final state")
    assert lines[at + 1].startswith("    h[0, 0]: got")


@pytest.mark.parametrize("arrays", [{}, {"q": np.ones(2)}])
def test_a_process_may_refuse_with_the_arrays_so_far(monkeypatch, arrays):
    answer = {"refused": "final state"}
    if arrays:
        answer["arrays"] = {name: pack(a) for name, a in arrays.items()}
    monkeypatch.setattr(Adapter, "_ask", lambda *_: answer)
    got, refused = Adapter([sys.executable]).decode("full", b"")
    assert refused == "final state" and got.keys() == arrays.keys()


def test_a_refusal_of_an_unknown_stream_is_named_in_a_line(folder):
    path = folder / "codec" / "refusals.json"
    path.write_text(json.dumps({"nothng": "empty"}), encoding="utf-8")
    with pytest.raises(safetensors.TensorError, match="nothng: did you mean 'nothing'") as error:
        check(folder, "nothing")
    assert "\n" not in str(error.value)


def test_a_picture_shows_what_the_arrays_do_not():
    """Of a decoder whose arrays are right, and whose networks overwrite each other's output."""
    [mistake] = (m for m in MISTAKES if m.subject == "pictures")
    port = Decoder("")
    port.run = lambda case: answers(mistake, case)
    report = checker.check_port(port, ["L3"], ["codec", "pictures"])
    counts = report.levels()
    assert [counts[row]["passed"] for row in ("L3", "invalid")] == [len(GOOD), len(BAD)]
    assert [r.id for r in report.results if r.wrong] == ["pictures/full", "pictures/static"]
    assert mistake.description in report.first.explanation

    def no_renderer(case):
        stream = (streams.STREAMS / f"{case.name}.p4dgs").read_bytes()
        assert case.inputs()["stream"].tobytes() == stream
        raise PortError("skipped", "does not draw")

    port.run = no_renderer
    report = checker.check_port(port, ["L3"], "pictures")
    assert not any(r.wrong for r in report.results)
    assert "pictures: cases left out, which is allowed: 2" in str(report)


@pytest.mark.slow
def test_through_a_process(tmp_path):
    script = tmp_path / "decoder.py"
    root = str(Path(__file__).parents[2])
    script.write_text(DECODER.replace("ROOT", repr(root)), encoding="utf-8")
    with Adapter(shlex.join([sys.executable, str(script)]), timeout=60) as port:
        assert {r.verdict for r in streams.check(port)} == {"pass"}
