"""The handout: one page with all equations of the paper and the gradients of the code."""

import hashlib
import re

import pytest

from p4dgs_ref.splatting.table import EQUATIONS
from tutorials.tools import handout
from tutorials.tools.shared import FOLDER

# Of the printed gradients, each of which was written once more in NumPy and compared with the
# `backward` of its equation on a published case. Where one changes, do this again.
DIGEST = "a6bdccc254b8"


def test_gradients_are_those_that_were_compared_with_the_code():
    gradients = "".join(row.gradients for row in handout.ROWS)
    assert hashlib.sha256(gradients.encode()).hexdigest()[:12] == DIGEST


def test_all_equations_of_the_paper_are_on_the_page():
    numbers = [row.number for row in handout.ROWS if row.number]
    assert list(dict.fromkeys(numbers)) == [f"({i})" for i in range(1, 18)]
    for row in handout.ROWS:
        number = EQUATIONS[row.key].number.rstrip("'")
        assert row.number in ("", f"({number})"), row.key


def test_file_is_one_small_page():
    data = (FOLDER / "handout.pdf").read_bytes()
    assert data.startswith(b"%PDF-") and len(data) < 200_000
    assert len(re.findall(rb"/Type /Page\b", data)) == 1


@pytest.mark.slow
def test_file_is_the_same_in_every_run(tmp_path):
    for name in ("a.pdf", "b.pdf"):
        handout.save(tmp_path / name)
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
