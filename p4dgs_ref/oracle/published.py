"""The published vectors as a checker reads them: cases with their tensors, inputs put together again."""

import hashlib
from typing import NamedTuple

from . import safetensors
from .vectors import FOLDER, read_manifest


class Golden(NamedTuple):
    """One case of the vectors."""

    id: str
    name: str
    subject: str
    equation: str
    level: str
    record: dict  # of the manifest
    tensors: dict  # name with role -> array

    def inputs(self):
        """Keyword arguments of forward: tensors, lists of tensors and settings."""
        return {
            **unflatten(self.tensors, "in."),
            **{n: _tuples(v) for n, v in self.record["settings"].items()},
        }

    def cotangents(self):
        """Keyword arguments of backward."""
        return {name + "_bar": a for name, a in unflatten(self.tensors, "out_bar.").items()}

    def tolerance(self, precision):
        """The record {eps_S, reason} of a precision, None where the case does not ask for that one."""
        return self.record["tolerance"][precision]


def unflatten(tensors, prefix):
    """{"in.weights.0": W0, "in.weights.1": W1} -> {"weights": [W0, W1]}; copies, for a port may write into them."""
    values = {}
    for name, a in tensors.items():
        if name.startswith(prefix):
            first, _, place = name[len(prefix) :].partition(".")
            if place:
                values.setdefault(first, []).append(a.copy())
            else:
                values[first] = a.copy()
    return values


def _tuples(value):
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def read(subject, folder=FOLDER):
    """All cases of one subject's record in the manifest.

    Raises     safetensors.TensorError where the file is missing, damaged or another than the manifest's
    """
    path = folder / subject["file"]
    try:
        data = path.read_bytes()
    except OSError as error:
        raise safetensors.TensorError(
            f"{path}: expected a file of vectors ({error.strerror})"
        ) from None
    arrays = safetensors.load(data, path)
    return [
        Golden(
            case["id"],
            case["name"],
            subject["key"],
            subject["equation"],
            subject["level"],
            case,
            {t["name"]: arrays[f"{case['name']}/{t['name']}"] for t in case["tensors"]},
        )
        for case in subject["cases"]
    ]


def damaged(folder=FOLDER):
    """Names of files in a folder of vectors whose bytes are not those of the manifest."""
    files = read_manifest(folder)["files"]
    return [
        name
        for name, file in files.items()
        if not (folder / name).is_file()
        or hashlib.sha256((folder / name).read_bytes()).hexdigest() != file["sha256"]
    ]
