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

from ...scenes.files import reading
from ...scenes.ply import read_ply, write_ply
from ...scenes.scene import require


def write(path, properties, vertices, networks, values):
    """Write a file and return its bytes as {"gaussians": ..., "network": ..., "other": ...}.

    `properties` names the columns of vertices [N, P], `networks` is {name: array}, and `values` are
    JSON values by name.
    """
    shapes = {name: array.shape for name, array in networks.items()}
    numbers = np.concatenate([np.zeros(0), *(array.ravel() for array in networks.values())])
    elements = {
        "vertex": (properties, vertices),
        "network": (["value"], numbers[:, None]),
    }
    comment = json.dumps({**values, "shapes": shapes})
    other, gaussians, network = write_ply(path, elements, [comment])
    return {"gaussians": gaussians, "network": network, "other": other}


def read(path):
    """Return vertices [N, P], networks {name: array} and the JSON values of a file.

    Raises ValueError with one line for a file that `write` has not written.
    """
    with reading(Path(path), "the file of a baseline"):
        elements, comments, rest = read_ply(path, ("vertex", "network"))
        vertices, flat = (
            rows.view("<f4").reshape(len(rows), len(rows.dtype)) for rows in elements.values()
        )
        values = json.loads(comments[0])
        shapes = values.pop("shapes")
        sizes = [int(np.prod(shape)) for shape in shapes.values()]
        require(not rest and sum(sizes) == len(flat), path, "expected a whole file of a baseline")
    arrays = np.split(flat.ravel(), np.cumsum(sizes)[:-1]) if sizes else []
    networks = {name: array.reshape(shape) for (name, shape), array in zip(shapes.items(), arrays)}
    return vertices, networks, values
