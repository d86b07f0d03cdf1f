"""What right ports answer, as arrays, as files and through ports."""

import json

import numpy as np

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.compare import cast, expected_tensors
from tests.workshop import writer
from tests.workshop.subjects import subjects


def case_of(id):
    """The published case with an id."""
    for case in published.cases(id.split("/")[0]):
        if case.id == id:
            return case
    raise LookupError(f"{id}: no such case is published")


def places_in(data):
    """{name: {dtype, shape, offset, bytes}} of a safetensors file, from byte 0 on."""
    start = 8 + int.from_bytes(data[:8], "little")
    places = json.loads(data[8:start])
    places.pop("__metadata__", None)
    for place in places.values():
        at, end = place.pop("data_offsets")
        place |= {"offset": start + at, "bytes": end - at}
    return places


def in_precision(tensors, dtype):
    """Tensors in a precision; what it cannot hold becomes infinite."""
    with np.errstate(over="ignore"):
        return cast(tensors, dtype)


def right(key, dtype=np.float64):
    """What a right port writes for one subject, {"ordinary/out.x": array}."""
    cases = published.cases(key)
    answers = {
        f"{case.name}/{n}": a for case in cases for n, a in expected_tensors(case.tensors).items()
    }
    return in_precision(answers, dtype)


def broken(key, name, change):
    """The same with one tensor changed."""
    answers = right(key)
    return answers | {name: change(np.array(answers[name]))}


def write(folder, **answers):
    """Write {tensor: array} of subjects into a folder, and return it."""
    for key, arrays in answers.items():
        (folder / f"{key}.safetensors").write_bytes(writer.dump(arrays))
    return folder


def ours(case, dtype):
    """What this project's own code answers in a precision."""
    inputs, cotangents = cast(case.inputs(), dtype), cast(case.cotangents(), dtype)
    return subjects()[case.subject].answer(inputs, cotangents)


class Port:
    """A port in one precision, `compute(case, dtype)`, perhaps with a change of its answers."""

    def __init__(self, compute=ours, dtype=np.float64, change=lambda case, got: got):
        self.compute, self.dtype, self.change = compute, dtype, change

    def run(self, case):
        if case.tolerance(np.dtype(self.dtype).name) is None:
            return {"out.unasked": np.zeros(1, self.dtype)}
        with np.errstate(all="ignore"):
            return self.change(case, self.compute(case, self.dtype))
