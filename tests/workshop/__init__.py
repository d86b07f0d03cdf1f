"""The workshop: what makes and judges the published files."""

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy loads: the same bits everywhere
