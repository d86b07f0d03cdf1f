"""The golden oracle: published vectors, a checker for ports, a doctor for wrong answers.

    from p4dgs_ref import oracle
    print(oracle.check(my_offsets, "offsets"))  # judge a Python function
    oracle.path()  # the folder of the published vectors

What makes the vectors and proves them is in `tests/workshop` of a checkout.
"""

from .checker import Report, check, check_port
from .ports import FolderPort, FunctionPort, PortError
from .published import path, read_manifest
from .safetensors import TensorError

__all__ = [
    "FolderPort",
    "FunctionPort",
    "PortError",
    "Report",
    "TensorError",
    "check",
    "check_port",
    "path",
    "read_manifest",
]
