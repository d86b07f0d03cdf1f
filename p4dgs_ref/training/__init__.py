"""Fitting a scene: presets, the four stages, growing and pruning, checkpoints."""
