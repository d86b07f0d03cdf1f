"""The programs on the page of the vectors run as printed and find damage in vectors."""

import io
import json
import math
import re
import runpy
import shlex
import shutil
import struct
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache

import numpy as np
import pytest

from p4dgs_ref.cli import parser as cli
from p4dgs_ref.oracle import published, safetensors
from p4dgs_ref.oracle.adapter import Adapter
from p4dgs_ref.oracle.checker import check_port
from p4dgs_ref.oracle.ports import FolderPort
from p4dgs_ref.oracle.published import FOLDER, read_manifest
from tests.oracle.answers import places_in, right
from tests.oracle.answers import write as write_answers
from tests.sampling import few

PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
LANGUAGES = {"python": "py", "js": "js", "c": "c", "rust": "rs"}
LAST = 5 * 4 * 3 - 1  # of the outputs of offsets/ordinary


def program(language, section="Readers"):
    """The one program of a language in a section of the page."""
    (text,) = re.findall(
        rf"^```{language}\n(.*?)^```$", SECTIONS[section], re.DOTALL | re.MULTILINE
    )
    return text


def printed(language):
    """The commands that build and run a reader, as on the page; a script has nothing to build."""
    (row,) = re.findall(
        rf"^\| `reader\.{LANGUAGES[language]}` \|(.*)\|(.*)\|$", SECTIONS["Readers"], re.MULTILINE
    )
    return [shlex.split(cell.strip(" `")) for cell in row]


def need(tool):
    if shutil.which(tool) is None:
        pytest.skip(f"no {tool} here")


def in_process(file, *argv, stdin=""):
    """Run a program of the page in this process; return its exit code, stdout and stderr."""
    out, err, code = io.StringIO(), "", 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out):
        patch.setattr(sys, "stdin", io.StringIO(stdin))
        patch.setattr(sys, "argv", [str(file), *argv])
        patch.chdir(file.parent)
        try:
            runpy.run_path(str(file), run_name="__main__")
        except (Exception, SystemExit) as error:
            code, err = 1, str(error)
    return code, out.getvalue(), err


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A function: language -> (folder of its reader, command), built once without a warning."""

    @cache
    def prepared(language):
        place, (build, run) = tmp_path_factory.mktemp(language), printed(language)
        need((build or run)[0])
        (place / f"reader.{LANGUAGES[language]}").write_text(program(language), encoding="utf-8")
        if build:
            done = subprocess.run(
                build, cwd=place, capture_output=True, encoding="utf-8", timeout=120
            )
            assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
        return place, run

    return prepared


@pytest.fixture
def command(built, tmp_path):
    """A function: language -> what its reader says, run as printed beside the folder of `copy`.

    `here` runs the Python reader in this process.
    """

    def ran(language):
        if language == "here":
            (tmp_path / "reader.py").write_text(program("python"), encoding="utf-8")
            return in_process(tmp_path / "reader.py", "vectors")
        place, run = built(language)
        for file in place.iterdir():
            shutil.copy(file, tmp_path)
        done = subprocess.run(run, cwd=tmp_path, capture_output=True, encoding="utf-8", timeout=60)
        return done.returncode, done.stdout, done.stderr

    return ran


@pytest.fixture
def copy(tmp_path):
    """A folder with what the readers need, to be damaged."""
    (folder := tmp_path / "vectors").mkdir()
    for name in ("manifest.json", "offsets.safetensors"):
        shutil.copy(FOLDER / name, folder)
    return folder


def record():
    subject = next(s for s in read_manifest()["subjects"] if s["key"] == "offsets")
    return next(case for case in subject["cases"] if case["id"] == "offsets/ordinary")


def change(folder, name, index, value):
    """Write value(old number, its S) over one number of a tensor."""
    file = folder / "offsets.safetensors"
    data = bytearray(file.read_bytes())
    at, of_scale = (places_in(data)[f"ordinary/{n}"]["offset"] for n in (name, "scale.out.x"))
    (S,) = struct.unpack_from("<f", data, of_scale + 4 * index)
    (old,) = struct.unpack_from("<d", data, at + 8 * index)
    struct.pack_into("<d", data, at + 8 * index, value(old, S))
    file.write_bytes(data)


def bounds(times):
    """A change by so many times what is allowed."""
    return lambda old, S: old + times * record()["tolerance"]["float64"]["eps_S"] * 2.0**-52 * S


DAMAGE = {
    "first": ("out.x", 0, bounds(1.5)),
    "last": ("out.x", LAST, bounds(-1.5)),
    "nan": ("out.x", 7, lambda old, S: math.nan),
    "l_a": ("in.l_a", 0, lambda old, S: math.nan),
}


# In the short lane the Python reader runs in this process; all that start processes are slow.
EVERYWHERE = pytest.mark.parametrize(
    "language", ["here", *(pytest.param(name, marks=pytest.mark.slow) for name in LANGUAGES)]
)


@EVERYWHERE
def test_reader_takes_the_vectors_within_the_tolerance(language, command, copy):
    assert command(language) == (0, "offsets/ordinary: ok\n", "")
    for index in (0, 31, LAST):
        change(copy, "out.x", index, bounds(0.9))
    assert command(language) == (0, "offsets/ordinary: ok\n", "")


@pytest.mark.parametrize("damage", few(DAMAGE, 2))
@EVERYWHERE
def test_reader_refuses_damaged_vectors(language, damage, command, copy):
    change(copy, *DAMAGE[damage])
    code, out, err = command(language)
    assert (code, out) == (1, "") and err.startswith("offsets/ordinary: x")


@pytest.mark.parametrize("damage", ("short", "missing", "no_case"))
@EVERYWHERE
def test_reader_fails_without_what_it_needs(language, damage, command, copy):
    vectors, manifest = copy / "offsets.safetensors", copy / "manifest.json"
    if damage == "short":
        data = vectors.read_bytes()
        vectors.write_bytes(data[: places_in(data)["ordinary/in.x_a"]["offset"] + 9])
    elif damage == "missing":
        vectors.unlink()
    else:
        text = manifest.read_text(encoding="utf-8").replace("ordinary", "usual")
        manifest.write_text(text, encoding="utf-8")
    code, out, _ = command(language)
    assert code in (1, 101) and not out  # 101: how a Rust program ends that panics


def test_readers_need_nothing_else():
    lines = {language: program(language).splitlines() for language in LANGUAGES}
    imports = [line.split()[1] for line in lines["python"] if line.startswith(("import", "from"))]
    assert sorted(imports) == ["json", "struct", "sys"]
    assert [line for line in lines["js"] if "require(" in line] == ['const fs = require("fs");']
    assert all(len(body) <= 60 for body in lines.values())


def test_page_says_what_the_files_have():
    """Every field of the manifest is on the page, and every file of the folder."""
    manifest = read_manifest()
    cases = [case for subject in manifest["subjects"] for case in subject["cases"]]
    streams = published.read_rows()
    rows = [manifest, *manifest["subjects"], streams, *streams["good"], *streams["bad"], *cases]
    rows += [case["tolerance"] for case in cases]
    rows += [of for case in cases for of in case["tolerance"].values() if isinstance(of, dict)]
    keys = {key for row in rows for key in row}
    assert not sorted(key for key in keys if not re.search(rf"[`\"]{key}[`\"]", PAGE))
    assert f'"{manifest["version"]}"' in PAGE
    for words in ("result", "provenance"):
        assert {case[words] for case in cases} <= set(re.findall(r"`([a-z -]+)`", PAGE))
    tensors = [t for f in FOLDER.glob("*.safetensors") for t in places_in(f.read_bytes()).values()]
    assert {t["dtype"] for t in tensors} <= set(re.findall(r"`([A-Z0-9]+)`", PAGE))
    files = {
        file.name for file in FOLDER.iterdir() if file.suffix != ".safetensors" and file.is_file()
    }
    assert not sorted(name for name in files - {"README.md"} if name not in PAGE)
    assert re.findall(r"^(\d)\. \*\*", PAGE, re.MULTILINE) == list("123456")


@pytest.mark.parametrize("dtype", few(("float64", "float32"), 1))
def test_the_example_is_right_in_what_it_does(dtype):
    """Its two equations pass, everything else is reported as skipped."""
    command = shlex.join([sys.executable, str(FOLDER / "example_adapter.py")])
    with Adapter(command, dtype=dtype) as port:
        for key in ("offsets", "noise"):
            report = check_port(port, ["L1"], key)
            assert report.ok and len(report.results) >= 4
            assert {r.verdict for r in report.results} <= {"pass", "not_judged"}
        report = check_port(port, ["L1"], "view")
        reasons = {(r.verdict, r.explanation) for r in report.results if r.verdict != "not_judged"}
        assert not report.ok and reasons == {("skipped", "not written yet")}


# --- answers ------------------------------------------------------------------------------------
TYPES = {"F64": np.float64, "F32": np.float32, "I64": np.int64, "BOOL": bool}


# The Python writer runs in this process.
WRITERS = pytest.mark.parametrize(
    "language", ["python", pytest.param("js", marks=pytest.mark.slow)]
)
CALLS = {
    "python": "import sys\nwrite(sys.argv[1], json.load(sys.stdin))\n",
    "js": 'write(process.argv[2], JSON.parse(fs.readFileSync(0, "utf8")));\n',
}


def write(language, path, tensors):
    """Let a writer of the page write {name: array} as a type: {name: [dtype, shape, flat list]}."""
    script = path.parent / f"writer.{LANGUAGES[language]}"
    script.write_text(program(language, "Writers") + CALLS[language], encoding="utf-8")
    rows = {n: [dtype, list(a.shape), a.ravel().tolist()] for n, (dtype, a) in tensors.items()}
    if language == "python":
        assert in_process(script, str(path), stdin=json.dumps(rows)) == (0, "", "")
    else:
        need("node")
        command = ["node", str(script), str(path)]
        subprocess.run(command, input=json.dumps(rows), encoding="utf-8", check=True, timeout=60)


def answers(key, port):
    """The answers {"ordinary/out.x": array} of a port {"in.x_a": array} -> {"out.x": array}."""
    cases = published.cases(key)
    return {f"{case.name}/{name}": a for case in cases for name, a in port(case.tensors).items()}


def offsets(at):
    x_a, O_a, l_a, x_bar = (at[name] for name in ("in.x_a", "in.O_a", "in.l_a", "out_bar.x"))
    return {
        "out.x": x_a[:, None] + O_a * l_a[:, None],
        "in_bar.x_a": x_bar.sum(1),
        "in_bar.O_a": x_bar * l_a[:, None],
        "in_bar.l_a": (x_bar * O_a).sum(1),
    }


@pytest.mark.parametrize("dtype", ("F64", "F32"))
@WRITERS
def test_answers_that_a_writer_wrote_pass(language, dtype, tmp_path, capsys):
    file, right = tmp_path / "offsets.safetensors", answers("offsets", offsets)
    write(language, file, {name: (dtype, a) for name, a in right.items()})
    assert cli.run(["oracle", "check", str(tmp_path), "--only", "offsets"], 0.0) == 0
    assert "4 of 4" in capsys.readouterr().out
    wrong = right | {"ordinary/in_bar.l_a": 1.001 * right["ordinary/in_bar.l_a"]}
    write(language, file, {name: (dtype, a) for name, a in wrong.items()})
    first = check_port(FolderPort(tmp_path), only=["offsets"]).first
    assert (first.id, [f.tensor for f in first.findings]) == ("offsets/ordinary", ["in_bar.l_a"])


@WRITERS
def test_a_writer_writes_every_type(language, tmp_path):
    """Also integers beyond 32 bits, a scalar, and an axis of length zero."""
    given = {
        "a/out.x": ("F64", np.array([[0.1, -2e-300, 3.0]])),
        "a/out.none": ("F32", np.zeros((0, 4))),
        "a/out.i": ("I64", np.array([-1, 2**40])),
        "b/out.mask": ("BOOL", np.array([[True], [False], [True]])),
        "b/out.s": ("F32", np.array(0.1)),
    }
    write(language, tmp_path / "all.safetensors", given)
    data = (tmp_path / "all.safetensors").read_bytes()
    arrays = safetensors.load(data)
    assert list(arrays) == list(given) and struct.unpack_from("<Q", data)[0] % 8 == 0
    for name, (dtype, a) in given.items():
        assert arrays[name].dtype == TYPES[dtype] and np.array_equal(
            arrays[name], a.astype(TYPES[dtype])
        ), name


@pytest.mark.slow
def test_printed_commands_run(tmp_path, monkeypatch, capsys):
    need("python3")  # runs the example adapter
    (block,) = re.findall(
        r"^```sh\np4dgs-ref (.*?)^```$", SECTIONS["Commands"], re.DOTALL | re.MULTILINE
    )
    export, whole, *others = (
        shlex.split(line, comments=True) for line in block.split("\np4dgs-ref ")
    )
    monkeypatch.chdir(tmp_path)
    assert [cli.run(export, 0.0) for _ in range(2)] == [
        0,
        0,
    ]  # into nothing, then into the earlier export
    (answered := tmp_path / whole[2]).mkdir()
    assert cli.run(whole, 0.0) == 1  # nothing is there: everything is missing
    assert cli.run([*export[:2], str(tmp_path)], 0.0) == 2  # neither empty nor an export
    write_answers(answered, **{key: right(key) for key in published.subjects()})
    judged = []
    for line in others:
        capsys.readouterr()
        assert cli.run([*line, "--json"], 0.0) == 0, line
        cases = json.loads(capsys.readouterr().out)["cases"]
        by = "level" if line.count("--level") == 2 else "id"
        judged.append({case[by].split("/")[0] for case in cases})
    assert judged == [
        {"L0", "L1"},
        {"step", "step_floor", "prior", "sigma_clamp"},
        {"step"},
        {s["key"] for s in read_manifest()["subjects"] if s["level"] == "L2"},
        {"trace_steps", "training_steps", "kernel_pixels"},
        {"pictures"},
        {"offsets"},
    ]


def test_requests_are_spaced_as_the_page_says(tmp_path):
    """One line each, as json.dumps writes it, keys in the printed order."""
    port, heard = tmp_path / "port.py", tmp_path / "heard"
    port.write_text(
        f"""import json, sys
for line in sys.stdin:
    open({str(heard)!r}, "a").write(line)
    request = json.loads(line)
    starts = "p4dgs_oracle" in request
    reply = dict(p4dgs_oracle=1) if starts else dict(id=request["id"], skip="")
    print(json.dumps(reply), flush=True)
""",
        encoding="utf-8",
    )
    with Adapter(shlex.join([sys.executable, str(port)])) as adapter:
        check_port(adapter, only=["offsets", "codec"])
    lines = heard.read_text(encoding="utf-8").splitlines()
    assert lines[0] in PAGE and all(json.dumps(json.loads(line)) == line for line in lines)
    assert {tuple(json.loads(line)) for line in lines[1:]} == {
        ("id", "subject", "equation", "settings", "differentiable", "in", "out_bar"),
        ("id", "stream"),
    }
