"""Draws scenes from a description: shapes, motions, light and a ray tracer."""

from .simulate import simulate

__all__ = ["simulate"]
