"""One-token mutations of the equations' own code: another operator, number, name or order.

Each site is named `<file>:<function or constant>:<operator>:<n>`, where n counts the sites of the
operator within that function, so that edits elsewhere leave the name alone. A mutation is applied
in this process: the mutated function is compiled, and its code is put into the function that all
users of the module already hold. Afterwards the old code is put back.
"""

import ast
import importlib
import inspect
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from operator import attrgetter
from os.path import commonprefix
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p4dgs_ref import EQUATIONS

# Files that serve an equation, or several.
HELPERS = {
    "grid_nodes": "hash_grid",
    "window": "ssim",
    "anchor_network": "",
    "numerics": "",
}
NOT_COMPUTED = {"literal"}  # the printed formula of Eq. (11), which nothing calls
# Names that decide only which inputs are refused, and how much is computed at once.
REFUSALS = {"LIMIT", "wrong", "check_ranges"}
PORTIONS = {"BLOCK", "PIECE", "size"}
PLAIN_KEYWORDS = {"dtype", "copy", "strict", "order"}  # of calls; they are no mathematics

OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.FloorDiv: ast.Mod,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
NAMES = {
    "minimum": "maximum",
    "maximum": "minimum",
    "min": "max",
    "max": "min",
    "sin": "cos",
    "cos": "sin",
    "floor": "ceil",
    "rint": "floor",
    "sum": "mean",
    "mean": "sum",
    "prod": "sum",
    "log1p": "log",
    "expm1": "exp",
    "exp": "expm1",
    "log": "log1p",
    "log2": "log",
    "sqrt": "square",
    "zeros": "ones",
    "ones": "zeros",
    "zeros_like": "ones_like",
    "ones_like": "zeros_like",
    "tanh": "sin",
    "erfcx": "ndtr",
    "sigmoid": "abs",
    "argsort": "argmin",
    "cumsum": "cumprod",
}
DROPPED = {"abs", "reversed", "sign"}  # calls replaced by their argument
TRANSPOSERS = {"transpose", "swapaxes"}
# Too short to be shown alone.
WORDS = (ast.Name, ast.Tuple, ast.Slice, ast.Starred, ast.Constant, ast.UnaryOp)
# Functions that are symmetric in their arguments.
SYMMETRIC = {"minimum", "maximum", "min", "max", "hypot", "result_type", "einsum", "swapaxes"}
TYPES = {"dtype", "float", "float64", "int64", "uint32", "inner"}
LONG, AROUND = 80, 20  # letters of a description


class Mutation(NamedTuple):
    """One token changed."""

    id: str
    module: str  # p4dgs_ref.equations.offsets
    equation: str  # that the file is about; "" for a helper of several
    owner: str  # the function or constant in which the token stands
    description: str  # old -> new
    statement: ast.stmt  # of the owner
    place: tuple  # (node, field, index or None) where the old token stands in the statement
    new: object  # what stands there instead

    @property
    def is_function(self):
        return isinstance(self.statement, ast.FunctionDef)


def files():
    """Return [(module, its equation)] of all files that are mutated."""
    equations = [(eq.module.__name__, key) for key, eq in EQUATIONS.items()]
    helpers = [(f"p4dgs_ref.equations.{name}", key) for name, key in HELPERS.items()]
    return [*equations, ("p4dgs_ref.splatting.factored", "projection"), *helpers]


def mutations():
    """Every mutation of every file, in order of files and of their text."""
    return [m for module, equation in files() for m in mutations_of(module, equation)]


def mutations_of(module, equation):
    """Every mutation of one file."""
    results = []
    for owner, statement in owners(module):
        counts = {}
        if owner in NOT_COMPUTED | REFUSALS | PORTIONS:
            continue
        for operator, place, new, shown in sites(statement):
            counts[operator] = counts.get(operator, 0) + 1
            name = f"{module.rsplit('.', 1)[1]}:{owner}:{operator}:{counts[operator]}"
            results.append(
                Mutation(
                    name,
                    module,
                    equation,
                    owner,
                    described(place, new, shown),
                    statement,
                    place,
                    new,
                )
            )
    return results


@cache
def parsed(module):
    """The top-level statements of a file; the same objects at every call."""
    return ast.parse(source(module)).body


def owners(module):
    """Yield (name, statement) of constants, functions and undecorated methods: Adam.step."""
    for statement in parsed(module):
        inner = statement.body if isinstance(statement, ast.ClassDef) else ()
        for method in inner:
            if isinstance(method, ast.FunctionDef) and not method.decorator_list:
                yield f"{statement.name}.{method.name}", method
        if owner_of(statement) is not None:
            yield owner_of(statement), statement


def source(module):
    """The text of a file of the package or of the tests."""
    return Path(find_spec(module).origin).read_text(encoding="utf-8")


def owner_of(statement):
    """The name of the function or the first constant that a statement defines, else None."""
    if isinstance(statement, ast.FunctionDef):
        return statement.name
    if isinstance(statement, ast.Assign):
        target = statement.targets[0]
        name = (target.elts[0] if isinstance(target, ast.Tuple) else target).id
        return None if name == "__all__" else name
    return None


# --- where, and what instead --------------------------------------------------------------------
def sites(statement):
    """Yield (operator's name, place, replacement, node in which the change is shown), in order."""
    if isinstance(statement, ast.Assign):
        yield from within(statement, "value", statement.value, statement.value)
        return
    arguments = statement.args
    for field in ("defaults", "kw_defaults"):
        for i, default in enumerate(getattr(arguments, field)):
            yield from within(arguments, field, default, default, i)
    for i, line in enumerate(statement.body):
        if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)):  # a docstring
            yield from within(statement, "body", line, line, i)


def within(holder, field, node, shown, index=None):
    """The sites at a node and below it."""
    if node is None or aside(node):
        return
    if isinstance(node, (ast.expr, ast.AugAssign)) and not isinstance(node, WORDS):
        shown = node
    for operator, new in replacements(holder, field, node):
        yield operator, (holder, field, index), new, shown
    for name in order_of(holder, node):
        value = getattr(node, name)
        for i, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.keyword) and child.arg not in PLAIN_KEYWORDS:
                yield from within(child, "value", child.value, shown)
            elif isinstance(
                child, (ast.expr, ast.stmt, ast.comprehension, ast.operator, ast.cmpop, ast.boolop)
            ):
                yield from within(node, name, child, shown, i)


def order_of(holder, node):
    """The fields with code that runs: targets of assignments, but not the names that loops bind."""
    if (
        isinstance(holder, ast.Call)
        and isinstance(node, ast.UnaryOp)
        and isinstance(node.operand, ast.Constant)
    ):
        return []  # reshape(-1): any other negative length says the same
    skipped = {
        ast.With: ("items",),
        ast.FunctionDef: ("args", "returns", "decorator_list"),
        ast.For: ("target",),
        ast.comprehension: ("target",),
        ast.Lambda: ("args",),
    }.get(type(node), ())
    return [name for name in node._fields if name not in skipped]


def aside(node):
    """Whether a statement is an error path or decides how much is computed at once."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        return getattr(node.value.func, "id", "") in REFUSALS
    if isinstance(node, ast.Assign):
        return isinstance(node.targets[0], ast.Name) and node.targets[0].id in REFUSALS | PORTIONS
    if isinstance(node, ast.For):
        return all(map(aside, node.body))
    return isinstance(node, ast.If) and isinstance(node.body[-1], ast.Raise)


def replacements(holder, field, node):
    """(operator's name, what stands there instead) for one node."""
    if type(node) in OPERATORS:
        other = OPERATORS[type(node)]
        yield f"{type(node).__name__}-{other.__name__}".lower(), other()
    elif isinstance(node, ast.Constant):
        yield from numbers(holder, node)
    elif isinstance(node, ast.UnaryOp):
        yield f"no-{type(node.op).__name__}".lower(), node.operand
    elif isinstance(node, ast.Attribute):
        if (
            node.attr == "T"
            and isinstance(node.ctx, ast.Load)
            and ast.unparse(node.value) != "camera"
        ):
            yield "no-transpose", node.value
    elif isinstance(node, ast.Call):
        yield from calls(node)
    elif (
        isinstance(node, (ast.List, ast.Tuple))
        and field not in ("slice", "targets", "iter")  # the order of a loop's items is mostly free
        and not isinstance(holder, (ast.Return, ast.Yield, ast.keyword))
    ):
        yield from (("swap-items", changed(node, elts=items)) for items in swaps(node.elts))
    elif isinstance(node, ast.Dict) and all(node.keys):
        yield from (("swap-values", changed(node, values=items)) for items in swaps(node.values))
    if field == "test":
        yield "not", ast.UnaryOp(ast.Not(), node)


def numbers(holder, node):
    """Another number or truth value."""
    value = node.value
    if isinstance(value, bool):
        yield "true-false", ast.Constant(not value)
    elif isinstance(holder, ast.keyword) and holder.arg == "axis":
        yield "axis", ast.Constant({0: 1, 1: 0, 2: 1}[value])
    elif isinstance(value, int):
        yield "int", ast.Constant(value + 1)
    elif isinstance(value, float):
        yield "float", ast.Constant(1.01 * value if value else 1.0)


def calls(node):
    """Another function, no function, or two arguments in the other order."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in NAMES:
        other = NAMES[name]
        spelt = (
            changed(node.func, attr=other)
            if isinstance(node.func, ast.Attribute)
            else ast.Name(other, ast.Load())
        )
        yield f"{name}-{other}", changed(node, func=spelt)
    if name in DROPPED:
        yield f"no-{name}", node.args[0]
    if name in TRANSPOSERS:
        yield "no-transpose", node.func.value
    if name not in SYMMETRIC:
        yield from (("swap-arguments", changed(node, args=args)) for args in swaps(node.args))


def swaps(items):
    """Yield a list with each pair of neighbours swapped, unless one of them is a type."""
    for i in range(len(items) - 1):
        pair = {ast.unparse(item).removeprefix("np.") for item in items[i : i + 2]}
        is_type = any(text in TYPES or text.endswith(".dtype") for text in pair)
        if len(pair) == 2 and not is_type:
            yield [*items[:i], items[i + 1], items[i], *items[i + 2 :]]


def changed(node, **fields):
    """A copy of a node with other fields."""
    return type(node)(**{**{name: getattr(node, name, None) for name in node._fields}, **fields})


def rewritten(module, changes, **names):
    """Return the names that a file defines with some of its text replaced, {old: new}.

    Every old text must stand in the file once. The new one may use `names`.
    """
    text = source(module)
    for old, new in changes.items():
        if text.count(old) != 1:
            raise ValueError(f"{module}: {old!r} stands there {text.count(old)} times, not once")
        text = text.replace(old, new)
    scratch = {"__name__": module, "__package__": module.rpartition(".")[0], "np": np, **names}
    exec(compile(text, f"{module}, rewritten", "exec"), scratch)
    return scratch


# --- putting it there ---------------------------------------------------------------------------
@contextmanager
def put(place, new):
    """Put another node at a place of a statement, for a while."""
    holder, field, index = place
    values = getattr(holder, field)
    old = values if index is None else values[index]
    if isinstance(old, (ast.expr, ast.stmt)):
        ast.fix_missing_locations(ast.copy_location(new, old))

    def place_it(node):
        if index is None:
            setattr(holder, field, node)
        else:
            values[index] = node

    place_it(new)
    try:
        yield
    finally:
        place_it(old)


def described(place, new, shown):
    """Return `old -> new` with the expression around it, shortened where it is long."""
    holder, field, index = place
    old = getattr(holder, field) if index is None else getattr(holder, field)[index]
    before = " ".join(ast.unparse(shown).split())
    with put(place, new):
        after = " ".join(ast.unparse(new if shown is old else shown).split())
    if max(len(before), len(after)) > LONG:
        head = before.rfind(" ", 0, max(0, len(commonprefix([before, after])) - AROUND)) + 1
        tail = len(commonprefix([before[::-1], after[::-1]])) - AROUND
        before, after = (
            ("... " if head else "")
            + (text[head : len(text) - tail] + " ..." if tail > 0 else text[head:])
            for text in (before, after)
        )
    return f"{before} -> {after}"


@contextmanager
def applied(mutation):
    """Change one token of the package, for all who already hold its functions."""
    module = importlib.import_module(mutation.module)
    scratch = dict(vars(module))
    if mutation.is_function:
        with put(mutation.place, mutation.new):
            exec(compile(ast.Module([mutation.statement], []), mutation.id, "exec"), scratch)
        function = inspect.unwrap(attrgetter(mutation.owner)(module))  # of what a cache holds
        other = inspect.unwrap(scratch[mutation.owner.rpartition(".")[2]])
        kept = function.__code__, function.__defaults__, function.__kwdefaults__
        function.__code__, function.__defaults__, function.__kwdefaults__ = (
            other.__code__,
            other.__defaults__,
            other.__kwdefaults__,
        )
        try:
            yield
        finally:
            function.__code__, function.__defaults__, function.__kwdefaults__ = kept
    else:  # constants are computed from each other: all of them anew
        constants = [
            s for s in parsed(mutation.module) if isinstance(s, ast.Assign) and owner_of(s)
        ]
        with put(mutation.place, mutation.new):
            exec(compile(ast.Module(constants, []), mutation.id, "exec"), scratch)
        names = [
            n.id
            for s in constants
            for t in s.targets
            for n in ast.walk(t)
            if isinstance(n, ast.Name)
        ]
        kept = {name: vars(module)[name] for name in names}
        vars(module).update({name: scratch[name] for name in names})
        try:
            yield
        finally:
            vars(module).update(kept)
