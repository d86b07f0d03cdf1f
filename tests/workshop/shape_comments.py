"""Reads the shapes that the equation files write in comments, and compares arrays with them.

    x_a,  # [A, 3]  an array; a letter stands for the same length everywhere
    delta_vc,  # [A, 1]  an array with an alternative; [A, 0] where an effect is off
    L_rate,  # []  a scalar
    grids,  # list of [T, F]  a list, in which letters may differ from array to array
    weights,  # psi_s, d + 4 -> 3k: a network, rows of the first weight and columns of the last
    weights,  # psi_d, d -> 3 | 3 | 4: a network whose last three layers are heads
    biases,  (no comment: its lengths follow from the weights)

An axis is a number, a letter or an expression such as `D (1 + 2 L)`, where a letter may also be the
name of an integer argument. Outputs are described in the docstring of `forward`: `alpha [A, k]`,
`depth and visible [N]`.
"""

import ast
import inspect
import io
import re
import textwrap
import tokenize
from typing import NamedTuple

import numpy as np


class Spec(NamedTuple):
    """What a comment says of one argument or output."""

    shapes: tuple = ()  # alternatives, each a tuple of axes
    is_list: bool = False
    network: tuple = ()  # (rows, columns of the last weights ...)


class Axis(NamedTuple):
    """One length that was found and the axis that was written for it."""

    text: str
    length: int
    where: str
    at_most: bool = False  # networks of effects that are off may be narrower


# --- reading ------------------------------------------------------------------------------------


def arguments(forward):
    """{argument: Spec} from the comments of a function's signature."""
    return {name: parsed(comment) for name, comment in comments(forward).items()}


def comments(forward):
    """{argument: its comment} of a function's signature; "" where there is none."""
    source = textwrap.dedent(inspect.getsource(forward))
    by_line = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (function,) = ast.parse(source).body
    return {a.arg: by_line.get(a.lineno, "") for a in function.args.args}


def parsed(comment):
    """The Spec of one comment; an empty one where it says nothing of shapes."""
    network = re.match(r"psi\w*, (.+?) -> ([^,;]+)", comment)
    if network:
        return Spec(network=(network[1], *network[2].split("|")))
    shapes = re.findall(r"(?:^|; )(list of )?\[([^\]]*)\]", comment)
    return Spec(tuple(axes(text) for _, text in shapes), any(prefix for prefix, _ in shapes))


def outputs(forward, names):
    """{output: Spec} from the docstring of `forward`."""
    text = " ".join(inspect.getdoc(forward).split())
    shared = tuple(axes(shape) for shape in re.findall(r"\boutput \[([^\]]*)\]", text))
    others = "|".join(names)
    specs = {}
    for name in names:
        match = re.search(rf"\b{name}(?:(?:,| and) (?:{others}))* \[([^\]]*)\]", text)
        specs[name] = Spec((axes(match[1]), *shared)) if match else Spec()
    return specs


def axes(text):
    """The axes of a shape: "A, 3k" -> ("A", "3k")."""
    return tuple(axis.strip() for axis in text.split(",") if axis.strip())


# --- as text ------------------------------------------------------------------------------------


def manifest_shapes(forward, inputs, names):
    """{input or output: axes} as in the manifest of the vectors.

    "A k 3" is an array [A, k, 3], "" a scalar or a setting, "*I J" a list of arrays [I, J], and
    "A k -> N" an input and the output of that name. An expression is written as I, and a number
    among the arguments as its capital, because a port has no other names for them.
    """
    specs = arguments(forward)
    shapes = {name: manifest_axes(name, specs[name]) for name in inputs}
    for name, spec in outputs(forward, names).items():
        before = f"{shapes[name]} -> " if name in shapes else ""
        shapes[name] = before + manifest_axes(name, spec)
    return shapes


def manifest_axes(name, spec):
    """The axes of one argument or output."""
    if name.endswith(("weights", "biases")):
        return "*I J" if name.endswith("weights") else "*J"
    if not spec.shapes:
        return ""
    axes_written = (a[0].upper() if a.isalpha() and len(a) > 1 else a for a in spec.shapes[0])
    text = " ".join(a if a.isalnum() else "I" for a in axes_written)
    return f"*{text}" if spec.is_list else text


# --- expressions --------------------------------------------------------------------------------


def letters(axis):
    """The names that occur in an axis."""
    return set(re.findall(r"[A-Za-z_]\w*", axis))


def evaluate(axis, lengths):
    """The value of an axis; "3k" and "D (1 + 2 L)" are products."""
    python = ""
    for token in re.findall(r"[A-Za-z_]\w*|\d+|[-+*/()]", axis):
        is_operand = token[0].isalnum() or token in "_("
        if is_operand and python and (python[-1].isalnum() or python[-1] in "_)"):
            python += "*"
        python += token
    return eval(python, {}, lengths)


def solve(rows, lengths):
    """Find the lengths of all letters and compare every axis with its text; changes `lengths`."""
    pending = [axis for axis in rows if not axis.at_most]
    while pending:
        known = [axis for axis in pending if not letters(axis.text) - set(lengths)]
        for axis in known:
            want = evaluate(axis.text, lengths)
            assert axis.length == want, f"{axis.where}: {axis.text} is {want}, not {axis.length}"
        pending = [axis for axis in pending if axis not in known]
        alone = [axis for axis in pending if {axis.text} == letters(axis.text)]
        linear = [axis for axis in pending if len(letters(axis.text) - set(lengths)) == 1]
        if alone:
            lengths[alone[0].text] = alone[0].length
        elif linear:
            solve_linear(linear[0], lengths)
        else:
            assert not pending, f"{pending[0].where}: what is {pending[0].text}?"
    for axis in rows:
        if axis.at_most:
            most = evaluate(axis.text, lengths)
            assert axis.length <= most, f"{axis.where}: {axis.text} is {most}, not {axis.length}"


def solve_linear(axis, lengths):
    """Find the one unknown letter of an axis such as "3k"."""
    (unknown,) = letters(axis.text) - set(lengths)
    start = evaluate(axis.text, {**lengths, unknown: 0})
    factor = evaluate(axis.text, {**lengths, unknown: 1}) - start
    value, rest = divmod(axis.length - start, factor)
    assert rest == 0 and value >= 0, f"{axis.where}: {axis.length} is no {axis.text}"
    lengths[unknown] = value


# --- comparing ----------------------------------------------------------------------------------


def compare(specs, values, is_off):
    """Compare arrays {name: value} with their Specs.

    Returns the lengths of the letters, the numbers that are axes, and the alternative that was met
    for each name. Raises AssertionError where a comment is wrong or missing. `is_off` allows
    alternatives of width zero and narrower networks.
    """
    lengths = {
        name: value
        for name, value in values.items()
        if isinstance(value, int) and not isinstance(value, bool)
    }
    rows, met, weights = [], {}, None
    for name, value in values.items():
        spec = specs[name]
        if spec.network:
            weights = value
            rows += network_axes(name, spec, weights, is_off)
        elif name == "biases":
            assert [b.shape for b in value] == [W.shape[1:] for W in weights], "biases"
        elif spec.is_list:
            for i, array in enumerate(value):
                solve(array_axes(f"{name}[{i}]", spec.shapes[0], array), {})
        elif spec.shapes:
            met[name] = alternative(name, spec, np.shape(value), is_off)
            rows += array_axes(name, met[name], value)
        else:
            assert not isinstance(value, (np.ndarray, list)), f"{name}: no shape is written"
    solve(rows, lengths)
    numbers = {int(axis) for shape in met.values() for axis in shape if axis.isdigit()}
    on_axes = {axis for shape in met.values() for axis in shape}
    return {a: n for a, n in lengths.items() if a in on_axes}, numbers, met


def network_axes(name, spec, weights, is_off):
    """The axes that the comment of a network names."""
    rows, *columns = spec.network
    ends = weights[-len(columns) :]
    first = Axis(rows, weights[0].shape[0], f"rows of {name}", is_off)
    last = [
        Axis(text, W.shape[1], f"columns of {name}", is_off)
        for text, W in zip(columns, ends, strict=True)
    ]
    return [first, *last]


def alternative(name, spec, shape, is_off):
    """The alternative of a Spec that fits a shape."""
    for axes_written in spec.shapes:
        fits = len(axes_written) == len(shape) and all(
            not axis.isdigit() or int(axis) == n for axis, n in zip(axes_written, shape)
        )
        if fits and (is_off or "0" not in axes_written):
            return axes_written
    raise AssertionError(f"{name}: shape {shape}, written {spec.shapes}")


def array_axes(name, axes_written, array):
    """The axes of one array."""
    shape = np.shape(array)
    assert len(shape) == len(axes_written), f"{name}: shape {shape}, written {axes_written}"
    return [Axis(text, n, f"{name} {shape}") for text, n in zip(axes_written, shape)]
