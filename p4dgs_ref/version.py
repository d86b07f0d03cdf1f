"""The version of the package, which setup.cfg reads here without an import."""

__version__ = "1.0.0"
