"""The known mistakes once more, as a careless port would have written them: patches of our own source.

PATCHES   {id: [(file below p4dgs_ref, old text, new text), ...]}, every old text standing once in its file
patched   applies one for a while: with patched("offsets-not-scaled"): ...

They share nothing with `p4dgs_ref.oracle.mistakes`, so that a mistake which the doctor names is not its own invention.
Cases whose closed forms are computed by `forward` must be made before a patch is applied.
"""

import ast
import importlib
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np

import p4dgs_ref
from tests.golden import (
    patches_coding,
    patches_deformation,
    patches_losses,
    patches_prediction,
    patches_splatting,
    patches_stages,
)

ROOT = Path(p4dgs_ref.__file__).parent
TABLES = (
    patches_prediction,
    patches_deformation,
    patches_splatting,
    patches_losses,
    patches_coding,
    patches_stages,
)
PATCHES = {}
for _table in TABLES:
    for _file, _patches in _table.PATCHES.items():
        for _id, _edits in _patches.items():
            PATCHES.setdefault(_id, []).extend((_file, *edit) for edit in _edits)


def patched_source(file, edits):
    """The text of a file after edits [(old, new), ...]."""
    text = (ROOT / file).read_text(encoding="utf-8")
    for old, new in edits:
        if text.count(old) != 1:
            raise ValueError(f"{file}: {text.count(old)} times, expected once: {old!r}")
        text = text.replace(old, new)
    return text


def load(module, text):
    """What a file defines once patched: {name: value}; equations are not declared a second time."""
    tree = ast.parse(text)
    tree.body = [
        s
        for s in tree.body
        if not (
            isinstance(s, ast.Assign)
            and isinstance(s.value, ast.Call)
            and getattr(s.value.func, "id", "") == "declare"
        )
    ]
    scratch = {"__name__": module.__name__, "__package__": module.__package__}
    exec(compile(tree, module.__file__, "exec"), scratch)
    return scratch


def same(old, new):
    """Whether two module-level values are equal; a class of the module's own is known by its fields."""
    if isinstance(new, (FunctionType, ModuleType)):
        return old is new
    if isinstance(new, type):
        return getattr(old, "_fields", None) == getattr(new, "_fields", None)
    if isinstance(new, (np.ndarray, np.generic, int, float, str, tuple)):
        return np.array_equal(old, new)
    return True


@contextmanager
def patched(id):
    """Our package with one known mistake in it, for all who already hold its functions."""
    files = {
        file: [edit[1:] for edit in PATCHES[id] if edit[0] == file] for file, *_ in PATCHES[id]
    }
    codes, names = [], []  # what to put back
    try:
        for file, edits in files.items():
            module = importlib.import_module(
                "p4dgs_ref." + file.removesuffix(".py").replace("/", ".")
            )
            for name, new in load(module, patched_source(file, edits)).items():
                old = vars(module).get(name)
                own = isinstance(new, FunctionType) and new.__module__ == module.__name__
                if own and isinstance(old, FunctionType) and old.__module__ == module.__name__:
                    codes.append((old, old.__code__, old.__defaults__))
                    old.__code__, old.__defaults__ = new.__code__, new.__defaults__
                elif own or not same(old, new):
                    names.append((vars(module), name, name in vars(module), old))
                    vars(module)[name] = new
        yield
    finally:
        for function, code, defaults in codes:
            function.__code__, function.__defaults__ = code, defaults
        for namespace, name, existed, old in reversed(names):
            if existed:
                namespace[name] = old
            else:
                del namespace[name]
