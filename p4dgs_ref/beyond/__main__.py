"""`python -m p4dgs_ref.beyond` prints what version 2 changes of the file, as one page.

`python -m p4dgs_ref.codec` prints the format of version 1.
"""

import json
from textwrap import fill

from ..codec.__main__ import numbered, print_page
from . import file, positions, weights


def page():
    """The page as text."""
    bases = [f'"{name}": {json.dumps(base)}' for name, base in file.BASES.items()]
    texts = {
        "file.py": file.__doc__,
        "positions.py": positions.__doc__,
        "weights.py": weights.__doc__,
        "Base designs": "\n\n".join(fill(base, 100) for base in bases),
    }
    return numbered("Version 2 of the file format of p4dgs_ref: what differs from version 1", texts)


if __name__ == "__main__":
    print_page(__package__, page)
