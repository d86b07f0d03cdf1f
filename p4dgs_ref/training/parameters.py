"""Named arrays that share one flat vector, Adam, which moves them all at once, and its schedule."""

from math import sqrt

import numpy as np

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15  # as in all methods that P-4DGS builds on


class Parameters:
    """A dictionary of arrays that are views of `vector`: writing to one writes to the other.

    The arrays of a network are named "psi.W0", "psi.b0", "psi.W1" and so on.
    """

    def __init__(self, arrays, dtype=np.float32):
        self.vector = np.concatenate([a.ravel() for a in arrays.values()]).astype(dtype)
        self.arrays, start = {}, 0
        for name, a in arrays.items():
            end = start + a.size
            self.arrays[name] = self.vector[start:end].reshape(a.shape)
            start = end

    def __getitem__(self, name):
        return self.arrays[name]

    def zeros(self):
        """Return Parameters of the same names and shapes, filled with zeros."""
        zeros = Parameters(self.arrays, self.vector.dtype)
        zeros.vector[...] = 0
        return zeros

    def arrays_of(self, prefix):
        """Return the arrays whose names begin with the prefix, in their order."""
        return [array for name, array in self.arrays.items() if name.startswith(prefix)]

    def network(self, name):
        """Return the weights and the biases of a network, layer by layer."""
        return self.arrays_of(f"{name}.W"), self.arrays_of(f"{name}.b")

    def fill(self, name, gradients):
        """Copy the "weights" and "biases" among the gradients of a network into place."""
        for i, (W, b) in enumerate(zip(gradients["weights"], gradients["biases"])):
            self[f"{name}.W{i}"][...] = W
            self[f"{name}.b{i}"][...] = b

    def per_element(self, number_of):
        """Return a vector with `number_of(name)` at every element of each array."""
        values = np.array([number_of(name) for name in self.arrays], self.vector.dtype)
        return np.repeat(values, [array.size for array in self.arrays.values()])

    def with_rows(self, names, keep, extra):
        """Return a copy whose arrays `names` keep the rows `keep` and end with `extra[name]`."""
        changed = {name: np.concatenate([self[name][keep], extra[name]]) for name in names}
        return Parameters(self.arrays | changed, self.vector.dtype)


def random_layers(rng, name, shapes):
    """Return a network's first arrays: every entry uniform in +-1/sqrt(rows) of its layer.

    This is PyTorch's default for linear layers, which the methods that P-4DGS builds on use.
    """
    arrays = {}
    for i, (rows, columns) in enumerate(shapes):
        bound = 1 / np.sqrt(rows)
        arrays[f"{name}.W{i}"] = rng.uniform(-bound, bound, (rows, columns))
        arrays[f"{name}.b{i}"] = rng.uniform(-bound, bound, columns)
    return arrays


class Adam:
    """Adam (Kingma and Ba 2015); each array counts its steps from the first one it takes part in.

    `first` and `second` are the moments as Parameters with the layout of the optimised parameters,
    so that rows can be added and removed together.
    """

    def __init__(self, parameters):
        self.first, self.second = parameters.zeros(), parameters.zeros()
        self.steps = dict.fromkeys(parameters.arrays, 0)

    def step(self, parameters, gradients, learning_rate):
        """Move `parameters` in place.

        `learning_rate(name)` is the learning rate of an array, 0 for one that does not take part.
        """
        lengths = {}
        for name in self.steps:
            size = learning_rate(name)
            self.steps[name] += size > 0
            n = self.steps[name]
            # Both moments start at zero; dividing by the sum of their weights corrects for that.
            corrected = size * sqrt(1 - BETA_2**n)
            lengths[name] = corrected / (1 - BETA_1**n) if size else 0.0
        m, v, g = self.first.vector, self.second.vector, gradients.vector
        m += (1 - BETA_1) * (g - m)
        v += (1 - BETA_2) * (g * g - v)
        parameters.vector -= m / (np.sqrt(v) + EPSILON) * parameters.per_element(lengths.get)


def learning_rate_at(step, first, last, until, start=0):
    """Return the learning rate at `step`: geometric from `first` at `start` to `last` at `until`.

    This is the schedule of Kerbl et al. 2023 without its warm-up, which no successor uses.
    """
    if first == last:
        return first
    share = min(max((step - start) / max(until - start, 1), 0.0), 1.0)
    return float(np.exp((1 - share) * np.log(first) + share * np.log(last)))
