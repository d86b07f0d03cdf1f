"""Removes the bodies of functions from a Python file and leaves everything else as it is."""

import ast
import json

# Functions that contain the answer as well. They are removed together with forward or backward.
HELPERS = {
    ("compositing", "forward"): ("alphas", "transmittances"),
    ("covariance", "forward"): ("rotation_matrix",),
    ("deformed", "forward"): ("as_printed", "moved"),
    ("hash_grid", "forward"): ("locate", "nodes", "entries", "query"),
    ("hash_rate", "forward"): ("entropy",),
    ("likelihood", "forward"): (
        "literal",
        "rate",
        "around_the_mean",
        "beside_the_mean",
        "far_from_the_mean",
        "narrow_bin",
    ),
    ("likelihood", "backward"): ("slopes",),
    ("masking", "backward"): ("scatter",),
    ("ssim", "forward"): ("dissimilarity",),
}
# The forwards of these save slopes, from which their backwards follow in a line or two.
SAVES_SLOPES = {"hash_grid", "step", "likelihood"}


def functions_of(key, parts):
    """Return the functions to write for parts of an equation: ("forward", "entropy", ...)."""
    return tuple(name for part in parts for name in (part, *HELPERS.get((key, part), ())))


def without_bodies(source, names, say):
    """Return `source` with the bodies of the named top-level functions removed.

    Docstrings stay, and so do the first lines of a body that unpack `saved`: they show what the
    reference's forward saves. `say(name)` is the message of the NotImplementedError. Raises
    KeyError if there is no function of a name.
    """
    lines = source.splitlines(keepends=True)
    functions = functions_in(source)
    # From the last function to the first, so that the line numbers stay valid.
    for node in sorted((functions[name] for name in names), key=lambda node: -node.lineno):
        stub = f"    raise NotImplementedError({json.dumps(say(node.name))})\n"
        lines[first_line(node, lines) : node.end_lineno] = [stub]
    return "".join(lines)


def functions_in(source):
    """Return {name: syntax tree} of the top-level functions."""
    nodes = ast.parse(source).body
    return {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}


def kept(node):
    """Return the leading statements that stay: the docstring and the unpacking of `saved`."""
    statements = node.body[:1] if ast.get_docstring(node) is not None else []
    for statement in node.body[len(statements) :]:
        if not isinstance(statement, ast.Assign) or ast.unparse(statement.value) != "saved":
            break
        statements.append(statement)
    return statements


def first_line(node, lines):
    """Return the index of the first line of a body to remove, including the comments above it."""
    if kept(node):
        return kept(node)[-1].end_lineno
    start = node.body[0].lineno - 1
    while lines[start - 1].strip().startswith("#") or not lines[start - 1].strip():
        start -= 1
    return start


def unwritten(source, name):
    """Whether a function is still as `without_bodies` left it, or missing."""
    node = functions_in(source).get(name)
    if node is None:
        return True
    body = node.body[len(kept(node)) :]
    return len(body) == 1 and ast.unparse(body[0]).startswith("raise NotImplementedError")
