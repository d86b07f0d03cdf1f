"""Cases of G4."""

import numpy as np

from tests.golden.cases import Case


def cases():
    rng = np.random.default_rng(34)
    inputs = dict(sh=rng.normal(size=(2, 3, 4, 9)), mu_t=rng.uniform(size=2), t=0.37)
    yield Case("ordinary", inputs)
    yield Case("no_gaussians", dict(sh=inputs["sh"][:0], mu_t=np.zeros(0), t=0.37), ("empty",))
    yield Case(
        "no_waves",
        {**inputs, "sh": inputs["sh"][:, :, :1]},
        ("off",),
        expected={"sh_t": inputs["sh"][:, :, 0]},
    )
    sh = inputs["sh"][:1, :, :3, :1]
    bar = np.array([[[1.0], [10], [100]]])
    yield Case(
        "a_quarter_of_a_period",
        dict(sh=sh, mu_t=np.array([0.25]), t=0.5),
        ("single", "negative"),
        cotangents={"sh_t_bar": bar},
        expected={
            "sh_t": sh[:, :, 0] - sh[:, :, 2],
            "sh_bar": bar[:, :, None] * np.array([1.0, 0, -1])[:, None],
            "mu_t_bar": 2 * np.pi * np.array([(sh[:, :, 1] * bar).sum()]),
        },
    )
    yield Case(
        "at_its_mean",  # all waves at their crest: no slope along time
        dict(sh=sh, mu_t=np.array([0.37]), t=0.37),
        ("single", "zero"),
        cotangents={"sh_t_bar": bar},
        expected={
            "sh_t": sh.sum(axis=2),
            "sh_bar": bar[:, :, None] * np.ones((3, 1)),
            "mu_t_bar": np.zeros(1),
        },
    )
    yield Case(
        "a_period_and_a_quarter",
        dict(sh=sh, mu_t=np.array([-0.75]), t=0.5),
        ("single", "negative"),
        cotangents={"sh_t_bar": bar},
        expected={
            "sh_t": sh[:, :, 0] - sh[:, :, 2],
            "sh_bar": bar[:, :, None] * np.array([1.0, 0, -1])[:, None],
            "mu_t_bar": 2 * np.pi * np.array([(sh[:, :, 1] * bar).sum()]),
        },
    )
