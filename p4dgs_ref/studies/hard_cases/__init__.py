"""Hard cases: inputs on which a formula that is right gives wrong numbers, and what ours gives."""
