"""Known mistakes of encoders: intervals, escapes, order of symbols and words, what is stored."""

import numpy as np

from p4dgs_ref.codec.container import write_container
from p4dgs_ref.codec.file import NETWORK_SECTIONS
from tests.workshop.encoding import encoder_vjp, rans_vjp
from tests.workshop.mistakes.kit import known, surgery


def with_every_anchor(given):
    """A model in which anchors without a kept child keep all of theirs."""
    return {**given, "mask": given["mask"] | ~given["mask"].any(axis=1, keepdims=True)}


def other_parity(v):
    """The integers of the escapes with the two sides of the window exchanged."""
    return np.where(v > 0, v + np.where(v % 2 == 1, 1, -1), 0)


def whole(mu_units):
    return (mu_units + 512 >> 10) << 10


def first_symbol_first(given, _):
    turned = {name: given[name][::-1] for name in ("start", "freq")}
    return rans_vjp(**{**given, **turned})[0], {}


def bottom_first(given, _):
    """The words of the stack in the order in which they were pushed."""
    message = rans_vjp(**given)[0]["message"]
    head = 1 + 4 * (given["lanes"] > 1) + (8 if message[0] & 0x80 else 4)
    words = message[head:].reshape(-1, 4)[::-1].ravel()
    return {"message": np.concatenate([message[:head], words])}, {}


def outputs_first(given, _):
    """Layers as PyTorch stores them; the context is computed with the right ones."""
    right = encoder_vjp(**given)[0]
    turned = dict(given)
    for name, layers in given.items():
        if name.endswith("_weights"):
            turned[name] = [W.T.ravel().reshape(W.shape) for W in layers]
    wrong = encoder_vjp(**turned)[0]
    stored = {name: (wrong if name in NETWORK_SECTIONS else right)[name] for name in right}
    del stored["file"]
    sections = {name: a.tobytes() for name, a in stored.items()}
    file = write_container({"header": given["header"].encode(), **sections})
    return {**stored, "file": np.frombuffer(file, np.uint8)}, {}


MISTAKES = [
    known(
        "quantiser",
        "quantiser-keeps-masked-anchors",
        "anchors without a kept child are not left out",
        inputs=with_every_anchor,
    ),
    known(
        "frequencies",
        "frequencies-mean-whole",
        "the mean is rounded to whole symbols before the table is chosen",
        inputs={"mu_units": whole},
    ),
    known(
        "frequencies",
        "frequencies-escape-sides",
        "v of an escape has the two sides of the window exchanged: even above it, odd below",
        outputs={"v": other_parity},
    ),
    surgery(
        "rans",
        "rans-first-symbol-first",
        "the encoder pushes the first symbol first; the decoder pops it last",
        first_symbol_first,
    ),
    surgery(
        "rans",
        "rans-bottom-first",
        "the words of the stack are written in the order in which they were pushed",
        bottom_first,
    ),
    surgery(
        "encoder",
        "encoder-outputs-first",
        "layers are stored as (outputs, inputs), the transpose of W",
        outputs_first,
    ),
]
