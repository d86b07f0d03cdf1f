"""The tests. They import `tests` and `tutorials` from the checkout, p4dgs_ref from wherever it is.

`pytest` puts the checkout last on the path: with `pip install .` the tests judge what was
installed, with `pip install -e .` or with nothing installed the checkout.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
