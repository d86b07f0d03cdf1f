"""What makes the pages, pictures and notebooks of the tutorials."""

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy loads: the same numbers everywhere
