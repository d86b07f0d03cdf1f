"""One simple codec in which every method is stored alike, after its training.

Every number becomes a multiple of a step, and these integers are entropy coded by the coder of the
paper's files. How much the pictures suffer decides the steps. A number that is off by up to half
its step Delta adds H Delta^2 / 12 to the squared error of the pictures, where H is the sum over all
pixels of their squared derivatives with respect to the number. A group of n numbers that share a
step costs that much for each of them, and n log2(1 / Delta) bits. The best balance of the two over
all groups is

    Delta^2 = loss n / (sum of H over the group)

where `loss` is the same for all groups. It is the only setting of a file. The step of a group of
weights is at most their root mean square: a larger one rounds nearly all of them to 0, and what
that does to a network of many layers is not in H, which is about small changes.

A group is a column of the Gaussians, a plane, the positions, or the weights or biases of a layer.
`coded_anchors` has the same rule for the paper's design. The file has

    the head        of `half`; it also says the bits of a coordinate
    gaussians       positions, sorted as in B2 (`coded_networks.positions`), and then the columns
    network         planes as columns; weights and biases as in B1 (`coded_networks.weights`)
    other           arrays that are not trained, float32

Columns begin with the code of the step, the mean and the deviation of each of them (COLUMN). Their
integers follow as one stream (`codec.streams`), each under the Gaussian of its column.
"""

import math
import struct

import numpy as np

from p4dgs_ref.codec.gaussian_table import MU_BITS, SIGMA_BITS, SIGMA_MIN
from p4dgs_ref.codec.streams import decode_gaussian, encode_gaussian
from p4dgs_ref.model import unsnap
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.training.parameters import Parameters

from ..baselines import model_of
from ..coded_networks import positions, weights
from ..coded_networks.networks import step_code, step_of_code
from .half import join, split

DRAWS = 2  # of random signs for each view, from which H is estimated
# The code of a step, 8 times the mean of the integers, 8 (log2 of their deviation + 8).
COLUMN, FINE, LEAST = struct.Struct("<BhB"), 8, -8
MAX_INTEGER = 4095  # so that 8 times a mean has 16 bits
BITS = 6, 16  # of a coordinate: at least and at most


# --- the rule -------------------------------------------------------------------------------------
def sensitivity(model, views, rng):
    """H of every number of a model over all pixels of some views, as Parameters.

    The gradient of the pixels with random signs has a square whose mean is H (Hutchinson).
    """
    H = Parameters(model.parameters.arrays, np.float64).zeros()
    for view in [view for view in views for _ in range(DRAWS)]:
        g, back_predict = model.predict(view.time, view.camera.center)
        (image, *_), back_render = model.render_gaussians(g, view.camera, FAST)
        bars = back_render(rng.choice([-1.0, 1.0], image.shape))
        for name, bar in back_predict(*(bars[field] for field in g._fields[:-1])).items():
            H[name][...] += bar**2 / DRAWS
    return H


def step_for(loss, H, numbers=0.0):
    """The step of a group, from H of its numbers; large enough for the largest of them."""
    least = np.abs(numbers).max(initial=0) / MAX_INTEGER
    return max(np.sqrt(loss * H.size / max(H.sum(), 1e-30)), least)


def bits_for(loss, H, box):
    """The bits of a coordinate, so that the lattice of the box is as fine as the step."""
    cells = max(float((box[1] - box[0]).max()) / step_for(loss, H), 1.0)
    return min(max(math.ceil(math.log2(cells)), BITS[0]), BITS[1])


def codes_of(loss, H, network):
    """The codes of the steps of a network's weights and biases (B1), from H of their numbers."""
    return tuple(
        [step_code(min(step_for(loss, *pair), rms(pair[1]))) for pair in zip(*parts)]
        for parts in zip(H, network)
    )


def rms(numbers):
    """The root mean square of some numbers; 0 for none."""
    return np.sqrt((numbers**2).mean()) if numbers.size else 0.0


# --- encoder --------------------------------------------------------------------------------------
def encode(model, H, loss):
    """The file of a model, from its `sensitivity` H, and its bytes by kind."""
    values, box = model.values(), model.box
    bits = bits_for(loss, H["x"], box)
    places, _ = positions.snap(model.parameters["x"], *box, bits)
    order = positions.codes_of(places, box, bits).argsort(kind="stable")
    p, H = (
        Parameters({n: a[order] if n in values["rows"] else a for n, a in q.arrays.items()}, float)
        for q in (model.parameters, H)
    )
    names = layers_of(values["shapes"])
    networks = {name: p.network(name) for name in names}
    steps = {name: codes_of(loss, H.network(name), networks[name]) for name in names}
    parts = {
        "positions": positions.write_sorted(places[order], box, bits),
        "columns": write_groups(columns_of(p, values), columns_of(H, values), loss),
        "planes": write_groups(planes_of(p), planes_of(H), loss),
        "networks": weights.write_weights(networks, steps) if networks else b"",
        "box": b"".join(a.astype("<f4").tobytes() for a in p.arrays.get("box", ())),
    }
    data = join({**values, "count": len(order), "bits": bits}, parts)
    return data, kinds(data, parts)


def kinds(data, parts):
    """The bytes of a file by kind; the head and what is not trained are `other`."""
    network = sum(len(part) for name, part in parts.items() if name in NETWORKS)
    gaussians = sum(map(len, parts.values())) - network - len(parts.get("box", b""))
    return {"gaussians": gaussians, "network": network, "other": len(data) - gaussians - network}


NETWORKS = "planes", "networks", "hash_grid"  # the parts that count as networks


def layers_of(shapes):
    """The shapes [(I, J), ...] of the weights of each network, from those of all arrays."""
    layers = {}
    for name, shape in shapes.items():
        if ".W" in name:
            layers.setdefault(name.partition(".")[0], []).append(tuple(shape))
    return layers


def columns_of(p, values):
    """The columns [N] of all arrays of the Gaussians but x, as views."""
    arrays = [p[name] for name in values["rows"] if name not in ("x", "normals")]
    return [column for a in arrays for column in a.reshape(len(a), math.prod(a.shape[1:])).T]


def planes_of(p):
    """The planes, flat, as views."""
    return [a.reshape(-1) for a in p.arrays_of("planes")]


def write_groups(groups, sensitivities, loss):
    """The bytes of groups of numbers [n], from H of each number."""
    stored, integers = [], [np.zeros(0, np.int64)]
    for numbers, H in zip(groups, sensitivities):
        code = int(step_code(step_for(loss, H, numbers)))
        n = np.rint(numbers / step_of_code(code)).astype(np.int64)
        spread = np.log2(max(n.std(), 2.0**LEAST)) - LEAST
        stored.append((code, round(FINE * n.mean()), round(FINE * spread)))
        integers.append(n)
    stream = encode_gaussian(np.concatenate(integers), *units(stored, map(len, integers[1:])))
    return b"".join(COLUMN.pack(*group) for group in stored) + stream


def units(stored, lengths):
    """mu_units and sigma_units of the integers of groups, from what is stored of each group."""
    _, mean, spread = np.repeat(np.array(stored).reshape(-1, 3), [*lengths], axis=0).T
    return mean * ((1 << MU_BITS) // FINE), (spread * (1 << SIGMA_BITS) // FINE) + SIGMA_MIN


# --- decoder --------------------------------------------------------------------------------------
def decode(data):
    """The model in a file."""
    values, parts = split(data)
    count = values["count"]
    rows = {n: (count, *shape) for n, shape in values["rows"].items() if n != "normals"}
    p = Parameters({name: np.zeros(shape) for name, shape in {**rows, **values["shapes"]}.items()})
    box, places = positions.read_sorted(parts["positions"], count, values["bits"])
    p["x"][...] = unsnap(places, *box)
    read_groups(parts["columns"], columns_of(p, values))
    read_groups(parts["planes"], planes_of(p))
    layers = layers_of(values["shapes"])
    networks = weights.read_networks(parts["networks"], "networks", layers) if layers else {}
    for name, (W, b) in networks.items():
        p.fill(name, {"weights": W, "biases": b})
    if "box" in p.arrays:
        p["box"][...] = np.frombuffer(parts["box"], "<f4").reshape(2, 3)
    return model_of(p, values)


def read_groups(data, groups):
    """Fill groups [n] of numbers, which are views of arrays, from what `write_groups` wrote."""
    start, lengths = COLUMN.size * len(groups), [*map(len, groups)]
    stored = [*COLUMN.iter_unpack(data[:start])]
    integers = decode_gaussian(data[start:], *units(stored, lengths))
    for group, (code, *_), n in zip(groups, stored, np.split(integers, np.cumsum(lengths)[:-1])):
        group[...] = n * step_of_code(code)
