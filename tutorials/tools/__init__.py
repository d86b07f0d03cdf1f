"""What makes the pages, pictures and notebooks of the tutorials, and what tutorials draw with."""

import sys

import p4dgs_ref

if "numpy" not in sys.modules:  # as in a tutorial, which imports what it draws with later
    p4dgs_ref.prepare()  # the same numbers everywhere
