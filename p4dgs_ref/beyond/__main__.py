"""`python -m p4dgs_ref.beyond` prints what version 2 changes of the file, as one page.

`python -m p4dgs_ref.codec` prints the format of version 1.
"""

import json
import sys
from textwrap import fill

from ..codec.__main__ import numbered
from . import file, positions, weights


def page():
    """The page as text."""
    bases = [f'"{name}": {json.dumps(base)}' for name, base in file.BASES.items()]
    texts = {
        "file.py": file.__doc__ or "",
        "positions.py": positions.__doc__ or "",
        "weights.py": weights.__doc__ or "",
        "Base designs": "\n\n".join(fill(base, 100) for base in bases),
    }
    return numbered("Version 2 of the file format of p4dgs_ref: what differs from version 1", texts)


if __name__ == "__main__":
    sys.stdout.write(page())
