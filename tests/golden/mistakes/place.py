"""Puts a known mistake in the place of an equation or a stage, for all who call it."""

from contextlib import contextmanager
from importlib import import_module
from inspect import signature
from unittest.mock import patch

import numpy as np

from p4dgs_ref.lab.baselines import ALL_EQUATIONS
from tests.golden.mistakes.kit import NotApplicable
from tests.golden.subjects import subjects


@contextmanager
def in_place(mistake):
    """While the context lasts, the package has the mistake.

    The definition of a mistake may call the right functions; it always gets those.
    """
    if mistake.subject not in ALL_EQUATIONS:
        with patch.dict(subjects(), {mistake.subject: mistaken_subject(mistake)}):
            yield
        return
    module = import_module(ALL_EQUATIONS[mistake.subject].module)
    right = {"forward": module.forward, "backward": module.backward}
    wrong = mistaken_functions(mistake, module, right)
    with patch.multiple(module, **wrong):
        yield


def mistaken_subject(mistake):
    """Return a stage with the mistake."""
    stage = subjects()[mistake.subject]

    def vjp(**inputs):
        with patch.dict(subjects(), {stage.key: stage}):
            outputs, pullback = stage.vjp(**inputs)
            wrong = answered(mistake, inputs, outputs, pullback, {})[0]

        def wrong_pullback(**cotangents):
            with patch.dict(subjects(), {stage.key: stage}):
                return answered(mistake, inputs, outputs, pullback, cotangents)[1]

        return wrong, wrong_pullback

    return stage._replace(vjp=vjp)


def mistaken_functions(mistake, module, right):
    """Return forward and backward of an equation with the mistake."""
    eq = ALL_EQUATIONS[mistake.subject]
    forward_signature, backward_signature = map(signature, right.values())

    def forward(*arguments, **keywords):
        inputs = forward_signature.bind(*arguments, **keywords).arguments
        with patch.multiple(module, **right):
            outputs, pullback = eq.vjp(**inputs)
            wrong = answered(mistake, inputs, outputs, pullback, {})[0]
        values = tuple(wrong[name] for name in eq.outputs)
        return values if len(values) > 1 else values[0], (inputs, outputs, pullback)

    def backward(*arguments, **keywords):
        saved, *_ = arguments
        given = backward_signature.bind(*arguments, **keywords).arguments
        bars = {n: bar for n, bar in given.items() if n.endswith("_bar") and bar is not None}
        with patch.multiple(module, **right):
            return answered(mistake, *saved, bars)[1]

    forward.__signature__, backward.__signature__ = forward_signature, backward_signature
    return {"forward": forward, "backward": backward}


def answered(mistake, inputs, outputs, pullback, bars):
    """Return a mistake's outputs and gradients; the right ones where it does not apply.

    Cotangents that are left out are zero.
    """
    cotangents = {}
    for name, a in outputs.items():
        if np.asarray(a).dtype.kind == "f":
            cotangents[name + "_bar"] = bars.get(name + "_bar", np.zeros_like(a))
    try:
        return mistake.run(inputs, cotangents)
    except NotApplicable:
        return outputs, pullback(**cotangents)
