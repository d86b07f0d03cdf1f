"""What several files of this room share."""

import pytest

from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.streams import export
from tests.oracle.answers import right, write


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """A folder with an export of the vectors, and what `export` returned."""
    folder = tmp_path_factory.mktemp("exported") / "v1"
    return folder, export(folder)


@pytest.fixture(scope="session")
def answered(tmp_path_factory):
    """A folder with right answers to the published equations, and to nothing else."""
    keys = (key for key, row in published.subjects().items() if row["level"] == "L1")
    return write(tmp_path_factory.mktemp("answered"), **{key: right(key) for key in keys})
