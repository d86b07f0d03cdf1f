"""From a trained model to one file and back, bit for bit.

The format, one page a file, from the outside in: `container` (the file), `file` and `header` (its sections), `context`
and `fixed_point` (how each symbol is to be coded), `gaussian_table` (its frequencies), `streams` (one section of symbols),
`rans` (the entropy coder).  `python -m p4dgs_ref.codec` prints them all, with the tables.
"""
