"""Cases of Eq. (5)."""

import numpy as np

from p4dgs_ref.lab.random_inputs import random_field

from . import Case


def cases():
    rng = np.random.default_rng(10)
    x, t = rng.uniform(-1.3, 1.3, size=(7, 3)), 0.3
    field = random_field(rng, 2, 1, 6, 5)
    yield Case("ordinary", dict(x=x, t=t, **field))
    yield Case("start", dict(x=x, t=0.0, **field), ("zero",))
    yield Case("no_rows", dict(x=x[:0], t=t, **field), ("empty",))
    for name, heads in (("moves_only", (3, 0, 0)), ("turns_only", (0, 0, 4)), ("rests", (0, 0, 0))):
        yield Case(name, dict(x=x, t=t, **random_field(rng, 2, 1, 6, 5, heads=heads)), ("off",))
    yield Case("paper_frequencies", dict(x=x, t=t, **random_field(rng, 10, 6, 8, 6)), ("extreme",))
    square = random_field(np.random.default_rng(11), 0, 0, 4, 4)
    yield Case("square_trunk", dict(x=x[:2], t=t, **square), ("ordinary",))
    yield Case("no_trunk", dict(x=x, t=t, **random_field(rng, 1, 2)), ("single",))
