"""Hard cases: inputs for which a correct formula returns wrong numbers, and what ours returns."""
