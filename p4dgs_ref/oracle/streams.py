"""Level L3: the conformance streams of the codec as cases of the oracle.

A port decodes `streams/<name>.p4dgs` and gives every array of the good streams, bit for bit, and a reason for every bad
one.  As files: `codec/<name>.safetensors` (or .npz), the arrays by their names, and `codec/refusals.json`, {name: "why"}
(null for a stream that was not refused).  Whole numbers may have any integer type, masks and signs may be BOOL; q, x_a
and attributes are F64, the numbers of the networks F32.
"""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np

from ..codec import published
from ..codec.container import BitstreamError, open_container
from ..codec.file import quantised_of
from . import safetensors
from .compare import Finding, Result
from .ports import FolderPort, PortError

# In the order in which a decoder finds them: who is to blame where this array is the first that is wrong.
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


def read_rows():
    """The manifest of the conformance streams: {"good": [...], "bad": [...]}."""
    return json.loads((published.FOLDER / "manifest.json").read_text(encoding="utf-8"))


def records():
    """The streams as the manifest of the vectors lists them."""

    def record(row, result, **more):
        return {
            "id": f"codec/{row['name']}",
            "name": row["name"],
            "says": row["says"],
            "result": result,
            "file": f"streams/{row['file']}",
            "bytes": row["bytes"],
            "sha256": row["sha256"],
            **more,
        }

    rows = read_rows()
    return [
        record(row, "valid", expected=f"streams/{row['expected']}", arrays=row["arrays"])
        for row in rows["good"]
    ] + [
        record(row, "invalid", **{key: row[key] for key in ("section", "offset", "kind")})
        for row in rows["bad"]
    ]


def copy(folder):
    """Put the streams and their arrays into `folder`/streams, where the manifest says they are."""
    shutil.copytree(published.FOLDER, Path(folder) / "streams", dirs_exist_ok=True)


def write_expected(folder):
    """Decode every stream and write into `folder`/codec what came out, as a port would."""
    place, refusals, rows = Path(folder) / "codec", {}, read_rows()
    place.mkdir(parents=True, exist_ok=True)
    for row in rows["good"] + rows["bad"]:
        try:
            arrays = decoded((published.FOLDER / row["file"]).read_bytes())
        except BitstreamError as error:
            refusals[row["name"]] = str(error)
        else:
            (place / f"{row['name']}.safetensors").write_bytes(safetensors.dump(arrays)[0])
    (place / "refusals.json").write_text(json.dumps(refusals, indent=1), encoding="utf-8")


def decoded(data):
    """Every array that the conformance streams name, of any file: {name: array}.

    Raises     BitstreamError
    """
    found = published.expected(quantised_of(open_container(data)))
    return {
        name: np.asarray(a).astype(bool if kind == "bit" else published.TYPES[kind])
        for name, (kind, a) in found.items()
    }


def check(port):
    """Verdicts on every stream: of a port that decodes, or of the files that one wrote into its `folder`."""
    decode, rows = (
        port.decode if hasattr(port, "decode") else StreamFolder(port.folder).decode,
        read_rows(),
    )
    return [
        judge(row, good, decode)
        for key, good in (("good", True), ("bad", False))
        for row in rows[key]
    ]


def judge(row, good, decode):
    """The verdict on one stream."""
    findings, said, verdict = [], "", None
    try:
        arrays, refused = decode(row["name"], (published.FOLDER / row["file"]).read_bytes())
    except PortError as error:
        verdict, said = error.kind, str(error)
    else:
        if not good:
            said = "" if refused is not None else f"taken, but it must be refused: {row['says']}"
        elif refused is not None:
            said = f"refused, but it is sound: {refused}"
        else:
            findings = compare(row, arrays)
    blamed = BLAMED.get(findings[0].tensor, "codec") if findings else "codec"
    return Result(
        f"codec/{row['name']}",
        blamed,
        "L3",
        verdict or ("fail" if findings or said else "pass"),
        True,
        tuple(findings),
        said,
    )


class StreamFolder(FolderPort):
    """What a port wrote into its folder `codec`."""

    def decode(self, name, _):
        """What the port found in a stream, as `Adapter.decode`: (arrays, None), or (None, why it refuses it).

        Raises     PortError
        """
        reasons, path = self._reasons()
        if name in reasons and not isinstance(reasons[name], str | None):
            raise PortError("damaged", f"{path}: {name}: expected the reason as a text, or null")
        if reasons.get(name) is not None:
            return None, reasons[name]
        try:
            return self._load(f"codec/{name}")[0], None
        except PortError as error:
            if error.kind == "missing" and name in reasons:  # null, and no arrays that anyone needs
                return {}, None
            raise PortError(error.kind, f"{error}, or why it is refused in {path}") from None

    def _reasons(self):
        path = self.folder / "codec" / "refusals.json"
        if "refusals" not in self.loaded:
            try:
                self.loaded["refusals"] = json.loads(path.read_text(encoding="utf-8"))
            except FileNotFoundError:
                self.loaded["refusals"] = {}
            except (OSError, ValueError, RecursionError):
                self.loaded["refusals"] = None
        if not isinstance(self.loaded["refusals"], dict):
            raise PortError(
                "damaged",
                f"{path}: expected a JSON object {{name of a stream: why it is refused, or null}}",
            )
        return self.loaded["refusals"], path


def compare(row, arrays):
    """Every way in which a port's arrays differ from those of a good stream, in the order in which data flow."""
    wanted = {entry["name"]: entry for entry in row["arrays"]}
    findings = [
        Finding(name, "missing", f"expected {wanted[name]['type']} {tuple(wanted[name]['shape'])}")
        if name not in arrays
        else _difference(row, wanted[name], np.asarray(arrays[name]))
        for name in BLAMED
        if name in wanted
    ]
    findings += [
        Finding(name, "extra", "not expected of this stream")
        for name in arrays
        if name not in wanted
    ]
    return [finding for finding in findings if finding]


def _difference(row, entry, mine):
    """A Finding, or None where the array's bytes are those of the stream's checksum."""
    name, kind, shape = entry["name"], entry["type"], tuple(entry["shape"])
    if mine.shape != shape:
        return Finding(name, "shape", f"{mine.shape}, expected {shape}")
    dtype = np.dtype("u1" if kind == "bit" else published.TYPES[kind])
    if (
        mine.dtype.kind not in "iub"
        if dtype.kind in "iu"
        else mine.dtype.newbyteorder("<") != dtype
    ):
        return Finding(
            name, "dtype", f"{mine.dtype}, expected {'integers' if dtype.kind in 'iu' else dtype}"
        )
    narrow = mine.astype(dtype)
    data = np.packbits(narrow, bitorder="little").tobytes() if kind == "bit" else narrow.tobytes()
    exact = (
        dtype.kind == "f"
        or np.array_equal(narrow, mine)
        and (kind != "bit" or mine.size == 0 or narrow.max() <= 1)
    )
    if exact and hashlib.sha256(data).hexdigest() == entry["sha256"]:
        return None
    want = stored(row, entry)
    wrong = (
        narrow.view(f"u{dtype.itemsize}") != want.view(f"u{dtype.itemsize}")
        if dtype.kind == "f"
        else mine != want
    )
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    got, right = (np.asarray(a)[index].item() for a in (mine, want))
    return Finding(
        name,
        "value",
        f"{name}{list(index)}: got {got!r}, expected {right!r} ({int(wrong.sum())} of {wrong.size} "
        f"numbers off; all bits count)",
        index,
        float(got),
        float(right),
    )


def stored(row, entry):
    """An array of a good stream, as its file of expected numbers holds it."""
    count, kind, at = int(np.prod(entry["shape"])), entry["type"], entry["offset"]
    body = (published.FOLDER / row["expected"]).read_bytes()
    if kind == "bit":
        return np.unpackbits(np.frombuffer(body, np.uint8, -(-count // 8), at), bitorder="little")[
            :count
        ].reshape(entry["shape"])
    return np.frombuffer(body, published.TYPES[kind], count, at).reshape(entry["shape"])
