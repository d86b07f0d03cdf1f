"""A student's file, loaded as an equation, and a process that answers the grader with it.

The process speaks the protocol of `oracle.adapter`. Its replies have two more fields: `said` gives
the reason if a function returned nothing, and `follow` contains the gradients that the student's
backward computes from what the reference's forward saved.
"""

import json
import os
import shlex
import sys
import types
from functools import cache
from pathlib import Path

import numpy as np

from ...oracle.adapter import Adapter, packed, unpacked
from ...oracle.published import Golden, flatten
from ...table import EQUATIONS
from .guard import alone
from .room import SAVES_SLOPES

ROOT = Path(__file__).resolve().parents[3]
START_SECONDS = 60
START = (
    "import sys; sys.path[0] = sys.argv.pop(1); "
    "from p4dgs_ref.lab.school.student import main; main(*sys.argv[1:])"
)


def load(path):
    """Return the Equation in a student's file; whatever the file imports is the reference's code.

    Raises KeyError if the file does not have the name of an equation, and whatever the file raises.
    """
    path = Path(path)
    eq = EQUATIONS[path.stem]
    module = types.ModuleType(f"{eq.module}_of_a_student")
    module.__package__, module.__file__ = eq.module.rpartition(".")[0], str(path)
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), module.__dict__)
    sys.modules[module.__name__] = module
    return eq._replace(module=module.__name__)


loaded = cache(load)


class Student(Adapter):
    """The process with one student's file, used as a port."""

    def __init__(self, path, timeout):
        super().__init__(shlex.join([sys.executable, "-c", START, str(ROOT), str(path)]), timeout)
        self.for_case = timeout
        # Of the last case: {"forward": why it returned nothing, "backward": likewise}, and
        # {"in_bar.x": gradients computed from what the reference saved}.
        self.said, self.follow = {}, {}

    def _exchange(self, request, field):
        starts = "p4dgs_oracle" in request  # importing NumPy does not count against the student
        self.timeout = max(START_SECONDS, self.for_case) if starts else self.for_case
        answer = super()._exchange(request, field)
        said, follow = answer.get("said"), {"follow": answer.get("follow", {})}
        self.said = said if isinstance(said, dict) else {}
        self.follow = {f"in_bar.{name}": a for name, a in unpacked(follow, "follow").items()}
        return answer


# --- inside the process ---------------------------------------------------------------------------
def main(path):
    """Answer requests from stdin until it ends. Everything else that is printed goes to stderr."""
    reference = alone(Path(path).stem)
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # input() in a student's file ends at once
    for line in requests:
        request = json.loads(line)
        reply = {"p4dgs_oracle": 1}
        if "p4dgs_oracle" not in request:
            reply = {"id": request["id"], **answer(path, request, reference)}
        replies.write(json.dumps(reply).encode() + b"\n")
        replies.flush()


def answer(path, request, reference):
    """Return the fields of the reply to one case; `reference` is the module of the equation."""
    key = Path(path).stem
    tensors = {
        f"{role}.{name}": a
        for role in ("in", "out_bar")
        for name, a in unpacked(request, role).items()
    }
    case = Golden(request["id"], "", key, key, "", {"settings": request["settings"]}, tensors)
    eq, said, gradients, follow = EQUATIONS[key], {}, {}, {}

    def forward():
        return outputs_of(eq, loaded(path).forward(**case.inputs()))

    def backward(saved):
        made = loaded(path).backward(saved, **case.cotangents())
        if not isinstance(made, dict):
            raise TypeError("expected a dictionary {input name: gradient}")
        return flat({name: made[name] for name in eq.gradients if name in made})

    outputs, saved = tried(forward, said, "forward") or ({}, None)
    if eq.gradients and outputs:
        gradients = tried(lambda: backward(saved), said, "backward")
    if eq.gradients and key not in SAVES_SLOPES:
        _, reference_saved = reference.forward(**case.inputs())
        follow = tried(lambda: backward(reference_saved), {} if outputs else said, "backward")
    return {
        "out": numbers(outputs),
        "in_bar": numbers(gradients or {}),
        "follow": numbers(follow or {}),
        "said": said,
    }


def tried(call, said, part):
    """Return what the call returns; if it fails, return None and put the reason into `said`."""
    try:
        with np.errstate(all="ignore"):
            return call()
    except NotImplementedError as error:
        said[part] = f"not written yet ({error})" if str(error) else "not written yet"
    except BaseException as error:
        said[part] = f"{type(error).__name__}: {error}".strip(": ")
    return None


def outputs_of(eq, made):
    """Return (flat outputs, saved) of what a student's forward returned."""
    if not isinstance(made, tuple) or len(made) != 2:
        raise TypeError("expected a pair, the output and what backward needs")
    output, saved = made
    count = len(eq.outputs)
    if count > 1 and (not isinstance(output, tuple) or len(output) != count):
        raise TypeError(f"expected a tuple of {', '.join(eq.outputs)} as output")
    return flat(eq.named(output if count > 1 else (output,))), saved


def flat(values):
    """Return arrays and lists of arrays as flat, named arrays; None is left out."""
    made = {
        name: list(value) if isinstance(value, (list, tuple)) else np.asarray(value)
        for name, value in values.items()
        if value is not None
    }
    return flatten(made)


def numbers(named):
    """Return the arrays of numbers, packed. Others are left out, so that they count as missing."""
    return {
        name: packed(np.ascontiguousarray(a).reshape(a.shape))
        for name, a in named.items()
        if a.dtype.kind in "fiub" and a.dtype.itemsize <= 8
    }
