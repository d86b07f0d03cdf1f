"""`python -m tests.workshop.mistakes` writes the wrong answers that the doctor knows.

Answers that are already written keep their bytes. To compute those of a mistake anew, delete the
file of its subject first.
"""

import gzip
import json

import numpy as np

from p4dgs_ref.oracle import published, safetensors
from p4dgs_ref.oracle.compare import compare
from p4dgs_ref.oracle.doctor import FOLDER
from p4dgs_ref.oracle.published import flatten
from tests.workshop import writer
from tests.workshop.mistakes import MISTAKES, NotApplicable


def answers(mistake, case):
    """Return what a port with a mistake answers to a published case, as flat tensors.

    Where the mistake does not apply, the answer is right.
    """
    try:
        with np.errstate(all="ignore"):
            outputs, gradients = mistake.run(case.inputs(), case.cotangents())
    except NotApplicable:
        return {n: a for n, a in case.tensors.items() if n.startswith(("out.", "in_bar."))}
    return {**flatten(outputs, "out."), **flatten(gradients, "in_bar.")}


def wrong_tensors(mistake):
    """Return {"<mistake>/<case>/<tensor>": array} of every tensor that a mistake gets wrong."""
    tensors = {}
    for case in (c for c in published.cases(mistake.subject) if c.name not in mistake.noisy):
        got = answers(mistake, case)
        for finding in compare(case.tensors, got, case.tolerance("float64")):
            tensors[f"{mistake.id}/{case.name}/{finding.tensor}"] = got[finding.tensor]
    return tensors


def files():
    """Return {name: bytes} of all files of the doctor's folder."""
    rows, tensors = [], {}
    for mistake in MISTAKES:
        fields = ["id", "subject", "equation", "description", *["noisy"] * bool(mistake.noisy)]
        rows.append({name: getattr(mistake, name) for name in fields})
        tensors.setdefault(mistake.subject, {}).update(wrong_tensors(mistake))
    contents = {"mistakes.json": (json.dumps(rows, indent=1) + "\n").encode()}
    for subject, arrays in tensors.items():
        contents[f"{subject}.safetensors.gz"] = packed(arrays)
    return contents


def packed(arrays):
    return gzip.compress(writer.dump(arrays), mtime=0)


def kept(name, data):
    """Return a file's bytes in which the answers that are already there keep theirs."""
    file = FOLDER / name
    if file.suffix != ".gz" or not file.exists():
        return data
    new, old = (safetensors.load(gzip.decompress(d)) for d in (data, file.read_bytes()))
    return packed({tensor: old.get(tensor, a) for tensor, a in new.items()})


def main():
    FOLDER.mkdir(exist_ok=True)
    made = {name: kept(name, data) for name, data in files().items()}
    for file in FOLDER.iterdir():
        file.unlink()
    for name, data in made.items():
        (FOLDER / name).write_bytes(data)
    size = sum(file.stat().st_size for file in FOLDER.iterdir())
    print(f"{FOLDER}: {len(MISTAKES)} mistakes, {size:,} bytes")


if __name__ == "__main__":
    main()
