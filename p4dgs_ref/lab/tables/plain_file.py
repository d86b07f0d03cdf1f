"""A model of anchors without quantisation and entropy coding, for the ablation.

One line of JSON with the names, types and shapes of all arrays, then their numbers: float32, or
float16 for the networks in `half`. Every child of an anchor is stored, as in Scaffold-GS; the
networks and the grid of the entropy coder are not.
"""

import json

import numpy as np

from ...model import CONTEXT_NETWORKS, Anchors, Design, Model, bounding_box
from ...scenes.output import write_atomically
from ...training.parameters import Parameters


def save(model, path, half=()):
    """Write the file and return its bytes by kind, like a baseline's."""
    gaussians = {name: a for name, a in model.anchors._asdict().items() if name != "mask"}
    network = {
        f"{name}.{kind}{i}": a
        for name, layers in model.networks.items()
        if name not in CONTEXT_NETWORKS
        for kind, arrays in zip("Wb", layers)
        for i, a in enumerate(arrays)
    }
    arrays = {**gaussians, **network}
    types = {name: "<f2" if name.split(".")[0] in half else "<f4" for name in arrays}
    shapes = {name: (types[name], a.shape) for name, a in arrays.items()}
    design, background = model.design._asdict(), [float(c) for c in model.background]
    values = {"design": design, "background": background, "arrays": shapes}
    head = json.dumps(values).encode() + b"\n"
    body = {name: a.astype(types[name]).tobytes() for name, a in arrays.items()}
    write_atomically(path, lambda file: file.write(head + b"".join(body.values())))
    sizes = [sum(len(body[name]) for name in part) for part in (gaussians, network)]
    return {"gaussians": sizes[0], "network": sizes[1], "other": len(head)}


def load(path):
    """The model in a file, ready to be rendered."""
    head, _, body = path.read_bytes().partition(b"\n")
    values, at, arrays = json.loads(head), 0, {}
    for name, (kind, shape) in values["arrays"].items():
        numbers = np.frombuffer(body, kind, int(np.prod(shape)), at)
        arrays[name] = numbers.reshape(shape)
        at += numbers.nbytes
    p = Parameters(arrays, float)
    attributes = [p[name] for name in Anchors._fields[:-1]]
    anchors = Anchors(*attributes, mask=np.ones(attributes[-1].shape[:2], bool))
    names = dict.fromkeys(name.split(".")[0] for name in arrays if "." in name)
    networks = {name: p.network(name) for name in names}
    fields = values["design"].values()
    design = Design._make(tuple(v) if isinstance(v, list) else v for v in fields)
    box, background = bounding_box(anchors.x_a), np.array(values["background"])
    return Model(design, anchors, networks, [], box, background)
