"""The golden oracle: vectors for ports, a checker that names the wrong equation, a doctor that says what is wrong with it.

    from p4dgs_ref import oracle
    print(oracle.check(my_offsets, "offsets"))          # judge a Python function
    oracle.path()                                       # where the vectors are installed
"""
from importlib import import_module

_HOME = {"check": "checker", "check_port": "checker", "Report": "checker", "path": "vectors", "read_manifest": "vectors",
         "FolderPort": "ports", "FunctionPort": "ports", "PortError": "ports", "TensorError": "safetensors"}
__all__ = sorted(_HOME)


def __getattr__(name):
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value


def __dir__():
    return sorted({*globals(), *__all__})
