"""The golden oracle: vectors for ports, a checker that names the wrong equation, a doctor that says what is wrong with it.

from p4dgs_ref import oracle
print(oracle.check(my_offsets, "offsets"))          # judge a Python function
oracle.path()                                       # where the vectors are installed
"""

from ..lazy import offer

_HOME = {
    "check": "checker",
    "check_port": "checker",
    "Report": "checker",
    "path": "vectors",
    "read_manifest": "vectors",
    "FolderPort": "ports",
    "FunctionPort": "ports",
    "PortError": "ports",
    "TensorError": "safetensors",
}
__all__ = sorted(_HOME)
__getattr__, __dir__ = offer(__name__, _HOME)
