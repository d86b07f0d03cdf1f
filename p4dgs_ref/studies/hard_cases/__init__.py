"""Hard cases: what each equation promises, the catalogue with true values of 50 digits, the search for trouble, the map."""
