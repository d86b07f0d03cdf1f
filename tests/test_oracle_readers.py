"""The readers on the page of the vectors run as they are printed, and find what is wrong with damaged vectors."""
import json
import math
import re
import shlex
import shutil
import struct
import subprocess
import sys
from functools import cache

import pytest

from p4dgs_ref.oracle.adapter import Adapter
from p4dgs_ref.oracle.checker import check_port
from p4dgs_ref.oracle.vectors import FOLDER

PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")
LANGUAGES = {"python": ("py", None), "js": ("js", "node"), "c": ("c", "cc gcc clang"), "rust": ("rs", "rustc")}
LAST = 5 * 4 * 3 - 1                               # of the outputs of offsets/ordinary


def program(language):
    """The one program of a language on the page."""
    found, = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    return found


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """A function: language -> the command that runs its reader, compiled once."""
    place = tmp_path_factory.mktemp("readers")

    @cache
    def prepared(language):
        ending, tools = LANGUAGES[language]
        tool = sys.executable if tools is None else next(filter(None, map(shutil.which, tools.split())), None)
        if tool is None:
            pytest.skip(f"no {tools.replace(' ', ' or ')} here")
        source, binary = place / f"reader.{ending}", str(place / f"reader_{ending}")
        source.write_text(program(language), encoding="utf-8")
        if language == "c":
            build = [tool, "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", str(source), "-o", binary, "-lm"]
        elif language == "rust":
            build = [tool, "--edition", "2021", "-D", "warnings", "-o", binary, str(source)]
        else:
            return [tool, *(["-I"] if language == "python" else []), str(source)]
        subprocess.run(build, check=True, capture_output=True, text=True, timeout=120)
        return [binary]

    return prepared


@pytest.fixture
def copy(tmp_path):
    """A folder with what the readers need, to be damaged."""
    for name in ("manifest.json", "offsets.safetensors"):
        shutil.copy(FOLDER / name, tmp_path)
    return tmp_path


def record():
    manifest = json.loads((FOLDER / "manifest.json").read_text(encoding="utf-8"))
    subject = next(s for s in manifest["subjects"] if s["key"] == "offsets")
    return next(case for case in subject["cases"] if case["id"] == "offsets/ordinary")


def change(folder, name, index, value):
    """Write value(old number, its S) over one number of a tensor."""
    case, file = record(), folder / "offsets.safetensors"
    places, data = {t["name"]: t["offset"] for t in case["tensors"]}, bytearray(file.read_bytes())
    S, = struct.unpack_from("<f", data, places["scale.out.x"] + 4 * index)
    old, = struct.unpack_from("<d", data, places[name] + 8 * index)
    struct.pack_into("<d", data, places[name] + 8 * index, value(old, S))
    file.write_bytes(data)


def bounds(times):
    """A change by so many times what is allowed."""
    return lambda old, S: old + times * record()["tolerance"]["float64"]["eps_S"] * 2.0**-52 * S


DAMAGE = {"first": ("out.x", 0, bounds(1.5)), "last": ("out.x", LAST, bounds(-1.5)), "middle": ("out.x", 31, bounds(4)),
          "nan": ("out.x", 7, lambda old, S: math.nan), "infinity": ("out.x", 8, lambda old, S: math.inf),
          "sign": ("out.x", 20, lambda old, S: -old), "x_a": ("in.x_a", 14, lambda old, S: old * (1 + 1e-6)),
          "O_a": ("in.O_a", 30, lambda old, S: old * (1 + 1e-6)), "l_a": ("in.l_a", 0, lambda old, S: math.nan)}


@pytest.mark.parametrize("language", LANGUAGES)
def test_reader_takes_the_vectors(language, command):
    done = subprocess.run([*command(language), str(FOLDER)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "offsets/ordinary: ok\n", "")


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("language", LANGUAGES)
def test_reader_refuses_damaged_vectors(language, damage, command, copy):
    change(copy, *DAMAGE[damage])
    done = subprocess.run([*command(language), str(copy)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "") and done.stderr.startswith("offsets/ordinary: x")


@pytest.mark.parametrize("language", LANGUAGES)
def test_reader_keeps_to_the_tolerance(language, command, copy):
    for index in (0, 31, LAST):
        change(copy, "out.x", index, bounds(0.9))
    done = subprocess.run([*command(language), str(copy)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "offsets/ordinary: ok\n")


@pytest.mark.parametrize("damage", ("short", "missing", "no_case"))
@pytest.mark.parametrize("language", LANGUAGES)
def test_reader_fails_without_what_it_needs(language, damage, command, copy):
    vectors, manifest = copy / "offsets.safetensors", copy / "manifest.json"
    if damage == "short":
        vectors.write_bytes(vectors.read_bytes()[:record()["tensors"][0]["offset"] + 9])
    elif damage == "missing":
        vectors.unlink()
    else:
        manifest.write_text(manifest.read_text(encoding="utf-8").replace("ordinary", "usual"), encoding="utf-8")
    done = subprocess.run([*command(language), str(copy)], capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, 101) and not done.stdout          # 101: how a Rust program ends that panics


def test_readers_need_nothing_else():
    lines = {language: program(language).splitlines() for language in LANGUAGES}
    imports = [line.split()[1] for line in lines["python"] if line.startswith(("import", "from"))]
    assert sorted(imports) == ["json", "struct", "sys"]
    assert [line for line in lines["js"] if "require(" in line] == ['const fs = require("fs");']
    assert all(len(body) <= 60 for body in lines.values())


def test_page_says_what_the_files_have():
    """Every field of the manifest is on the page, and every file of the folder."""
    manifest = json.loads((FOLDER / "manifest.json").read_text(encoding="utf-8"))
    cases = [case for subject in manifest["subjects"] for case in subject["cases"]]
    keys = {*manifest, *(key for row in manifest["subjects"] + manifest["streams"] + cases for key in row)}
    keys |= {key for case in cases for bounds in case["tolerance"].values() if isinstance(bounds, dict) for key in bounds}
    keys |= {key for case in cases for key in (*case["tensors"][0], *case["tolerance"])}
    assert not sorted(key for key in keys if not re.search(rf"[`\"]{key}[`\"]", PAGE))
    for words in ("result", "provenance"):
        assert {case[words] for case in cases} <= set(re.findall(r"`([a-z -]+)`", PAGE))
    dtypes = {t["dtype"] for case in cases for t in case["tensors"]}
    assert dtypes <= set(re.findall(r"`([A-Z0-9]+)`", PAGE))
    files = {file.name for file in FOLDER.iterdir() if file.suffix != ".safetensors" and file.is_file()}
    assert not sorted(name for name in files - {"README.md"} if name not in PAGE)
    assert re.findall(r"^(\d)\. \*\*", PAGE, re.MULTILINE) == list("123456")


@pytest.mark.parametrize("dtype", ("float64", "float32"))
def test_the_example_is_right_in_what_it_does(dtype):
    """Its two equations pass, everything else is reported as skipped."""
    with Adapter(shlex.join([sys.executable, str(FOLDER / "example_adapter.py")]), dtype=dtype) as port:
        for key in ("offsets", "noise"):
            report = check_port(port, ["L1"], key)
            assert report.ok and len(report.results) >= 4 and {r.verdict for r in report.results} <= {"pass", "unasked"}
        report = check_port(port, ["L1"], "view")
        said = {(r.verdict, r.explanation) for r in report.results if r.verdict != "unasked"}
        assert not report.ok and said == {("skipped", "not written yet")}
