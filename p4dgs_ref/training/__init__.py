"""Fitting a scene: presets, the four stages, Adam, density control, checkpoints."""
