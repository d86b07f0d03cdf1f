"""From a trained model to one file and back, bit for bit.

The docstrings of these modules are the specification of the file format. From the outside in:
`container` is the file, `file` and `header` are its sections, `context` says how each symbol is
coded, `gaussian_table` gives its frequencies, `streams` is one section of symbols, and `rans` is
the entropy coder. `python -m p4dgs_ref.codec` prints them as one page, with the tables.
"""
