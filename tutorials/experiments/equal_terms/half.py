"""The file of an explicit model whose numbers are float16.

    2 bytes         length of the head
    the head        JSON, compressed by zlib: what a PLY file says, and the sizes of the parts
    numbers         all arrays, one after another

The files of `coded` have the same head and other parts.
"""

import json
import zlib

import numpy as np

from p4dgs_ref.training.parameters import Parameters

from ..baselines import explicit, model_of


def encode(model):
    """The file of a model, and its bytes by kind."""
    values, arrays = model.values(), model.parameters.arrays
    numbers = np.concatenate([a.ravel() for a in arrays.values()]).astype("<f2")
    shapes = {name: a.shape for name, a in arrays.items()}
    data = join({**values, "shapes": shapes}, {"numbers": numbers.tobytes()})
    gaussians = 2 * sum(a.size for name, a in arrays.items() if name in values["rows"])
    sizes = {"gaussians": gaussians, "network": numbers.nbytes - gaussians}
    return data, {**sizes, "other": len(data) - numbers.nbytes}


def decode(data):
    """The model in a file."""
    values, parts = split(data)
    numbers = np.frombuffer(parts["numbers"], "<f2").astype(np.float32)
    return model_of(Parameters(explicit.split(numbers, values["shapes"])), values)


def join(values, parts):
    """A file: the head, and the parts {name: bytes}."""
    sizes = {name: len(part) for name, part in parts.items()}
    head = zlib.compress(json.dumps({**values, "sizes": sizes}).encode(), 9)
    return b"".join([len(head).to_bytes(2, "little"), head, *parts.values()])


def split(data):
    """What the head of a file says, and its parts {name: bytes}."""
    start = 2 + int.from_bytes(data[:2], "little")
    values = json.loads(zlib.decompress(data[2:start]))
    ends = np.cumsum([start, *values["sizes"].values()])
    return values, {name: data[a:b] for name, a, b in zip(values["sizes"], ends, ends[1:])}
