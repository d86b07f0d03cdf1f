"""One small scene, and each method trained once on it."""

import pytest

from p4dgs_ref.scenes import load_scene

from .small import MODULES, SMALL


@pytest.fixture(scope="session")
def scene():
    return load_scene("bouncing", downscale=4)


@pytest.fixture(scope="session")
def trained(scene):
    """{method: model}."""
    return {name: MODULES[name].Trainer(scene, SMALL[name], seed=1).run() for name in MODULES}
