"""A student's file: what in it is copied, and the guarded process that answers with it.

Functions are compared with those of the package, and of other students, statement by statement,
without names, comments, docstrings and layout, so a copy is still one after small changes. Short
functions are alike by chance; only a file with enough text in functions that are alike counts.

Short equations have one right form. What shows a copy of them is what no formula determines: the
comments, or the names and the layout of several files.

The process speaks the protocol of `oracle.adapter`, whose limits of time and bytes hold. It cannot
import the equation that the file should compute. The field `subject` of a request says what is
asked: `forward`, `backward`, or `follow`, the backward on what the reference's forward saves.
"""

import ast
import json
import os
import re
import shlex
import sys
import threading
import time
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

from ...lessons import WrongForm, gradients_of, outputs_of
from ...oracle.adapter import Adapter, packed, unpacked
from ...oracle.ports import PortError
from ...oracle.published import Golden, flatten
from ...splatting.table import EQUATIONS
from .room import modules_of, stubs_of, text_of

PACKAGE = Path(__file__).resolve().parents[2]
ALIKE = 0.8  # of a function's text; where tutorials and tests compute the same, it is below 0.4
MIN_CHARACTERS = 200  # of such functions in an equation; names count as one
MIN_EQUATIONS = 3  # without a comment, whose lines are the same by more than chance
UNUSUAL = {
    *("__builtins__", "__globals__", "__import__", "__subclasses__", "__traceback__", "_getframe"),
    *("builtins", "compile", "ctypes", "eval", "exec", "f_back", "f_globals", "f_locals"),
    *("fromfile", "gc", "globals", "importlib", "inspect", "io", "linecache", "loadtxt", "memmap"),
    *("multiprocessing", "open", "os", "pathlib", "pickle", "posix", "runpy", "subprocess", "sys"),
    *("tb_frame", "threading", "traceback", "vars"),
}
CASE_SECONDS = 5
ALL_SECONDS = 30  # for all cases of an equation; the cases after that are not asked
START_SECONDS = 60  # importing NumPy does not count against the student
START = (
    "import sys; sys.path[0] = sys.argv.pop(1); "
    "from p4dgs_ref.lab.classroom.student import main; main(sys.argv[1])"
)


# --- copies ---------------------------------------------------------------------------------------
def copies(source, key, others=None, alike=ALIKE):
    """Return the functions of what a student wrote of an equation that are copies.

    `others` are the statements they are compared with, by default those of the package. The entries
    have the form "forward (line 5)". There are none if together they are so short that they may be
    alike by chance. Raises SyntaxError or ValueError if the source cannot be parsed.
    """
    others = statements_of_the_package() if others is None else others
    handed_out, copied = statements(joined(stubs_of(key))), {}
    for name, lines in functions(source).items():
        mine = [line for line in lines if line not in handed_out]
        same = [line for line in mine if line in others]
        if same and len("".join(same)) >= alike * len("".join(mine)):
            copied[name] = "".join(same)
    return list(copied) if len("".join(copied.values())) >= MIN_CHARACTERS else []


def same_lines(mine, theirs):
    """Return the equations for which a student has all lines that another author wrote.

    Both are {key: source}. There are none if the lines may be the same by chance: in fewer than
    MIN_EQUATIONS equations, and without a comment.
    """
    lines = {key: written(source, key) for key, source in theirs.items()}
    same = [key for key in lines if set() < lines[key] <= written(mine[key], key)]
    has_comment = any("#" in line for key in same for line in lines[key])
    return same if has_comment or len(same) >= MIN_EQUATIONS else []


def written(source, key):
    """Return the lines of functions that are not those of the files as handed out."""
    mine, handed_out = (
        {line.strip() for line in text.splitlines() if line[:1].isspace()}
        for text in (source, joined(stubs_of(key)))
    )
    return mine - handed_out


def alike(mine, theirs):
    """Return the equations for which what a student wrote is in another student's files."""
    same = same_lines(theirs, mine)
    return {
        key
        for key, source in mine.items()
        if key in same or copies(source, key, statements(theirs[key]))
    }


def joined(files):
    """Return the files of an equation as one text."""
    return "\n\n\n".join(files.values())


@cache
def statements_of_the_package():
    """Return the statements of all functions in the rooms that hold equations."""
    paths = [path for room in ("equations", "splatting") for path in (PACKAGE / room).glob("*.py")]
    return set().union(*(statements(path.read_text(encoding="utf-8")) for path in paths))


def statements(source):
    """Return the statements of all functions in a file, in the form of `functions`."""
    return set().union(*functions(source).values())


@cache
def functions(source):
    """Return {"forward (line 5)": its statements} of all functions in a file.

    A statement has "_" in place of names, those of attributes excepted. Docstrings and assignments
    of constants are left out.
    """
    return {
        f"{tree.name} (line {tree.lineno})": [
            re.sub(r"(?<![.\w])[A-Za-z_]\w*", "_", ast.unparse(node).partition("\n")[0])
            for node in ast.walk(tree)
            if isinstance(node, ast.stmt) and node is not tree
            if not isinstance(getattr(node, "value", 0), ast.Constant)
        ]
        for tree in ast.walk(ast.parse(source))
        if isinstance(tree, ast.FunctionDef)
    }


def unusual(source):
    """Return the names in a file that no equation needs and that could reach the answers."""
    fields = (value for node in ast.walk(ast.parse(source)) for _, value in ast.iter_fields(node))
    words = {word for value in fields if isinstance(value, str) for word in value.split(".")}
    return sorted(words & UNUSUAL)


# --- the process, from outside --------------------------------------------------------------------
class Student(Adapter):
    """The process with one student's file."""

    def __init__(self, path):
        command = [sys.executable, "-c", START, str(PACKAGE.parent), str(path)]
        super().__init__(shlex.join(command))
        self.types = {}  # case -> {output or gradient: "of type float32"}
        self.end = time.monotonic() + ALL_SECONDS

    def part(self, name):
        """Return the port that answers with one part: forward, backward or follow."""
        return SimpleNamespace(
            run=lambda case: self.run(case._replace(subject=name)), types=self.types
        )

    def _exchange(self, request, field):
        if time.monotonic() >= self.end:
            raise PortError("hung", f"not asked, because {ALL_SECONDS} s are over")
        self.timeout = CASE_SECONDS if "id" in request else START_SECONDS
        reply = super()._exchange(request, field)
        types = reply.get("types")  # from a student's process, which may say anything
        named = types.items() if isinstance(types, dict) else ()
        self.types[request.get("id")] = {name: f"of type {kind!s:.40}" for name, kind in named}
        return reply


# --- inside the process ---------------------------------------------------------------------------
class Lock:
    """A finder of modules that refuses those of the project."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        """Raise ImportError for a module of the project; leave others to the next finder."""
        if name.startswith("p4dgs_ref"):
            raise ImportError(f"{name} cannot be imported by a file that is graded")


def alone(key):
    """Return the module of the reference's equation, which cannot be imported from now on.

    Of the project, only the modules that it imports can still be imported.
    """
    for name in [name for name in sys.modules if name.startswith("p4dgs_ref")]:
        del sys.modules[name]
    reference = import_module(EQUATIONS[key].module.__name__)
    for name, module in modules_of(key).items():
        delattr(sys.modules[reference.__package__], name)
        del sys.modules[module]
    sys.meta_path.insert(0, Lock)
    return reference


def load(path):
    """Return the Equation in a student's file.

    Of the project, the file imports the student's other modules of the equation, which lie beside
    it, and otherwise the reference's code. Raises KeyError if the file does not have the name of an
    equation, and whatever the file raises.
    """
    path = Path(path)
    eq = EQUATIONS[path.stem]
    others = {
        module: executed(path.with_name(f"{name}.py"), eq)
        for name, module in modules_of(eq.key).items()
        if name != eq.key
    }
    of_the_reference = {module: sys.modules.pop(module, None) for module in others}
    try:
        sys.modules.update(others)
        module = executed(path, eq)
    finally:
        for name in others:
            del sys.modules[name]
        sys.modules.update({name: old for name, old in of_the_reference.items() if old})
    sys.modules[module.__name__] = module
    return eq._replace(module=module)


def executed(path, eq):
    """Return a module of an equation that holds what a student's file defines."""
    package = eq.module.__package__
    module = ModuleType(f"{package}.{path.stem}_of_a_student")
    module.__package__, module.__file__ = package, str(path)
    exec(compile(text_of(path), str(path), "exec"), module.__dict__)
    return module


def end_after(parent):
    """End this process when its parent has ended; a file that hangs would go on for ever."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def main(path):
    """Answer requests from stdin until it ends. Everything else that is printed goes to stderr."""
    threading.Thread(target=end_after, args=[os.getppid()], daemon=True).start()
    reference = alone(Path(path).stem)
    requests, replies = (
        os.fdopen(os.dup(0), encoding="utf-8"),
        os.fdopen(os.dup(1), "w", encoding="utf-8"),
    )
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # input() in a student's file ends at once
    for request in map(json.loads, requests):
        reply = tried(path, request, reference) if "id" in request else {"p4dgs_oracle": 1}
        print(json.dumps(reply), file=replies, flush=True)


def tried(path, request, reference):
    """Return the fields of the reply to one case: an answer, or the error of the student's file."""
    try:
        fields = answer(load(path), request, reference)
    except BaseException as error:
        fields = {"error": f"{type(error).__name__}: {error}".strip(": ")}
    return {"id": request["id"], **fields}


@np.errstate(all="ignore")
def answer(eq, request, reference):
    """Return the outputs or the gradients of one case; `reference` is the equation's module."""
    record, part = {"settings": request["settings"]}, request["subject"]
    tensors = {
        f"{role}.{name}": a
        for role in ("in", "out_bar")
        for name, a in unpacked(request, role).items()
    }
    case = Golden(request["id"], "", part, eq.key, "", record, tensors)
    pair = (reference if part == "follow" else eq).forward(**case.inputs())
    if not isinstance(pair, tuple) or len(pair) != 2:
        raise WrongForm("expected a pair, the output and what backward needs")
    output, saved = pair
    if part == "forward":
        role, values = "out", outputs_of(output, eq.outputs)
    else:
        made = eq.backward(saved, **case.cotangents())
        role, values = "in_bar", gradients_of(made, eq.gradients)
    arrays, types = with_types(values)
    return {"out": {}, "in_bar": {}, role: arrays, "types": types}


def with_types(values):
    """Return arrays and lists of arrays, flat and packed, and the types of all values.

    What is neither float64 nor whole numbers is left out, so that it counts as missing.
    """
    flat = flatten(
        {
            name: list(value) if isinstance(value, (list, tuple)) else np.asarray(value)
            for name, value in values.items()
        }
    )
    types = {name: a.dtype.name for name, a in flat.items()} | {
        name: type(value).__name__
        for name, value in values.items()
        if not isinstance(value, np.ndarray)
    }
    kept = {n: packed(a) for n, a in flat.items() if a.dtype == float or a.dtype.kind in "iub"}
    return kept, types
