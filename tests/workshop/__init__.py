"""The workshop: what makes the published files. README.md says which module makes which file."""

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy loads: the same bits everywhere
