import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy loads, for `python -m tests.oracle.training_variants`
