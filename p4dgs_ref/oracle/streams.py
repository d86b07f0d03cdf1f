"""Level L3: the conformance streams of the codec as cases of the oracle.

A port decodes `streams/<name>.p4dgs` and gives every array of the good streams, bit for bit, and a
reason for each stream that it refuses. In files, these are `codec/<name>.safetensors` (or .npz)
with the arrays by their names, and `codec/refusals.json` with {name: reason}; the reason is null
for a stream that was not refused. A decoder that fails may give the arrays that it has so far.
Integers may have any integer type, and masks and signs may be BOOL; q, x_a and attributes are F64,
and the numbers of the networks F32.

The README of the vectors describes the arrays and the kinds of errors. `export` copies streams and
vectors into a folder, for ports that read files.
"""

import shutil
from pathlib import Path

import numpy as np

from ..output import OutputError, staged_folder
from .compare import Result, differences
from .ports import PortError
from .published import FOLDER, STREAMS, read_rows, stream_rows, subjects

TYPES = {"u8": "u1", "u16": "<u2", "i32": "<i4", "i64": "<i8", "f32": "<f4", "f64": "<f8"}
# The arrays in the order in which a decoder finds them, each with the equation (or the codec) to
# blame if this array is the first wrong one.
BLAMED = {
    "positions": "codec",
    "x_a": "codec",
    "masks": "codec",
    "signs": "codec",
    "anchor_mlps": "codec",
    "context_mlps": "codec",
    "deformation_mlp": "codec",
    "h": "hash_grid",
    "q_units": "step",
    "q": "step",
    "mu_units": "prior",
    "sigma_units": "prior",
    "symbols": "codec",
    "attributes": "rounding",
}


def check(port, names=None):
    """Return the results of all streams, or of those named, from a port or a folder of answers."""
    rows = read_rows()
    return [
        judge(row, kind == "good", port.decode)
        for kind in ("good", "bad")
        for row in rows[kind]
        if names is None or row["name"] in names
    ]


def judge(row, good, decode):
    """Return the Result of one stream."""
    findings, explanation = [], ""
    group = "" if good else "invalid"
    result = Result(f"codec/{row['name']}", "codec", "L3", "pass", required=True, group=group)
    try:
        arrays, refused = decode(row["name"], (STREAMS / row["file"]).read_bytes())
    except PortError as error:
        required = error.kind != "absent"
        return result._replace(verdict=error.kind, required=required, explanation=str(error))
    if good and refused is not None:
        explanation = f"refused a valid stream: {refused}"
    elif not good and refused is None:
        explanation = f"accepted a stream that must be refused: {row['says']}"
    if good and (arrays or refused is None):
        entries = {entry["name"]: entry for entry in row["arrays"]}
        want = {name: read_expected(row, entries[name]) for name in BLAMED if name in entries}
        # A decoder that stops half-way lacks arrays; those that it has say where it goes wrong.
        findings = sorted(differences(want, arrays), key=lambda f: f.kind == "missing")
    if not findings and not explanation:
        return result
    blamed = BLAMED.get(findings[0].tensor, "codec") if findings else "codec"
    return result._replace(
        equation=blamed, verdict="fail", findings=tuple(findings), explanation=explanation
    )


def read_expected(row, entry):
    """Return an array of a good stream from its file of expected numbers."""
    shape, kind, at = entry["shape"], entry["type"], entry["offset"]
    count = int(np.prod(shape))
    body = (STREAMS / row["expected"]).read_bytes()
    if kind == "bit":
        bits = np.unpackbits(np.frombuffer(body, np.uint8, -(-count // 8), at), bitorder="little")
        return bits[:count].reshape(shape)
    return np.frombuffer(body, TYPES[kind], count, at).reshape(shape)


def export(folder):
    """Copy the published vectors into a folder; return the number of its cases.

    Raises OutputError if the folder contains other things, because files could be overwritten.
    """
    place = Path(folder)
    with staged_folder(place) as staging:
        if any(place.glob("[!.]*")) and not (place / "manifest.json").is_file():
            raise OutputError(
                f"{folder}: expected an empty folder, or an earlier export with its manifest.json"
            )
        for file in filter(Path.is_file, FOLDER.iterdir()):
            shutil.copyfile(file, staging / file.name)
        shutil.copytree(STREAMS, staging / "streams")
    return sum(len(row["cases"]) for row in subjects().values()) + len(stream_rows())
