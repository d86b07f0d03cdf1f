"""Reverse-mode differentiation by the textbook, whose roundings can be made larger.

It is what an automatic differentiation gives for a formula that is typed as it is printed: every
operation is differentiated by its textbook rule, 1 - tanh(y)**2 among them. Each result, forward
and backward, goes through a function `rounded`, which casts it to a precision or disturbs it.
"""

import itertools

import numpy as np

COUNT = itertools.count()


class Value:
    """An array, the values that it was computed from, and the slope with respect to each."""

    def __init__(self, array, rounded, parents=()):
        self.array = rounded(np.asarray(array)) if parents else np.asarray(array)
        self.rounded, self.parents = rounded, parents  # pairs of Value and pullback
        self.number = next(COUNT)

    def made(self, array, *parents):
        """Return the result of an operation on this value."""
        return Value(array, self.rounded, parents)

    def of(self, other):
        """Return another operand as a Value; numbers take the precision of this one."""
        is_value = isinstance(other, Value)
        return other if is_value else Value(np.asarray(other, self.array.dtype), self.rounded)

    def __add__(self, other):
        a, b = self, self.of(other)
        return self.made(a.array + b.array, (a, lambda bar: bar), (b, lambda bar: bar))

    def __sub__(self, other):
        a, b = self, self.of(other)
        return self.made(a.array - b.array, (a, lambda bar: bar), (b, lambda bar: -bar))

    def __rsub__(self, other):
        return self.of(other) - self

    def __mul__(self, other):
        a, b = self, self.of(other)
        return self.made(
            a.array * b.array, (a, lambda bar: bar * b.array), (b, lambda bar: bar * a.array)
        )

    def __truediv__(self, other):
        a, b = self, self.of(other)
        return self.made(
            a.array / b.array,
            (a, lambda bar: bar / b.array),
            (b, lambda bar: -bar * a.array / (b.array * b.array)),
        )

    def __matmul__(self, other):
        a, b = self, self.of(other)
        return self.made(
            a.array @ b.array,
            (a, lambda bar: bar @ b.array.swapaxes(-1, -2)),
            (b, lambda bar: a.array.swapaxes(-1, -2) @ bar),
        )

    __radd__, __rmul__ = __add__, __mul__

    def sqrt(self):
        """Return the square root."""
        root = self.made(np.sqrt(self.array), (self, lambda bar: bar / (2 * root.array)))
        return root

    def exp(self):
        """Return the exponential."""
        power = self.made(np.exp(self.array), (self, lambda bar: bar * power.array))
        return power

    def expm1(self):
        """Return exp - 1, whose slope is the exponential."""
        return self.made(np.expm1(self.array), (self, lambda bar: bar * np.exp(self.array)))

    def log(self):
        """Return the natural logarithm."""
        return self.made(np.log(self.array), (self, lambda bar: bar / self.array))

    def tanh(self):
        """Return tanh, with the slope 1 - tanh**2."""

        def pullback(bar):
            t = Value(alpha.array, self.rounded)
            return bar * (1 - t * t).array

        alpha = self.made(np.tanh(self.array), (self, pullback))
        return alpha

    def sigmoid(self):
        """Return 1 / (1 + exp(-y)), with the slope s (1 - s)."""

        def pullback(bar):
            s = Value(color.array, self.rounded)
            return bar * (s * (1 - s)).array

        color = self.made(1 / (1 + np.exp(-self.array)), (self, pullback))
        return color

    def absolute(self):
        """Return the absolute value, with the slope 0 at 0."""
        return self.made(np.abs(self.array), (self, lambda bar: bar * np.sign(self.array)))

    def at_least(self, bound):
        """Return the maximum with a number or an array, with the slope 0 on the bound."""
        above = self.array > bound
        return self.made(np.where(above, self.array, bound), (self, lambda bar: bar * above))

    def where(self, mask):
        """Return 0, with the slope 0, where `chosen` is false."""
        return self.made(np.where(mask, self.array, 0), (self, lambda bar: np.where(mask, bar, 0)))

    def sum(self, axis=None):
        """Return the sum over an axis, which is kept, or over everything."""
        total = self.array.sum(axis, keepdims=axis is not None)
        return self.made(total, (self, lambda bar: np.broadcast_to(bar, self.array.shape)))

    def mean(self):
        """Return the mean over everything."""
        return self.sum() / float(self.array.size)

    def transposed(self):
        """Return the matrices with their two axes exchanged."""
        return self.made(self.array.swapaxes(-1, -2), (self, lambda bar: bar.swapaxes(-1, -2)))

    def reshape(self, *shape):
        """Return the value in another shape."""
        return self.made(
            self.array.reshape(shape), (self, lambda bar: bar.reshape(self.array.shape))
        )


def side_by_side(values):
    """Return matrices joined along their columns."""
    ends = np.cumsum([0, *(v.array.shape[1] for v in values)])
    parts = [
        (v, lambda bar, low=low, high=high: bar[:, low:high])
        for v, low, high in zip(values, ends, ends[1:])
    ]
    return values[0].made(np.concatenate([v.array for v in values], axis=1), *parts)


def gradients(outputs, bars, inputs):
    """Return the gradient of every input, given outputs and the cotangent of each."""
    gathered, waiting = {}, {}

    def add(value, bar):
        # One number of a smaller array was used several times: its gradients are added up.
        extra = bar.ndim - value.array.ndim
        bar = bar.sum(axis=tuple(range(extra)))
        repeated = [i for i, n in enumerate(value.array.shape) if n == 1 and bar.shape[i] != 1]
        bar = value.rounded(bar.sum(axis=tuple(repeated), keepdims=True))
        known = gathered.get(value.number)
        gathered[value.number] = bar if known is None else value.rounded(known + bar)
        waiting[value.number] = value

    for value, bar in zip(outputs, bars):
        add(value, np.asarray(bar, value.array.dtype))
    while waiting:
        value = waiting.pop(max(waiting))
        for parent, pullback in value.parents:
            add(parent, np.asarray(pullback(gathered[value.number]), value.array.dtype))
    return [gathered.get(v.number, np.zeros_like(v.array)) for v in inputs]
