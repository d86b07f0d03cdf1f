"""What accuracy costs in time: one table of knobs, what measures them, one page of answers."""
