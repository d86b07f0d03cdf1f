"""Each method trained once on the small scene."""

import pytest

from .small import MODULES, SMALL


@pytest.fixture(scope="session")
def trained(scene):
    """{method: model}."""
    return {name: MODULES[name].Trainer(scene, SMALL[name], seed=1).run() for name in MODULES}
