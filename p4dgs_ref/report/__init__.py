"""The main job, and what it shows: a file evaluated, a run drawn, its bytes listed."""
