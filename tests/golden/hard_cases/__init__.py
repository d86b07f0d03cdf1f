"""The catalogue of hard cases: how its inputs are made, and its true values to 50 digits.

The package holds the same cases as data; `python -m tests.golden.hard_cases.publish` writes them.
"""
