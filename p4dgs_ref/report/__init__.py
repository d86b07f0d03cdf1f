"""Evaluate a file, draw a run, inspect bytes, the main job."""
