"""A model of anchors without quantisation and entropy coding, for the ablation.

One line of JSON with the names, types and shapes of all arrays, then their numbers: float32, or
float16 for the networks in `half`. Every child of an anchor is stored, as in Scaffold-GS; the
networks and the grid of the entropy coder are not.
"""

import json

import numpy as np

from ...model import CONTEXT_NETWORKS, Anchors, Design, Model, bounding_box
from ...scenes.output import write_atomically


def save(model, path, half=()):
    """Write the file and return its bytes by kind, like a baseline's."""
    groups = {"gaussians": model.anchors._asdict(), "network": {}}
    groups["gaussians"].pop("mask")
    for name, layers in model.networks.items():
        if name not in CONTEXT_NETWORKS:
            for kind, arrays in zip("Wb", layers):
                groups["network"].update({f"{name}.{kind}{i}": a for i, a in enumerate(arrays)})
    parts, shapes = {}, {}
    for group, arrays in groups.items():
        types = {name: "<f2" if name.split(".")[0] in half else "<f4" for name in arrays}
        shapes.update({name: (types[name], a.shape) for name, a in arrays.items()})
        parts[group] = b"".join(a.astype(types[name]).tobytes() for name, a in arrays.items())
    design, background = model.design._asdict(), [float(c) for c in model.background]
    values = {"design": design, "background": background, "arrays": shapes}
    head = json.dumps(values).encode() + b"\n"
    write_atomically(path, lambda file: file.write(head + b"".join(parts.values())))
    return {**{group: len(part) for group, part in parts.items()}, "other": len(head)}


def load(path):
    """The model in a file, ready to be rendered."""
    head, _, body = path.read_bytes().partition(b"\n")
    values, at, arrays = json.loads(head), 0, {}
    for name, (kind, shape) in values["arrays"].items():
        numbers = np.frombuffer(body, kind, int(np.prod(shape)), at)
        arrays[name] = numbers.reshape(shape).astype(float)
        at += numbers.nbytes
    attributes = [arrays.pop(name) for name in Anchors._fields[:-1]]
    mask = np.ones(attributes[-1].shape[:2], bool)
    networks = {}
    for name, array in arrays.items():  # in the order of the layers
        network, layer = name.split(".")
        networks.setdefault(network, ([], []))["Wb".index(layer[0])].append(array)
    fields = values["design"].items()
    design = Design(**{name: tuple(v) if isinstance(v, list) else v for name, v in fields})
    background, box = np.array(values["background"]), bounding_box(attributes[0])
    return Model(design, Anchors(*attributes, mask), networks, [], box, background)
