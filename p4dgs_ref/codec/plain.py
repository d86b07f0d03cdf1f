"""The sections that are stored as plain numbers; `file.py` describes them."""

import numpy as np

from .container import expect, require_encodable

MAX_BOX = 1e30  # of a coordinate, so that extents are finite in float32
BOX = f"lo <= hi, finite, within +-{MAX_BOX:g}"  # what the box of a file must be
BOX_BYTES = 24


def valid_box(lo, hi):
    """Return whether a file may contain this box; False for NaN."""
    # The float32 next to 1e30 is larger than 1e30, hence < and not <=.
    return (np.abs([lo, hi]) < np.float32(MAX_BOX)).all() and (lo <= hi).all()


def write_positions(model, positions):
    """Return the box, and the positions [A, 3] as uint16."""
    return write_box(model.box) + positions.astype("<u2").tobytes()


def read_positions(data, A):
    """Return the box, two float32 arrays [3], and the positions [A, 3] int64."""
    size = BOX_BYTES + 6 * A
    message = f"expected {size} bytes for {A} anchors, found {len(data)}"
    expect(len(data) == size, "positions", len(data), message)
    positions = np.frombuffer(data, "<u2", offset=BOX_BYTES)
    return read_box(data), positions.astype(np.int64).reshape(A, 3)


def write_box(box):
    """Return the corners lo and hi [3] of the box, with which the section positions begins."""
    return np.concatenate(box).astype("<f4").tobytes()


def read_box(data):
    """Return the corners lo and hi [3] of the box at the beginning of the section positions."""
    lo, hi = np.frombuffer(data, "<f4", 6).astype(np.float32).reshape(2, 3)
    expect(valid_box(lo, hi), "positions", 0, f"expected a box with {BOX}")
    return lo, hi


def round_networks(model):
    """Return the networks with all numbers rounded to float16 (Q18), float64 arrays in row order.

    Raises EncodeError, which names the network.
    """
    rounded = {}
    for name, pair in model.networks.items():
        with np.errstate(over="ignore"):
            halves = [[np.array(a, np.float16, order="C") for a in arrays] for arrays in pair]
        require_finite(name, halves, "within float16's range, +-65504")
        rounded[name] = tuple([a.astype(float) for a in arrays] for arrays in halves)
    return rounded


def require_finite(name, pair, expected):
    """Raise EncodeError unless all weights and biases of a network are finite."""
    is_finite = all(np.isfinite(a).all() for arrays in pair for a in arrays)
    require_encodable(is_finite, f"network {name}: expected finite weights {expected}")


def network_numbers(networks):
    """Return weights and biases of some networks in the order of the file, as one array."""
    layers = [layer for network in networks.values() for layer in zip(*network)]
    return np.concatenate([array.ravel() for pair in layers for array in pair])


def networks_of(numbers, shapes):
    """Return {name: (weights, biases)} from the shapes of layers and the numbers of networks."""
    sizes = [size for network in shapes.values() for I, J in network for size in (I * J, J)]
    arrays, networks = iter(np.split(numbers, np.cumsum(sizes))), {}
    for name, network in shapes.items():
        pairs = [(next(arrays).reshape(shape), next(arrays)) for shape in network]
        networks[name] = [W for W, _ in pairs], [b for _, b in pairs]
    return networks


def write_networks(networks):
    """Return all numbers of some networks as float16."""
    return network_numbers(networks).astype("<f2").tobytes()


def read_networks(data, section, shapes):
    """Return the networks {name: (weights, biases)} of a section, float64."""
    size = 2 * sum((I + 1) * J for network in shapes.values() for I, J in network)
    expect(len(data) == size, section, len(data), f"expected {size} bytes, found {len(data)}")
    numbers = np.frombuffer(data, "<f2")
    finite = np.isfinite(numbers)  # before the cast, which a signalling NaN makes warn on ARM
    expect(finite.all(), section, 2 * int(finite.argmin()), "expected finite weights")
    return networks_of(numbers.astype(float), shapes)
