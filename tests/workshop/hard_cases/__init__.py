"""The catalogue of hard cases: how its inputs are made, and what the usual formulas make of them.

The cases are published as vectors; `publish` writes what `p4dgs-ref stability` shows besides.
"""
