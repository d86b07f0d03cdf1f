"""The guarded process that answers with a student's file.

It speaks the protocol of `oracle.adapter`, whose limits of bytes hold. It cannot import the
equation that the file should compute. The field `subject` of a request names the part:
`forward` or `backward`.

An answer may take CASE_SECONDS, and all answers of a student together STUDENT_SECONDS. When little
of that is left, an answer may take a tenth of it, so that a file which hangs again and again leaves
enough for files that answer at once.
"""

import json
import os
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

from ...lessons import WrongForm, gradients_of, outputs_of
from ...oracle.adapter import Adapter, pack, unpack
from ...oracle.ports import FunctionPort, PortError
from ...oracle.published import Golden
from ...splatting.table import EQUATIONS
from .room import text_of

CASE_SECONDS = 5
STUDENT_SECONDS = 60
# The parent of the process that runs the file only waits for it: a file that sends a signal to its
# parent does not reach the grader. Windows cannot fork; there the parent is the grader.
START = """
import os, sys, time
grader, child, ended = os.getppid(), os.fork() if hasattr(os, "fork") else 0, 0
while child and not ended:
    time.sleep(0.05)
    ended, status = os.waitpid(child, os.WNOHANG)
    if os.getppid() != grader:
        os._exit(1)
if child:
    code = os.waitstatus_to_exitcode(status)
    os.kill(os.getpid(), -code) if code < 0 else os._exit(code)
sys.path[0] = sys.argv.pop(1)
from p4dgs_ref.lab.classroom.student import main
main(sys.argv[1])
"""


# --- the process, from outside --------------------------------------------------------------------
class Student(Adapter):
    """The process of one student's file; `minute` is shared by all files of the student."""

    def __init__(self, path, minute):
        self.minute = minute
        command = [sys.executable, "-c", START, str(Path(__file__).parents[3]), str(path)]
        super().__init__(command)

    def part(self, name):
        """Return the port that answers with one part: forward or backward."""
        return SimpleNamespace(run=lambda case: self.run(case._replace(subject=name)))

    def _exchange(self, request, field):
        if "id" not in request:  # importing NumPy does not count against the student
            self.timeout = 60
            return super()._exchange(request, field)
        self.timeout, start = min(CASE_SECONDS, self.minute.left / 10), time.monotonic()
        try:
            return super()._exchange(request, field)
        finally:
            self.minute.left -= time.monotonic() - start


class Minute:
    """The seconds left for the answers of a student."""

    def __init__(self):
        self.left = STUDENT_SECONDS


# --- inside the process ---------------------------------------------------------------------------
class Lock:
    """A finder of modules that refuses those of the project."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        """Raise ImportError for a module of the project; leave others to the next finder."""
        if name.startswith("p4dgs_ref"):
            raise ImportError(f"{name} cannot be imported by a file that is graded")


def lock(key):
    """Allow only imports of the modules of the project that an equation imports.

    The equation itself cannot be imported.
    """
    for name in [name for name in sys.modules if name.startswith("p4dgs_ref")]:
        del sys.modules[name]
    reference = import_module(EQUATIONS[key].module.__name__)
    delattr(sys.modules[reference.__package__], key)
    del sys.modules[reference.__name__]
    sys.meta_path.insert(0, Lock)


def load(path):
    """Return the Equation in a student's file, which imports the reference's code.

    Raises KeyError if the file does not have the name of an equation, and whatever the file raises.
    """
    path = Path(path)
    eq = EQUATIONS[path.stem]
    module = ModuleType(f"{eq.module.__name__}_of_a_student")
    module.__package__, module.__file__ = eq.module.__package__, str(path)
    exec(compile(text_of(path), str(path), "exec"), module.__dict__)
    return eq._replace(module=module)


def end_without(parent):
    """End this process if its parent has ended, by itself or by a signal of the file."""
    if os.getppid() != parent:
        os._exit(1)


def watch(parent):
    """End this process when its parent has ended; a file that hangs would go on for ever."""
    while True:
        time.sleep(1.0)
        end_without(parent)


def main(path):
    """Answer requests from stdin until it ends. Whatever else is printed goes to stderr."""
    parent = os.getppid()
    threading.Thread(target=watch, args=[parent], daemon=True).start()
    lock(Path(path).stem)
    requests, sys.stdin = sys.stdin, open(os.devnull)  # input() in a student's file ends at once
    replies, sys.stdout = sys.stdout, sys.stderr
    for request in map(json.loads, requests):
        reply = reply_to(path, request) if "id" in request else {"p4dgs_oracle": 1}
        end_without(parent)
        print(json.dumps(reply), file=replies, flush=True)


def reply_to(path, request):
    """Return the fields of the reply to one case: an answer, or the error of the student's file."""
    try:
        return {"id": request["id"], **answer(load(path), request)}
    except PortError as error:
        return {"id": request["id"], "error": str(error)}
    except BaseException as error:
        return {"id": request["id"], "error": f"{type(error).__name__}: {error}".strip(": ")}


@np.errstate(all="ignore")
def answer(eq, request):
    """Return the outputs or the gradients of one case."""
    tensors = {
        f"{role}.{name}": a
        for role in ("in", "out_bar")
        for name, a in unpack(request, role).items()
    }
    case = Golden(request["id"], "", eq.key, eq.key, "", request, tensors)

    def pair(inputs):
        pair = eq.forward(**inputs)
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise WrongForm("expected a pair: the output, and what backward needs")
        return pair

    def forward(**inputs):
        return outputs_of(pair(inputs)[0], eq.outputs)

    def vjp(inputs, cotangents):
        return gradients_of(eq.backward(pair(inputs)[1], **cotangents), eq.gradients)

    is_forward = request["subject"] == "forward"
    port = FunctionPort(forward) if is_forward else FunctionPort(lambda **_: {}, vjp)
    fields = {"out": {}, "in_bar": {}}
    for name, array in port.answer(case).items():
        role, _, name = name.partition(".")
        fields[role][name] = pack(array)
    return fields
