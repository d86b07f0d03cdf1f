"""From a trained model to one file and back, bit for bit.

Read the format bottom-up, one page a file: `container` (the file), `streams` (one section),
`rans` (the entropy coder), `gaussian_table` (the frequencies of one symbol).
"""
