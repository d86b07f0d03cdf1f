"""Makes the vectors: every case of every subject with inputs, outputs, cotangents and gradients.

`python -m tests.golden.vectors` adds the cases that are not published yet to the published vectors,
and leaves all others as they are. `python -m tests.golden.vectors DIR` computes all of them again
into a folder and puts the codec's streams beside them, as `p4dgs-ref oracle export DIR` does with
the published ones.
"""

import hashlib
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import scipy

from p4dgs_ref import __version__
from p4dgs_ref.oracle import published, safetensors, streams, tolerance
from p4dgs_ref.oracle.export import copy_streams, write_expected
from p4dgs_ref.oracle.published import FOLDER, flatten, read_manifest
from p4dgs_ref.scenes.output import filled
from tests.golden import independent, measured
from tests.golden.cases import FLAGS
from tests.golden.subjects import subjects

# Everything else in the folder of the vectors is made here.
WRITTEN = ("README.md", "LICENSE", "example_adapter.py", "model.p4dgs")
# Cases in which another answer is defensible: they are reported, but not required.
ACCEPTABLE = {
    "frames/paper_settings": (
        "the published kernel's rule: tiles of three sigma, mask at 1/255, stop before the splat"
    ),
}


def vector(subject, case):
    """Return the record of one case for the manifest, without places, and its tensors."""
    id = f"{subject.key}/{case.name}"
    cotangents = tolerance.cotangents_of(subject, subject(**case.inputs), id, case.cotangents)
    flat = subject.answer(case.inputs, cotangents)
    scale = tolerance.scales(subject.answer, case.inputs, cotangents, flat, case.name)
    better, provenance, by_reference = independent.values(subject, case, cotangents, flat)
    error = measured.float32_error(subject.answer, case.inputs, cotangents, flat, scale)
    flat.update(better)
    bars = {name.removesuffix("_bar"): a for name, a in cotangents.items()}
    tensors = {
        **flatten(case.inputs, "in."),
        **flatten(bars, "out_bar."),
        **flat,
        **{f"scale.{name}": a for name, a in scale.items()},
    }
    record = {"id": id, "name": case.name, "tests": says(case), "flags": list(case.flags)}
    record["result"] = "acceptable" if id in ACCEPTABLE else "valid"
    if id in ACCEPTABLE:
        record["why"] = ACCEPTABLE[id]
    record["provenance"] = provenance
    if by_reference:
        record["reference"] = by_reference
    record["settings"] = settings(case.inputs)
    record["tolerance"] = measured.tolerances(error, flat)
    return record, {name: np.ascontiguousarray(a).reshape(a.shape) for name, a in tensors.items()}


def settings(inputs):
    """Return the inputs that are no tensors: Python's numbers, strings and tuples."""
    tensors = (list, np.ndarray, np.generic)
    return {name: value for name, value in inputs.items() if not isinstance(value, tensors)}


def says(case):
    """Return a sentence on what a case tests."""
    hunted = "; ".join(FLAGS[flag].split(": ", 1)[1] for flag in case.flags)
    return f"{case.name.replace('_', ' ')}; hunts {hunted}"


def subject_file(subject, kept):
    """Return the bytes of a subject's file and its record for the manifest.

    `kept` are cases {name: Golden} that are published and not computed again.
    """
    records, tensors, names = [], {}, []
    for case in subject.cases():
        if case.name in kept:
            record, own = dict(kept[case.name].record), kept[case.name].tensors
        else:
            record, own = vector(subject, case)
        records.append(record)
        names.append(list(own))
        tensors.update({f"{case.name}/{name}": a for name, a in own.items()})
    if len({record["id"] for record in records}) < len(records):
        raise ValueError(f"{subject.key}: two cases have one name")
    data, places = safetensors.dump(tensors, {"license": "CC0-1.0"})
    for record, own in zip(records, names):
        record["tensors"] = [{"name": n, **places[f"{record['name']}/{n}"]} for n in own]
    row = {
        "key": subject.key,
        "level": subject.level,
        "equation": subject.equation,
        "number": subject.number,
        "formula": subject.formula,
        "file": f"{subject.key}.safetensors",
        "shapes": subject.shapes,
        "differentiable": list(subject.gradients),
        "constants": subject.constants,
        "cases": records,
    }
    return data, row


def build(progress=lambda text: None, keep=False):
    """Return every file of vectors, {name: bytes}, and the manifest.

    With `keep`, the published cases stay as they are.
    """
    files, rows = {}, []
    for subject in subjects().values():
        progress(f"vectors of {subject.key}")
        is_known = keep and subject.key in published.subjects()
        kept = {case.name: case for case in published.cases(subject.key)} if is_known else {}
        data, row = subject_file(subject, kept)
        files[row["file"]] = data
        rows.append(row)
    manifest = {
        "format": 1,
        "version": "v1",
        "license": "CC0-1.0",
        "generator": {
            "p4dgs_ref": __version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "files": {name: _sum(data) for name, data in files.items()},
        "subjects": rows,
        "streams": stream_records(),
    }
    return files, manifest


def stream_records():
    """Return the conformance streams as the manifest lists them."""

    def record(row, result):
        return {
            "id": f"codec/{row['name']}",
            "name": row["name"],
            "says": row["says"],
            "result": result,
            "file": f"streams/{row['file']}",
            "bytes": row["bytes"],
            "sha256": row["sha256"],
        }

    rows, found = streams.read_rows(), []
    for row in rows["good"]:
        arrays = {"expected": f"streams/{row['expected']}", "arrays": row["arrays"]}
        found.append({**record(row, "valid"), **arrays})
    for row in rows["bad"]:
        refusal = {key: row[key] for key in ("section", "offset", "kind")}
        found.append({**record(row, "invalid"), **refusal})
    return found


def flags():
    """Return FLAGS.json: what each flag marks, the bug it hunts, and who has cases with it."""
    bear = {flag: [] for flag in FLAGS}
    for subject in subjects().values():
        for flag in {flag for case in subject.cases() for flag in case.flags}:
            bear[flag].append(subject)
    found = {}
    for flag, text in FLAGS.items():
        description, hunts = text.split(": ", 1)
        found[flag] = {
            "description": description,
            "hunts": hunts,
            "subjects": [subject.key for subject in bear[flag]],
            "equations": list(dict.fromkeys(subject.equation for subject in bear[flag])),
        }
    return found


def write(folder, progress=lambda text: None, keep=False):
    """Write all vectors into an existing folder; return the manifest. See `build`."""
    files, manifest = build(progress, keep)
    files["manifest.json"] = _json(manifest)
    files["FLAGS.json"] = _json(flags())
    for name, data in files.items():
        (Path(folder) / name).write_bytes(data)
    return manifest


def _json(value):
    """JSON with one line a record: small enough to ship, open enough to read."""
    text = json.dumps(value, indent=None, separators=(",", ":"))
    return (text.replace('{"id"', '\n{"id"').replace('{"key"', '\n\n{"key"') + "\n").encode()


def damaged(folder):
    """Return the files of vectors in a folder whose bytes are not those of its manifest."""
    found = []
    for name, file in read_manifest(folder)["files"].items():
        path = Path(folder) / name
        if not path.is_file() or _sum(path.read_bytes()) != file:
            found.append(name)
    return found


def _sum(data):
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def regenerate(folder, progress):
    """Compute all vectors into a folder that `oracle check` passes, as `oracle export` does."""
    with filled(folder) as place:
        for name in WRITTEN:
            shutil.copyfile(FOLDER / name, place / name)
        write(place, progress)
        copy_streams(place)
        write_expected(place)


if __name__ == "__main__":
    if sys.argv[1:]:
        regenerate(sys.argv[1], print)
    else:
        write(FOLDER, print, keep=True)
