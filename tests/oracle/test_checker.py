"""The checker: it fails when it should, names the first wrong equation and reports each case.

Also the commands, and what they export.
"""

import json
import re
import sys

import numpy as np
import pytest

from p4dgs_ref import oracle
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.oracle import checker, published, report, safetensors
from p4dgs_ref.oracle.ports import FolderPort, PortError
from p4dgs_ref.splatting.table import EQUATIONS
from tests.oracle.answers import Port, broken, right, write
from tests.workshop.vectors import damaged


# --- the checker --------------------------------------------------------------------------------
def judge_folder(folder, key, arrays):
    return checker.check_port(FolderPort(write(folder, **{key: arrays})), only=key)


@pytest.mark.parametrize("suffix", ["safetensors", "npz"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_right_port_passes(tmp_path, suffix, dtype):
    if suffix == "npz":
        np.savez(tmp_path / "offsets.npz", **right("offsets", dtype))
    else:
        write(tmp_path, offsets=right("offsets", dtype))
    report = checker.check_port(FolderPort(tmp_path), only="offsets")
    assert (
        report.ok
        and report.first is None
        and report.levels()["L1"]["passed"] == len(report.results)
    )


@pytest.mark.parametrize(
    "change, kind, says",
    [
        (lambda a: a + 1e-9, "value", r"out\.x\[\d, \d, \d\]: got"),
        (lambda a: a[:-1], "shape", "expected"),
        (lambda a: a.astype(int), "dtype", "float64 or float32"),
        (lambda a: a.astype(np.float32) + np.float32(1e-3), "value", "eps S"),
    ],
)
def test_a_wrong_tensor_fails(tmp_path, change, kind, says):
    report = judge_folder(tmp_path, "offsets", broken("offsets", "ordinary/out.x", change))
    assert not report.ok
    assert (report.first.id, report.first.equation) == ("offsets/ordinary", "offsets")
    assert report.first.findings[0].kind == kind
    assert re.search(says, str(report))
    assert sum(r.wrong for r in report.results) == 1, "the other cases are judged all the same"


def test_the_worst_element_is_named(tmp_path):
    def change(a):
        a[1, 2, 0] += 3e-6
        a[0, 1, 1] -= 7e-6
        return a

    arrays = broken("offsets", "ordinary/out.x", change)
    finding = judge_folder(tmp_path, "offsets", arrays).first.findings[0]
    want = right("offsets")["ordinary/out.x"][0, 1, 1]
    assert finding.index == (0, 1, 1) and finding.scaled > finding.bound
    assert finding.got == pytest.approx(want - 7e-6)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("above, is_right", [(2, True), (1, False)])
def test_of_the_gradient_of_a_symmetric_matrix_the_symmetric_part_counts(above, is_right, dtype):
    """A port that reads only the upper triangle of Sigma gives it the whole gradient."""

    def upper(_, got):
        G = got["in_bar.Sigma"]
        return {**got, "in_bar.Sigma": np.triu(G) + (above - 1) * np.triu(G, 1)}

    port = Port(dtype=dtype, change=upper)
    results = checker.check_subject(published.cases("projection"), port)
    wrong = {finding.tensor for r in results if r.wrong for finding in r.findings}
    assert wrong == (set() if is_right else {"in_bar.Sigma"})


def test_missing_extra_and_damaged_answers_are_reported(tmp_path):
    got = right("offsets") | {"ordinary/out.y": np.ones(3)}
    del got["ordinary/in_bar.l_a"]
    report = judge_folder(tmp_path, "offsets", got)
    kinds = {(f.tensor, f.kind) for f in report.first.findings}
    assert kinds == {("in_bar.l_a", "missing"), ("out.y", "extra")}
    for suffix, data, verdict in (
        ("safetensors", b"nonsense", "damaged"),
        ("npz", b"PK nonsense", "damaged"),
        ("txt", b"", "missing"),
    ):
        (folder := tmp_path / suffix).mkdir()
        (folder / f"offsets.{suffix}").write_bytes(data)
        results = checker.check_port(FolderPort(folder), only="offsets").results
        assert all(r.wrong and r.verdict == verdict for r in results)


def test_a_misspelt_case_or_subject_is_refused(tmp_path):
    misspelt = {**right("offsets"), "ordinari/out.x": np.ones(2)}
    with pytest.raises(safetensors.TensorError, match="offsets.safetensors: ordinari.* ordinary,"):
        judge_folder(tmp_path, "offsets", misspelt)
    for wrong, meant in ("ofsets.npz", "offsets"), ("codec/ful.safetensors", "full"):
        folder = tmp_path / meant
        (folder / wrong).parent.mkdir(parents=True)
        (folder / wrong).write_bytes(b"")
        with pytest.raises(safetensors.TensorError, match=f"{wrong}: name: .* {meant},"):
            FolderPort(folder)


def test_two_files_of_a_subject_are_refused_in_a_line(tmp_path):
    write(tmp_path, offsets=right("offsets"))
    (tmp_path / "offsets.npz").touch()
    with pytest.raises(safetensors.TensorError, match="offsets.npz: expected one file, not also"):
        FolderPort(tmp_path)


def test_a_selection_that_chooses_nothing_is_refused_in_a_line(tmp_path):
    for choice, says in (
        (dict(only="ofsets"), "only ofsets: did you mean 'offsets'"),
        (dict(levels=["L9"]), "levels L9: expected one of L0, "),
        (dict(levels="L0", only=["offsets"]), "levels L0, only offsets: no such case"),
    ):
        with pytest.raises(published.SelectionError, match=says):
            oracle.check_port(FolderPort(tmp_path), **choice)
    with pytest.raises(TypeError, match="forward: expected a function, got NoneType"):
        oracle.check(None, "offsets")
    with pytest.raises(KeyError, match="None: expected one of"):
        oracle.check(x_of, None)


# --- the groups that a port may leave out -------------------------------------------------------
def test_a_port_may_leave_out_a_subject_of_a_group_but_not_some_of_its_cases(tmp_path, answered):
    report = checker.check_port(FolderPort(answered), ["L1", "L2"], [*EQUATIONS, "inside"])
    assert "inside: cases left out, which is allowed: 4" in str(report)
    assert {r.verdict for r in report.results if not r.required} == {"missing"}
    got = right("kernel_pixels")
    names = {name.split("/")[0] for name in got}
    report = judge_folder(tmp_path, "kernel_pixels", got)
    assert report.ok and report.levels()["inside"]["passed"] == len(names)
    assert f"inside levels L2, L4    {len(names)} of {len(names)}\n" in str(report)
    some = {n: a for n, a in got.items() if not n.startswith(f"{min(names)}/")}
    report = judge_folder(tmp_path, "kernel_pixels", some)
    assert [r.id for r in report.results if r.wrong] == [f"kernel_pixels/{min(names)}"]


def test_a_process_may_skip_a_subject_of_a_group():
    class Skips:
        def run(self, case):
            raise PortError("skipped", "not written yet")

    results = checker.check_subject(published.cases("kernel_pixels"), Skips())
    assert not any(r.wrong for r in results)
    assert all(r.wrong for r in checker.check_subject(published.cases("view"), Skips()))


def test_the_first_divergence_is_where_data_flows_first(tmp_path):
    for key, name in ("total_loss", "L_total"), ("likelihood", "bits"), ("offsets", "x"):
        write(tmp_path, **{key: broken(key, f"ordinary/out.{name}", lambda a: a + 1)})
        names = ["total_loss", "likelihood", "offsets"]
        report = checker.check_port(FolderPort(tmp_path), ["L1"], names)
        wrong = [r.equation for r in report.results if r.findings]
        assert wrong[0] == key and report.first.equation == key


def test_a_python_function_is_judged():
    eq = EQUATIONS["offsets"]

    def lists(**inputs):  # whatever np.asarray reads
        return {"x": eq(**inputs)["x"].tolist()}

    def backward(inputs, cotangents):
        return eq.vjp(**inputs)[1](**cotangents)

    assert oracle.check(eq, "offsets", backward).ok
    more = oracle.check(eq, "offsets", lambda i, c: backward(i, c) | {"h": np.ones(2)}, strict=True)
    assert more.ok and report.as_json(more)["strict"]
    assert oracle.check(lambda **inputs: eq(**inputs)["x"], "offsets").ok
    assert oracle.check(lists, "offsets").ok
    assert not oracle.check(lambda x_a, O_a, l_a: x_a[:, None] - O_a * l_a[:, None], "offsets").ok
    assert {r.verdict for r in oracle.check(lambda **inputs: 1 / 0, "offsets").results} == {"error"}
    with pytest.raises(KeyError, match="expected one of"):
        oracle.check(lists, "offset")


def x_of(x_a, O_a, l_a):
    return x_a[:, None] + O_a * l_a[:, None]


def writes(x_a, O_a, l_a):
    l_a += 1
    return x_of(x_a, O_a, l_a - 1)


def zeroed(bars):
    bars["x_bar"][...] = 0
    return {}


WRONG_KINDS = {
    "changes its input": (writes, None, "the function changes its argument l_a"),
    "changes a cotangent": (x_of, lambda i, bars: zeroed(bars), "changes its argument x_bar"),
    "masked": (lambda **i: np.ma.array(x_of(**i), mask=True), None, "without masked elements"),
    "float32": (lambda **i: x_of(**i).astype("f4"), None, "out.x: expected float64, in which"),
    "wide": (lambda **i: x_of(**i).astype(np.longdouble), None, "got float128"),
    "two": (lambda **i: (1, 2), None, "expected the outputs x, got 2 of them"),
    "gradients in no dictionary": (x_of, lambda i, bars: 5, "dictionary of gradients, got one int"),
    "ends": (lambda **_: sys.exit("no device"), None, "SystemExit: no device"),
}


@pytest.mark.parametrize("forward, vjp, says", WRONG_KINDS.values(), ids=WRONG_KINDS)
def test_an_answer_of_the_wrong_kind_is_named_in_a_line(forward, vjp, says):
    results = oracle.check(forward, "offsets", vjp).results
    assert all(result.wrong and says in result.explanation for result in results), results[0]


def test_a_list_of_gradients_is_a_list():
    eq = EQUATIONS["deformation"]
    for wrong in x_of, None, 5.0:
        (first, *_) = oracle.check(eq, "deformation", lambda i, b: {"weights": wrong}).results
        assert "weights: expected a list of arrays" in first.explanation


def test_the_precision_is_said_and_a_case_may_be_alone():
    single = oracle.check(x_of, "offsets", dtype="float32")
    assert single.ok and report.as_json(single)["dtype"] == "float32"
    seen = []
    oracle.check(lambda **i: seen.append(i["l_a"].dtype.name), "offsets", dtype="float32")
    assert {*seen} == {"float32"}
    alone = oracle.check(x_of, "offsets/ordinary")
    assert alone.ok and [r.id for r in alone.results] == ["offsets/ordinary"]
    with pytest.raises(KeyError, match="did you mean 'offsets/ordinary'"):
        oracle.check(x_of, "offsets/ordinari")
    with pytest.raises(ValueError, match="dtype float16: expected float64 or float32"):
        oracle.check(x_of, "offsets", dtype="float16")
    not_judged = oracle.check(lambda x_a, x_c: 1 / 0, "view/far", dtype="float32").results
    assert [r.verdict for r in not_judged] == ["not_judged"]


@pytest.mark.parametrize(
    "key, output, id", [("noise", "out.f_noisy", "noise/tiny"), ("tanh", "in_bar.y", "tanh/tails")]
)
def test_precision_is_that_of_the_answers_alone(tmp_path, key, output, id):
    """F32 inputs may be among the answers, which are judged as float64 all the same."""
    rows = [(case.name, n, a) for case in published.cases(key) for n, a in case.tensors.items()]
    rows = [row for row in rows if not row[1].startswith("scale.")]
    arrays = {f"{case}/{n}": a * 3 if n == output else a for case, n, a in rows}
    inputs = {n: a.astype(np.float32) for n, a in arrays.items() if "/in." in n}
    report = judge_folder(tmp_path, key, arrays | inputs)
    assert id in {r.id for r in report.results if r.wrong}
    assert not any(r.verdict == "not_judged" for r in report.results)


def test_a_float32_port_may_leave_out_what_float32_cannot(tmp_path):
    single, double = (
        {n: a for n, a in right("noise", dtype).items() if not n.startswith("tiny/")}
        for dtype in (np.float32, np.float64)
    )
    report = judge_folder(tmp_path, "noise", single)
    assert report.ok and [r.verdict for r in report.results if r.id == "noise/tiny"] == [
        "not_judged"
    ]
    assert judge_folder(tmp_path, "noise", double).first.id == "noise/tiny"


def test_what_was_answered_wrongly_comes_before_what_was_not_answered(tmp_path):
    arrays = broken("rounding", "ties/out.symbols", lambda a: a + 1)
    report = judge_folder(tmp_path, "rounding", arrays)
    # L0 stands before and is missing.
    assert report.results[0].verdict == "missing" and report.first.id == "rounding/ties"
    assert re.search(r"got -?\d+, expected -?\d+", str(report))


# --- commands -----------------------------------------------------------------------------------
def run(capsys, *argv):
    code = cli.run(["oracle", *argv], 0.0)
    return code, *capsys.readouterr()


def test_commands(answered, capsys):
    code, out, _ = run(capsys, "list")
    assert code == 0 and "likelihood/tail" in out and "codec/" in out
    code, out, _ = run(capsys, "check", str(answered), "--only", "offsets")
    assert code == 0 and "every required case passes" in out
    code, out, _ = run(capsys, "check", str(answered), "--only", "tanh", "--json")
    assert code == 1 and json.loads(out)["first_divergence"] == "opacity"


def test_the_vectors_are_no_answer(exported, tmp_path, capsys):
    """Neither the files themselves nor the same tensors in a file of one's own."""
    saved = safetensors.load((published.FOLDER / "view.safetensors").read_bytes())
    again = write(tmp_path, view=saved)
    for folder in (exported[0], again):
        code, out, err = run(capsys, "check", str(folder), "--only", "view")
        assert code == 2 and not out and err.count("\n") == 1 and "the published vectors" in err


@pytest.mark.parametrize(
    "argv, says",
    [
        (["check"], "expected either a folder"),
        (["check", "no such folder"], "expected a folder"),
        (["check", "a", "--adapter", "b"], "expected either a folder"),
        (["check", ".", "--dtype", "float32"], "expected only with --adapter"),
        (["check", ".", "--level", "L0", "--only", "offsets"], "no such case"),
        (["export", "."], "expected an empty folder"),
        (["check", ".", "--only", "ofsets"], "only ofsets: did you mean 'offsets'?"),
        (["check", ".", "--only", "view/fa"], "only view/fa: did you mean 'view/far'?"),
        (["check", ".", "--level", "L5"], "levels L5: expected one of L0, L1, L2, L3, L4"),
    ],
)
def test_mistakes_of_the_user(capsys, argv, says):
    code, out, err = run(capsys, *argv)
    assert code == 2 and not out and err.count("\n") == 1 and says in err


# --- the export ---------------------------------------------------------------------------------
def test_the_export_is_the_published_vectors(exported):
    folder, cases = exported
    assert damaged(folder) == []
    manifest = (folder / "manifest.json").read_bytes()
    assert manifest == (published.FOLDER / "manifest.json").read_bytes()
    subjects, streams = published.subjects().values(), published.stream_rows()
    assert cases == sum(len(row["cases"]) for row in subjects) + len(streams)
    assert {file.name for file in folder.iterdir() if file.is_file()} == {
        file.name for file in published.FOLDER.iterdir() if file.is_file()
    }


def test_half_precision_is_not_judged(tmp_path):
    result = judge_folder(tmp_path, "offsets", right("offsets", np.float16)).results[0]
    assert result.findings[0].message == "float16, expected float64 or float32"
    file = tmp_path / "offsets.safetensors"
    file.write_bytes(file.read_bytes().replace(b'"F16"', b'"B16"'))
    result = checker.check_port(FolderPort(tmp_path), only="offsets").results[0]
    assert result.verdict == "damaged" and "bfloat16 is not judged" in result.explanation
    assert "Half and bfloat16 are not judged" in (published.FOLDER / "README.md").read_text(
        encoding="utf-8"
    )
