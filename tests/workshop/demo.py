"""`python -m tests.workshop.demo` makes the demo's file and keeps SHA-256 of it and of sixty steps.

They hold for the arithmetic that is kept with them: versions of NumPy and SciPy, and kernels.
"""

import hashlib
import json
from pathlib import Path

import p4dgs_ref as p4
from p4dgs_ref.arithmetic import arithmetic

from .proof import proof

DEMO = Path(__file__).parent / "data" / "demo.json"


def file(**changes):
    """The demo's file, or one of a preset with some fields changed."""
    return p4.encode(p4.train(p4.load_scene("bouncing"), preset="tiny", seed=0, **changes))


def sha256(data):
    """The SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def with_what():
    """The arithmetic without the version of this package."""
    return arithmetic().partition(", ")[2]


def kept():
    """What DEMO holds."""
    return json.loads(DEMO.read_text(encoding="utf-8"))


def main():
    """Make the file and keep what it is, and what sixty steps are."""
    kept = {**proof(), "arithmetic": with_what(), "tiny": sha256(file())}
    DEMO.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
