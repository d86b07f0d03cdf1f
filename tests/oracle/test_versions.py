"""The versions of the vectors: what joined, what an earlier version still is, and what is said."""

import json

import numpy as np
import pytest

from p4dgs_ref.__main__ import main
from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle.ports import FolderPort
from tests.oracle.answers import right, write

FIRST, LAST = published.VERSIONS[0], published.VERSIONS[-1]


def ids(version):
    """The ids of all cases of a version."""
    subjects = published.read_manifest(version=version)["subjects"]
    return {case["id"] for subject in subjects for case in subject["cases"]}


def checked(folder, version):
    levels = ("L0", "L1", "L2", "L4")  # no streams
    return checker.check_port(FolderPort(folder), levels, version=version)


@pytest.mark.slow
def test_answers_to_the_first_version_lack_only_what_joined_since(tmp_path):
    """A folder that a port of version 1.0 wrote, with all equations right."""
    first = ids(FIRST)
    for subject in published.read_manifest(version=FIRST)["subjects"]:
        key = subject["key"]
        arrays = right(key).items()
        write(tmp_path, **{key: {n: a for n, a in arrays if f"{key}/{n.split('/')[0]}" in first}})
    report = checked(tmp_path, FIRST)
    assert report.ok and {r.id for r in report.results} == first
    report = checked(tmp_path, LAST)
    levels = [s for s in published.read_manifest()["subjects"] if s["level"] != "L3"]
    asked = {case["id"] for subject in levels for case in subject["cases"]}
    missing = {r.id for r in report.results if r.verdict == "missing"}
    assert {r.id for r in report.results} == asked and missing == asked - first and not report.ok
    assert all(r.verdict == "pass" for r in report.results if r.id not in missing)


def test_the_first_version_is_exported_as_it_was(exported):
    folder, done = exported
    manifest = published.read_manifest(folder)
    assert manifest["version"] == "v1.0"
    assert done["cases"] == len(ids(FIRST)) + len(manifest["streams"])
    assert "since" not in json.dumps(manifest)
    names = {file.name for file in folder.glob("*.safetensors")}
    assert names == set(manifest["files"]) and "kernel.safetensors" not in names
    for subject in manifest["subjects"]:
        assert published.read(subject, folder)


def test_commands_know_both_versions(capsys):
    counts = {}
    for version in published.VERSIONS:
        assert main(["oracle", "list", "--vectors", version]) == 0
        counts[version] = len(capsys.readouterr().out.splitlines())
    assert counts[FIRST] < counts[LAST]
    with pytest.raises(SystemExit) as exit:
        main(["oracle", "list", "--vectors", "2.0"])
    assert exit.value.code == 2


def test_half_precision_is_told_why_it_is_not_judged(tmp_path):
    result = judged(write(tmp_path, offsets=right("offsets", np.float16)))
    assert result.verdict == "fail" and "half precision is not judged" in result.findings[0].message
    file = tmp_path / "offsets.safetensors"
    file.write_bytes(file.read_bytes().replace(b'"F16"', b'"B16"'))
    result = judged(tmp_path)
    assert result.verdict == "damaged" and "bfloat16 is not judged" in result.explanation
    page = (published.FOLDER / "README.md").read_text(encoding="utf-8")
    assert "Half and bfloat16 are not judged" in page and "compiling just in time" in page


def judged(folder):
    return checker.check_port(FolderPort(folder), only="offsets").results[0]
