"""What the tests of the laboratory share."""

import pytest

from p4dgs_ref.lab.accuracy.harness import trained


@pytest.fixture(scope="session")
def short_model():
    """A model with so little training that only its arithmetic can be tested."""
    return trained(dict(anchors=60, downscale=2), 40)
