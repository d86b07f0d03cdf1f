"""What accuracy costs in time: work-precision studies, each with its diagrams, its tables and a reading of them."""

from .report import STUDIES, describe, run, summary

__all__ = ["STUDIES", "describe", "run", "summary"]
