"""Takes the bodies of functions out of a Python file and leaves all else as it is."""

import ast
import json

# Functions that hold the answer beside forward and backward: they go with them.
HELPERS = {
    ("ssim", "forward"): ("dissimilarity",),
    ("hash_grid", "forward"): ("query", "surrogate"),
    ("hash_rate", "forward"): ("entropy", "surrogate"),
    ("rotation", "forward"): ("normalise",),
    ("rotation", "backward"): ("normalise_backward",),
    ("view", "backward"): ("across",),
    ("covariance", "forward"): ("rotation_matrix",),
    ("compositing", "forward"): ("_alphas", "_transmittances"),
}


def functions_of(key, parts):
    """Every function that goes when these parts of an equation are to be written: ("forward", "normalise", ...)."""
    return tuple(name for part in parts for name in (part, *HELPERS.get((key, part), ())))


def without_bodies(source, names, say):
    """`source` with the bodies of the named top-level functions replaced; docstrings stay.

    `say(name)` is the text of the NotImplementedError.

    Raises     KeyError where a function is not there
    """
    lines = source.splitlines(keepends=True)
    found = {
        node.name: node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)
    }
    for node in sorted(
        (found[name] for name in names), key=lambda node: -node.lineno
    ):  # from below: lines stay valid
        lines[_first_line(node, lines) : node.end_lineno] = [
            f"    raise NotImplementedError({json.dumps(say(node.name))})\n"
        ]
    return "".join(lines)


def _first_line(node, lines):
    """Index of the first line after head and docstring; comments above the first statement belong to the body."""
    if ast.get_docstring(node) is not None:
        return node.body[0].end_lineno
    start = node.body[0].lineno - 1
    while lines[start - 1].strip().startswith("#") or not lines[start - 1].strip():
        start -= 1
    return start


def unwritten(source, name):
    """Whether a function of a file is still as `without_bodies` left it, or is gone; False in a file that cannot be read."""
    try:
        nodes = [
            node
            for node in ast.parse(source).body
            if isinstance(node, ast.FunctionDef) and node.name == name
        ]
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    if not nodes:
        return True
    body = nodes[-1].body[1:] if ast.get_docstring(nodes[-1]) is not None else nodes[-1].body
    raised = body[0].exc if len(body) == 1 and isinstance(body[0], ast.Raise) else None
    raised = raised.func if isinstance(raised, ast.Call) else raised
    return isinstance(raised, ast.Name) and raised.id == "NotImplementedError"
