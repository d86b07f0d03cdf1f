"""The file of a baseline: one PLY, Gaussians as its vertices, every network in a second element.

    ply
    format binary_little_endian 1.0
    comment {"method": "d3dgs", ...}     what a reader must know besides the numbers, as JSON
    element vertex N                     a row for each Gaussian, the properties of 3DGS's PLY
    property float x
    ...
    element network M                    all weights one after another; the comment has their shapes
    property float value
    end_header

All numbers are float32, as in the files of the authors; D3DGS keeps its network in a file of its
own. The text is the overhead, about 2 KB.
"""

import json
from pathlib import Path

import numpy as np

from ...scenes.output import write_atomically

START = ["ply", "format binary_little_endian 1.0"]


def write(path, properties, vertices, networks, values):
    """Write a file and return its bytes as {"gaussians": ..., "network": ..., "other": ...}.

    `properties` names the columns of vertices [N, P], `networks` is {name: array}, and `values` are
    JSON values by name.
    """
    shapes = {name: array.shape for name, array in networks.items()}
    numbers = np.concatenate([np.zeros(0), *(array.ravel() for array in networks.values())])
    lines = [
        *START,
        "comment " + json.dumps({**values, "shapes": shapes}),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in properties),
        f"element network {len(numbers)}",
        "property float value",
        "end_header",
    ]
    parts = [
        ("\n".join(lines) + "\n").encode(),
        vertices.astype("<f4").tobytes(),
        numbers.astype("<f4").tobytes(),
    ]
    write_atomically(Path(path), lambda file: file.write(b"".join(parts)))
    other, gaussians, network = map(len, parts)
    return {"gaussians": gaussians, "network": network, "other": other}


def read(path):
    """Return vertices [N, P], networks {name: array} and the JSON values of a file.

    Raises ValueError with one line for a file that `write` has not written.
    """
    text, end, body = Path(path).read_bytes().partition(b"end_header\n")
    lines = text.decode("latin-1").splitlines()
    properties = [line.split()[2] for line in lines[4:-2]]
    try:
        values = json.loads(lines[2].removeprefix("comment "))
        rows, floats = int(lines[3].split()[2]), int(lines[-2].split()[2])
        shapes = values.pop("shapes")
        sizes = [int(np.prod(shape)) for shape in shapes.values()]
        numbers = np.frombuffer(body, "<f4")
        whole = lines[:2] == START and floats == sum(sizes)
        if not whole or len(numbers) != rows * len(properties) + floats:
            raise ValueError("cut")
    except (ValueError, IndexError, KeyError, AttributeError):
        raise ValueError(f"{path}: not a file of a baseline, or damaged") from None
    vertices, flat = np.split(numbers, [rows * len(properties)])
    arrays = np.split(flat, np.cumsum(sizes)[:-1]) if sizes else []
    networks = {name: array.reshape(shape) for (name, shape), array in zip(shapes.items(), arrays)}
    return vertices.reshape(rows, len(properties)), networks, values
