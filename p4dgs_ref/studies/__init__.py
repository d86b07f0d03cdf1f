"""What is measured and drawn: evaluation, the report of a run, the benchmark."""
