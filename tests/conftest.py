"""`--share 1/2` and `--share 2/2` divide the chosen tests between two processes.

The header shows the seed of the short lane's samples.
"""

import pytest

import p4dgs_ref
from tests.sampling import SEED

# Before NumPy loads, as every command does it: processes that a test starts inherit this setting,
# and with another number of BLAS threads the last digits differ.
p4dgs_ref.prepare()


def pytest_addoption(parser):
    help_text = "run only the I-th of N equal shares of the chosen tests"
    parser.addoption("--share", metavar="I/N", default="1/1", help=help_text)


def pytest_report_header():
    return f"sampled tests: P4DGS_TEST_SEED={SEED}"


@pytest.hookimpl(trylast=True)  # after -m and -k have chosen
def pytest_collection_modifyitems(config, items):
    part, parts = map(int, config.getoption("--share").split("/"))
    if not 1 <= part <= parts:
        raise pytest.UsageError("--share: expected I/N with I from 1 to N")
    # Neighbours take about as long as each other, so the shares take turns.
    kept = items[part - 1 :: parts]
    chosen = set(kept)
    config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
    items[:] = kept
