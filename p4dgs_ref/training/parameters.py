"""Named arrays that share one flat vector, so that the optimiser is one expression instead of forty."""

import numpy as np


class Parameters:
    """A dictionary of arrays, each a view into `vector`; writing to one writes to the other.

    Names of a network's arrays are "psi.W0", "psi.b0", "psi.W1", ...; `network("psi")` returns both lists.
    """

    def __init__(self, arrays, dtype=np.float32):
        self.vector = np.empty(sum(np.size(a) for a in arrays.values()), dtype)
        self.arrays, start = {}, 0
        for name, array in arrays.items():
            array = np.asarray(array)
            view = self.vector[start : start + array.size].reshape(array.shape)
            view[...] = array
            self.arrays[name] = view
            start += array.size

    def __getitem__(self, name):
        return self.arrays[name]

    def __contains__(self, name):
        return name in self.arrays

    def zeros(self):
        """The same names and shapes, all zero."""
        twin = Parameters(self.arrays, self.vector.dtype)
        twin.vector[:] = 0
        return twin

    def network(self, name):
        """Weights and biases of one network, in order of layers."""
        layers = sum(key.startswith(f"{name}.W") for key in self.arrays)
        return [self[f"{name}.W{i}"] for i in range(layers)], [
            self[f"{name}.b{i}"] for i in range(layers)
        ]

    def listed(self, name):
        """The arrays "name.0", "name.1", ... as a list."""
        count = sum(key.startswith(f"{name}.") for key in self.arrays)
        return [self[f"{name}.{i}"] for i in range(count)]

    def fill(self, name, gradients):
        """Copy one network's gradients {"weights": [...], "biases": [...]} into place; others in it are ignored."""
        for i, (W, b) in enumerate(zip(gradients["weights"], gradients["biases"])):
            self[f"{name}.W{i}"][...], self[f"{name}.b{i}"][...] = W, b

    def per_element(self, value_of):
        """A vector with `value_of(name)` at every element of each array."""
        values = np.array([value_of(name) for name in self.arrays], self.vector.dtype)
        return np.repeat(values, [array.size for array in self.arrays.values()])

    def with_rows(self, names, keep, extra):
        """A copy in which the arrays `names` keep only the rows `keep` and gain the rows `extra[name]` at the end."""
        changed = {name: np.concatenate([self[name][keep], extra[name]]) for name in names}
        return Parameters(
            {name: changed.get(name, array) for name, array in self.arrays.items()},
            self.vector.dtype,
        )


def random_layers(rng, name, shapes):
    """Initial arrays of a network from its layers' shapes: every entry uniform in +-1/sqrt(rows).

    Reference  PyTorch's default for linear layers, which the parents of the method leave in place
    """
    arrays = {}
    for i, (rows, columns) in enumerate(shapes):
        bound = 1 / np.sqrt(max(rows, 1))
        arrays[f"{name}.W{i}"] = rng.uniform(-bound, bound, (rows, columns))
        arrays[f"{name}.b{i}"] = rng.uniform(-bound, bound, columns)
    return arrays
