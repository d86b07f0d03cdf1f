"""Makes the vectors: every case of every subject with inputs, outputs, cotangents, gradients and their scales.

`python -m p4dgs_ref.oracle.vectors [DIR]` computes them anew; `p4dgs-ref oracle export DIR` copies the published ones.
"""

import hashlib
import inspect
import json
import shutil
import sys
import zlib
from pathlib import Path

import numpy as np
import scipy

from .. import __version__
from ..equations import FLAGS
from ..scenes.output import OutputError, filled
from . import independent, safetensors, streams, tolerance
from .subjects import flatten, run, settings, subjects

FOLDER = Path(__file__).with_name("v1")
WRITTEN = (
    "README.md",
    "LICENSE",
    "example_adapter.py",
    "model.p4dgs",
)  # everything else in v1 is made here

# Cases in which another answer is defensible: reported, but not required.
ACCEPTABLE = {
    "frames/paper_settings": "the published kernel's rule: tiles of three sigma, mask at 1/255, stop before the splat",
}


def cotangents_of(eq, case, out, seed):
    """What flows back: the case's own, else normal numbers drawn once and stored; of every float output."""
    rng = np.random.default_rng(zlib.crc32(seed.encode()))

    def draw(a):
        return [draw(b) for b in a] if isinstance(a, list) else rng.standard_normal(np.shape(a))

    return {
        name + "_bar": case.cotangents.get(name + "_bar", draw(value))
        for name, value in out._asdict().items()
        if eq.differentiable
        and all(np.asarray(a).dtype.kind == "f" for a in flatten({"": value}).values())
        and flatten({"": value})
    }


def vector(subject, case):
    """One case: (its record for the manifest, without places; its tensors)."""
    eq, key = subject.eq, f"{subject.key}/{case.name}"
    out = eq.forward(**case.inputs)[0]
    cotangents = cotangents_of(eq, case, out, key)
    flat = tolerance.named(*run(eq, case.inputs, cotangents))
    scale = tolerance.scales(eq, case, cotangents, flat)
    better, provenance, by_reference = independent.values(subject, case, cotangents, flat)
    error = tolerance.float32_error(eq, case, cotangents, flat, scale)
    flat.update(better)
    tensors = {
        **flatten(case.inputs, "in."),
        **flatten({n[:-4]: a for n, a in cotangents.items()}, "out_bar."),
        **flat,
        **{f"scale.{name}": a for name, a in scale.items()},
    }
    record = {
        "id": key,
        "name": case.name,
        "tests": says(case),
        "flags": list(case.flags),
        "result": "acceptable" if key in ACCEPTABLE else "valid",
        **({"why": ACCEPTABLE[key]} if key in ACCEPTABLE else {}),
        "provenance": provenance,
        **({"reference": by_reference} if by_reference else {}),
        "settings": settings(case.inputs),
        "tolerance": tolerance.tolerances(
            error, any(name.split(".")[1] in tolerance.IMAGES for name in flat)
        ),
    }
    return record, {name: np.ascontiguousarray(a).reshape(a.shape) for name, a in tensors.items()}


def says(case):
    """What a case tests, in a sentence."""
    return f"{case.name.replace('_', ' ')}; hunts " + "; ".join(
        FLAGS[flag].split(": ", 1)[1] for flag in case.flags
    )


def constants(eq):
    """The numbers that an equation takes for granted, of its signature and its file: {"near": 0.2, "FLOOR": 2^-10, ...}."""
    taken = {name: p.default for name, p in inspect.signature(eq.forward).parameters.items()}
    named = {
        name: value
        for name, value in vars(sys.modules[eq.module]).items()
        if name.isupper() and name != "BLOCK"
    }
    return {
        name: value
        for name, value in {**taken, **named}.items()
        if isinstance(value, (int, float))
        or isinstance(value, tuple)
        and all(isinstance(v, (int, float)) for v in value)
    }


def build(only=None, progress=lambda text: None):
    """Every file of vectors: ({name of file: bytes}, manifest); `only` one subject if given."""
    files, rows = {}, []
    for key, subject in subjects().items():
        if only not in (None, key):
            continue
        progress(f"vectors of {key}")
        records, tensors = [], {}
        for case in subject.cases():
            record, own = vector(subject, case)
            records.append((record, list(own)))
            tensors.update({f"{case.name}/{name}": a for name, a in own.items()})
        if len({record["id"] for record, _ in records}) < len(records):
            raise ValueError(f"{key}: two cases have one name")
        file = f"{key}.safetensors"
        files[file], places = safetensors.dump(tensors, {"license": "CC0-1.0"})
        rows.append(
            {
                "key": key,
                "level": subject.level,
                "equation": subject.equation,
                "number": subject.eq.number,
                "formula": subject.eq.formula,
                "file": file,
                "shapes": subject.eq.shapes,
                "differentiable": list(subject.eq.differentiable),
                "constants": constants(subject.eq),
                "cases": [
                    {
                        **record,
                        "tensors": [
                            {"name": name, **places[f"{record['name']}/{name}"]} for name in names
                        ],
                    }
                    for record, names in records
                ],
            }
        )
    manifest = {
        "format": 1,
        "version": "v1",
        "license": "CC0-1.0",
        "generator": {
            "p4dgs_ref": __version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        },
        "subjects": rows,
        "streams": streams.records(),
    }
    return files, manifest


def flags():
    """FLAGS.json: what each flag marks, the bug it hunts, and the subjects and equations whose cases bear it."""
    bear = {flag: [] for flag in FLAGS}
    for subject in subjects().values():
        for flag in sorted({flag for case in subject.cases() for flag in case.flags}):
            bear[flag].append(subject)
    return {
        flag: {
            **dict(zip(("description", "hunts"), text.split(": ", 1))),
            "subjects": [s.key for s in bear[flag]],
            "equations": list(dict.fromkeys(s.equation for s in bear[flag])),
        }
        for flag, text in FLAGS.items()
    }


def write(folder, progress=lambda text: None):
    """Compute all vectors and write them, with manifest.json and FLAGS.json, into an existing folder."""
    files, manifest = build(progress=progress)
    texts = {"manifest.json": manifest, "FLAGS.json": flags()}
    for name, data in {**files, **{n: _json(v) for n, v in texts.items()}}.items():
        (Path(folder) / name).write_bytes(data)
    return manifest


def _json(value):
    """One line a record: small enough to ship, open enough to read."""
    return (
        json.dumps(value, indent=None, separators=(",", ":"))
        .replace('{"id"', '\n{"id"')
        .replace('{"key"', '\n\n{"key"')
        + "\n"
    ).encode()


def path():
    """The folder of the published vectors."""
    return FOLDER


def names():
    """Every name by which `--only` can choose: subjects, equations, and the codec."""
    subjects_of = read_manifest()["subjects"]
    return sorted(
        {s["key"] for s in subjects_of} | {s["equation"] for s in subjects_of} | {"codec"}
    )


def export(folder, regenerate=False, progress=lambda text: None):
    """Copy the published vectors into a folder, or compute them anew; returns {output, files, bytes, cases}.

    Beside them stands `codec`, what a right port answers to the streams: `oracle check` passes the whole folder.

    Raises     OutputError, OSError; a folder with other things in it is refused, for names would be overwritten
    """
    if (
        Path(folder).is_dir()
        and any(Path(folder).iterdir())
        and not (Path(folder) / "manifest.json").is_file()
    ):
        raise OutputError(
            f"{folder}: expected an empty folder, or an earlier export with its manifest.json"
        )
    with filled(folder) as beside:
        for name in (
            WRITTEN
            if regenerate
            else sorted(file.name for file in FOLDER.iterdir() if file.is_file())
        ):
            shutil.copyfile(FOLDER / name, beside / name)
        manifest = write(beside, progress) if regenerate else read_manifest()
        streams.copy(beside)
        streams.write_expected(beside)
        sizes = [file.stat().st_size for file in beside.rglob("*") if file.is_file()]
    return {
        "output": str(folder),
        "files": len(sizes),
        "bytes": sum(sizes),
        "cases": sum(len(s["cases"]) for s in manifest["subjects"]) + len(manifest["streams"]),
    }


def read_manifest(folder=FOLDER):
    """The manifest of published vectors.

    Raises     safetensors.TensorError
    """
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise safetensors.TensorError(
            f"{path}: expected the JSON of the vectors' manifest ({error})"
        ) from None
    if manifest.get("format") != 1:
        raise safetensors.TensorError(f"{path}: format: expected 1, got {manifest.get('format')!r}")
    return manifest


if __name__ == "__main__":
    with filled(sys.argv[1] if sys.argv[1:] else FOLDER) as place:
        write(place, lambda text: print(text, flush=True))
