"""What a teacher should look at: files that are alike, and names that no equation needs.

Two files of an equation are alike if their texts are equal, or if most statements of one are in the
other, apart from names, comments, docstrings and layout. Short equations are alike by chance.
"""

import ast
import re
from functools import cache
from itertools import combinations

from .room import source_of, stub

ALIKE = 0.8  # of the written text; below 0.4 for tutorials that compute the same
MIN_CHARACTERS = 200  # in both; a name counts as one
UNUSUAL = {
    *("__builtins__", "__globals__", "__import__", "__subclasses__", "__traceback__", "_getframe"),
    *("builtins", "compile", "ctypes", "eval", "exec", "f_back", "f_globals", "f_locals"),
    *("fromfile", "gc", "globals", "importlib", "inspect", "io", "linecache", "loadtxt", "memmap"),
    *("multiprocessing", "open", "os", "pathlib", "pickle", "posix", "runpy", "subprocess", "sys"),
    *("tb_frame", "threading", "traceback", "vars"),
}


def pairs(works):
    """Return the pairs that are alike, {"students": [one, other], "keys": their equations}.

    `works` is [(student, {key: source})]; sources that were not begun are "". Everybody is also
    compared with the key.
    """
    solved = ("the key", {key: source_of(key) for _, sources in works for key in sources})
    found = [
        {"students": [one, other], "keys": [key for key in a if are_alike(key, a[key], b[key])]}
        for (one, a), (other, b) in combinations([*works, solved], 2)
    ]
    return [pair for pair in found if pair["keys"]]


def are_alike(key, one, other):
    """Return whether two sources of an equation are alike."""
    mine, theirs = (statements(source) - statements(stub(key)) for source in (one, other))
    same, *lengths = (len("".join(lines)) for lines in (mine & theirs, mine, theirs))
    return one == other != "" or same >= max(ALIKE * min(lengths), MIN_CHARACTERS)


@cache
def statements(source):
    """Return the statements of all functions in a file, a set.

    A statement has "_" in place of names, except those of attributes. Docstrings and assignments of
    constants are left out.
    """
    return {
        re.sub(r"(?<![.\w])[A-Za-z_]\w*", "_", ast.unparse(node).partition("\n")[0])
        for tree in ast.walk(ast.parse(source))
        if isinstance(tree, ast.FunctionDef)
        for node in ast.walk(tree)
        if isinstance(node, ast.stmt) and node is not tree
        if not isinstance(getattr(node, "value", 0), ast.Constant)
    }


def unusual(source):
    """Return the names in a file that no equation needs and that could reach the answers."""
    fields = (value for node in ast.walk(ast.parse(source)) for _, value in ast.iter_fields(node))
    words = {word for value in fields if isinstance(value, str) for word in value.split(".")}
    return sorted(words & UNUSUAL)
