"""How a known mistake is defined: as the function that a port with this mistake would be.

`run(inputs, cotangents)` returns outputs and gradients. `edited` makes it of the equation's own
file with an expression or two replaced. `known` makes it of the right function by changing its
inputs or outputs, with the adjoint changes of the gradients. Where neither is enough, a file of
mistakes writes the function with the wrong step, and `surgery` names it.
"""

from functools import cache
from typing import Callable, NamedTuple

import numpy as np

from p4dgs_ref import EQUATIONS
from tests.equations.rules import altered
from tests.workshop import rewriting
from tests.workshop.rewriting import rewritten
from tests.workshop.subjects import subjects


class NotApplicable(Exception):
    """The mistake cannot be made in this case; a port with it answers right."""


class Mistake(NamedTuple):
    """One way in which ports go wrong."""

    id: str
    subject: str  # whose cases show it: an equation or a stage
    description: str  # what the port does instead, said to its author
    run: Callable  # (inputs, {"x_bar": array}) -> ({output: array}, {input: gradient})
    noisy: tuple = ()  # cases in which the answers are rounding noise: the doctor takes any
    room: str = ""  # to blame, where it is not the subject's equation

    @property
    def equation(self):
        """The equation or the part of a training to blame."""
        return self.room or subjects()[self.subject].equation


def bars_of(cotangents):
    """Return {"x": a} of {"x_bar": a}."""
    return {name.removesuffix("_bar"): bar for name, bar in cotangents.items()}


def port(key, inputs=None, inputs_bar=None, outputs=None, outputs_bar=None):
    """Return `run` of a port that is the right function with some arrays changed.

    Each argument is {name: function of that array}, or one function of whole dictionaries:

    inputs       f(x) or f(inputs): what the right function is given instead
    inputs_bar   f(bar, x) or f(bars, inputs): the gradient that the port returns instead
    outputs      f(y) or f(out, inputs): the output that the port returns instead
    outputs_bar  f(bar, y) or f(bars, out, inputs): the cotangent that the right pullback is given
    """

    def run(given, cotangents):
        bars = bars_of(cotangents)
        out, pullback = subjects()[key].vjp(**changed(inputs, given, (), (given,)))
        shown = changed(outputs, out, (), (out, given))
        bars = changed(outputs_bar, bars, (out,), (bars, out, given))
        in_bar = pullback(**{name + "_bar": bar for name, bar in bars.items()})
        return shown, changed(inputs_bar, in_bar, (given,), (in_bar, given))

    return run


def changed(change, tree, others, whole):
    """Return `tree` with some entries changed.

    `change` is one function of `whole`, or {name: function of the entry and of its namesakes in the
    trees `others`}.
    """
    if callable(change):
        return change(*whole)
    return {
        **tree,
        **{
            name: f(tree[name], *(other[name] for other in others))
            for name, f in (change or {}).items()
        },
    }


def known(subject, id, description, **changes):
    """Return a mistake that is defined by the arguments of `port`."""
    return Mistake(id, subject, description, port(subject, **changes))


def surgery(subject, id, description, run, room=""):
    """Return a mistake whose function is written out."""
    return Mistake(id, subject, description, run, room=room)


def edited(subject, id, description, changes, helper=None):
    """Return a mistake that is the equation's own file with some of its text replaced."""

    wrong = cache(lambda: rewriting.edited(subject, changes, helper))

    def run(given, cotangents):
        outputs, pullback = wrong().vjp(**given)
        return outputs, pullback(**cotangents)

    return Mistake(id, subject, description, run)


def with_module(subject, id, description, module, imported, wrong):
    """Return a mistake that is the equation's own file with another `module` in place of its own.

    `imported` is the line of the file that imports it, and what stands there instead.
    """

    @cache
    def names():
        place = EQUATIONS[subject].module.__name__
        return rewritten(place, dict([imported]), **{module: wrong()})

    def run(given, cotangents):
        both = names()
        eq = altered(EQUATIONS[subject], forward=both["forward"], backward=both["backward"])
        outputs, pullback = eq.vjp(**given)
        return outputs, pullback(**cotangents)

    return Mistake(id, subject, description, run)


# --- transformations that recur -----------------------------------------------------------------
def without(name):
    """The changes that leave an input out of the formula."""
    return dict(inputs={name: np.zeros_like}, inputs_bar={name: no_gradient})


def given_as(**changes):
    """Other inputs or settings that receive no gradient: name -> f(inputs)."""
    return dict(inputs=lambda given: {**given, **{name: f(given) for name, f in changes.items()}})


def no_gradient(bar, _):
    return np.zeros_like(bar)


def inverse(order):
    return np.argsort(order)


def first_rows(order):
    """The changes that concatenate a network's input in another order.

    Column i is our column order(inputs)[i].
    """

    def rows(tree, index):
        return {**tree, "weights": [tree["weights"][0][index], *tree["weights"][1:]]}

    return dict(
        inputs=lambda given: rows(given, inverse(order(given))),
        inputs_bar=lambda bars, given: rows(bars, order(given)),
    )


def layer_transposed(i):
    """The changes that transpose one layer where its shape does not give that away."""

    def transposed(weights, *_):
        at = range(len(weights))[i] if -len(weights) <= i < len(weights) else None
        return [squares_transposed([W])[0] if j == at else W for j, W in enumerate(weights)]

    return dict(inputs={"weights": transposed}, inputs_bar={"weights": transposed})


def squares_transposed(weights, *_):
    """The transpose of every weight whose shape does not give it away."""
    return [W.T if W.shape[0] == W.shape[1] else W for W in weights]


def last_columns(order):
    """The changes that split a network's output in another order.

    Where we read column c, the port reads column order(inputs)[c].
    """

    def columns(tree, index):
        weights, biases = tree["weights"], tree["biases"]
        return {
            **tree,
            "weights": [*weights[:-1], weights[-1][:, index]],
            "biases": [*biases[:-1], biases[-1][index]],
        }

    return dict(
        inputs=lambda given: columns(given, order(given)),
        inputs_bar=lambda bars, given: columns(bars, inverse(order(given))),
    )


def component_major(width):
    """The changes that read k children of `width` numbers each component by component."""
    return last_columns(
        lambda given: np.arange(len(given["biases"][-1])).reshape(width, -1).T.ravel()
    )


def hac_order(given):
    """The order f_a, d_vc, delta_vc of HAC; our order where the scene has no view inputs."""
    d, view = given["f_a"].shape[1], given["d_vc"].shape[1]
    return np.array([*range(d), *range(d + 1, d + 1 + view), *([d] if view else [])])


def relu(y):
    return np.maximum(y, 0), (y > 0).astype(y.dtype)
