"""Reads the published vectors: the manifest, and the cases of a subject with their tensors.

A subject is one file of vectors: an equation (level L1), a scalar function (L0), a stage of several
equations (L2) or the whole pipeline (L4).
"""

import json
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import safetensors
from .compare import too_wide

FOLDER = Path(__file__).with_name("v1")
STREAMS = Path(__file__).with_name("streams_v1")
LEVELS = {
    "L0": "scalars",
    "L1": "one equation",
    "L2": "a stage",
    "L3": "the codec",
    "L4": "the pipeline",
}
INVALID = {"invalid": "streams of L3"}  # the group of those that a decoder has to refuse
# Groups of subjects that a port may leave out, with their level.
GROUPS = {
    "inside": "levels L2, L4",
    "pictures": "level L3",
}


class SelectionError(ValueError):
    """The names of levels, subjects or cases choose no case. The message is one line."""


class Golden(NamedTuple):
    """One case of the vectors."""

    id: str
    name: str
    subject: str
    equation: str  # the equation to blame if the case fails
    level: str
    record: dict  # the case's record in the manifest
    tensors: dict  # {"in.x_a": array, "out.x": array, "scale.out.x": array, ...}
    group: str = ""  # of GROUPS, if a port may leave the subject out

    def inputs(self):
        """Return the keyword arguments of forward: tensors, lists of tensors and settings."""
        return {
            **unflatten(self.tensors, "in."),
            **{name: _tuples(value) for name, value in self.record["settings"].items()},
        }

    def cotangents(self):
        """Return the cotangents, {"x_bar": array}."""
        return {name + "_bar": a for name, a in unflatten(self.tensors, "out_bar.").items()}

    def tolerance(self, precision):
        """Return the record {eps_S, reason} of a precision, or None if the case has none."""
        return self.record["tolerance"][precision]

    def not_judged(self, precision):
        """Return the names of the outputs and gradients that are not checked in a precision."""
        return too_wide(self.tensors, self.tolerance(precision), precision)


def path():
    """Return the folder of the published vectors."""
    return FOLDER


def read_manifest(folder=FOLDER):
    """Return the manifest of a folder of vectors."""
    return json.loads((Path(folder) / "manifest.json").read_text(encoding="utf-8"))


@cache
def subjects():
    """Return {key: record in the manifest} of all subjects, in the order in which data flows."""
    return {subject["key"]: subject for subject in read_manifest()["subjects"]}


def read_rows():
    """Return the manifest of the conformance streams, {"good": [...], "bad": [...]}."""
    return json.loads((STREAMS / "manifest.json").read_text(encoding="utf-8"))


@cache
def stream_rows():
    """Return the records of all conformance streams, each with its id and result."""
    rows = read_rows()
    return [
        {"id": f"codec/{row['name']}", "result": result, **row}
        for kind, result in (("good", "valid"), ("bad", "invalid"))
        for row in rows[kind]
    ]


def names(of=""):
    """Return the names that `oracle check --only` accepts: subjects, groups, and the codec.

    With one of the subjects, or with "codec", the ids of its cases.
    """
    cases = {"codec": stream_rows(), **{key: row["cases"] for key, row in subjects().items()}}
    return [row["id"] for row in cases[of]] if of in cases else sorted({*cases, *GROUPS})


def suggestion(name, known):
    """Return the end of a message about an unknown name: the closest known name, then all."""
    nearest = get_close_matches(name, known, 1)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    return f"{hint}expected one of {', '.join(known)}"


def require_known(levels, only):
    """Raise SelectionError unless all names are of levels, and of subjects, groups or cases."""
    subjects_of = {name: names(str(name).rpartition("/")[0]) for name in only}
    for what, known_to in ("levels", dict.fromkeys(levels, LEVELS)), ("only", subjects_of):
        for name, known in known_to.items():
            if name not in known:
                raise SelectionError(f"{what} {name}: {suggestion(str(name), known)}")


def cases(key):
    """Return the cases of the subject with that key, or the single case with that id.

    Raises KeyError if there is no such subject or case.
    """
    subject, slash, _ = str(key).partition("/")
    known = names(subject) if slash and subject in subjects() else subjects()
    if key not in known:
        raise KeyError(f"{key!r}: {suggestion(str(key), known)}")
    return [case for case in read(subjects()[subject]) if key in (subject, case.id)]


def read(subject, folder=FOLDER):
    """Return all cases of one subject, given its record in the manifest."""
    arrays = safetensors.load((folder / subject["file"]).read_bytes())
    return [
        Golden(
            case["id"],
            case["name"],
            subject["key"],
            subject["equation"],
            subject["level"],
            case,
            {name: arrays[f"{case['name']}/{name}"] for name in case["tensors"]},
            subject.get("group", ""),
        )
        for case in subject["cases"]
    ]


def flatten(values, prefix=""):
    """Return {"weights": [W0, W1], "x": x} as {"weights.0": W0, "weights.1": W1, "x": x}.

    Values that are neither arrays nor lists of arrays are left out.
    """
    flat = {}
    for name, value in values.items():
        if isinstance(value, list):
            flat.update({f"{prefix}{name}.{i}": np.asarray(a) for i, a in enumerate(value)})
        elif isinstance(value, (np.ndarray, np.generic)):
            flat[f"{prefix}{name}"] = np.asarray(value)
    return flat


def unflatten(tensors, prefix):
    """Undo `flatten`. The arrays are copied, because a port may write into its inputs.

    Floats become float64, even if they are stored as float32 to save space.
    """
    values = {}
    for name, a in tensors.items():
        if name.startswith(prefix):
            first, _, index = name.removeprefix(prefix).partition(".")
            copied = a.astype(float if a.dtype.kind == "f" else a.dtype)
            if index:
                values.setdefault(first, []).append(copied)
            else:
                values[first] = copied
    return values


def _tuples(value):
    """Return a setting with tuples in place of JSON's lists."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
