"""What each command does: one thin function a command, around one call of the Python face.

Imports stand inside the functions, so that `p4dgs-ref --help` is quick and an error in an option comes first.
"""

from .base import UsageError
from .job import (
    bench,
    decode,
    demo,
    encode,
    equations,
    evaluate,
    inspect,
    presets,
    render,
    simulate,
    train,
)
from .oracle import oracle_check, oracle_export, oracle_list, oracle_path
from .school import classroom, grade
from .study import accuracy, effects, stability

__all__ = [
    "UsageError",
    "accuracy",
    "bench",
    "classroom",
    "decode",
    "demo",
    "effects",
    "encode",
    "equations",
    "evaluate",
    "grade",
    "inspect",
    "oracle_check",
    "oracle_export",
    "oracle_list",
    "oracle_path",
    "presets",
    "render",
    "simulate",
    "stability",
    "train",
]
