"""Tables of trainings: the paper's Table 3, lengths of training, effects."""
