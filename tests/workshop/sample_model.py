"""A small model for tests of the codec, whose symbols follow its own prior."""

from dataclasses import replace

import numpy as np

from p4dgs_ref.codec.quantise import dequantise, quantise
from p4dgs_ref.model import Anchors, Design, Model, bounding_box
from p4dgs_ref.scenes.scene import MODEL_EFFECTS


def sample_model(seed, anchors, **fields):
    """A small model whose symbols follow its own prior, with a few far outside.

    `fields` replace those of the design.
    """
    rng = np.random.default_rng(seed)
    usual = dict(
        d=3,
        k=2,
        hidden=(4,),
        deformation=(3,),
        L_x=1,
        L_t=2,
        context=(4,),
        F=2,
        table=(20, 16),
        grid=(("xyz", 3), ("xy", 4), ("yz", 5)),
        Q_0=(0.5, 0.01, 0.02, 0.1),
        tau_alpha=0.0,
        effects=MODEL_EFFECTS,
    )
    design = Design(**{**usual, **fields})
    networks = {
        name: ([rng.normal(size=pair) for pair in pairs], [rng.normal(size=n) for _, n in pairs])
        for name, pairs in design.layers().items()
    }
    grids = [np.where(rng.random(shape) < 0.4, 1.0, -1.0) for shape in design.levels()]
    x_a, mask = rng.normal(size=(anchors, 3)), rng.random((anchors, design.k)) < 0.7
    mask[:, 0] = True  # every anchor keeps a child, so that none is dropped
    shapes = (design.d,), (3,), (3,), (design.k, 3)
    zeros = Anchors(x_a, *(np.zeros((anchors, *shape)) for shape in shapes), mask)
    model = Model(design, zeros, networks, grids, bounding_box(x_a), rng.random(3))
    ctx = quantise(model).context
    deviations = 2.0 ** (ctx.sigma_units / 16) * rng.normal(size=ctx.mu_units.shape)
    symbols = np.rint(ctx.mu_units / 1024 + deviations)
    symbols[rng.random(symbols.shape) < 0.03] -= 5e6
    f, s, l, O = dequantise(np.clip(symbols, -(2.0**30), 2.0**30), ctx, design)
    return replace(model, anchors=Anchors(x_a, f, s, l, O, mask))
