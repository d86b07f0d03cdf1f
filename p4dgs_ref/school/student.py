"""A student's file: read in isolation, asked case by case in a process of its own.

The process speaks the oracle's protocol; `answer` may leave out what the student's functions do not give, and says why.
"""

import json
import os
import shlex
import sys
import types
from pathlib import Path

import numpy as np

from .. import splatting  # noqa: F401  declares covariance, projection, compositing
from ..equations import EQUATIONS
from ..oracle.adapter import Adapter, packed, unpacked
from ..oracle.published import Golden
from ..oracle.subjects import flatten

ROOT = Path(__file__).resolve().parents[2]
START_SECONDS = 60
START = "import sys; sys.path[0] = sys.argv.pop(1); from p4dgs_ref.school.student import main; main(*sys.argv[1:])"


def read(path):
    """The module in a student's file; what it imports from the project is the reference's, and no table remembers it.

    Raises     whatever the file raises
    """
    path = Path(path)
    reference = EQUATIONS[path.stem]
    package = reference.module.rpartition(".")[0]
    module = types.ModuleType(f"{package}.{path.stem}_of_a_student")
    module.__package__, module.__file__ = package, str(path)
    saved = dict(EQUATIONS)
    del EQUATIONS[path.stem]  # so that the file can declare its own
    try:
        exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), module.__dict__)
        module.declared = EQUATIONS.get(path.stem)
    finally:
        EQUATIONS.clear()
        EQUATIONS.update(saved)
    return module


def load(path):
    """The Equation that a student's file declares.

    Raises     KeyError where the file bears no equation's name, and whatever the file raises
    """
    return read(path).declared


class Student(Adapter):
    """The process with one student's file, as a port."""

    def __init__(self, path, timeout):
        super().__init__(shlex.join([sys.executable, "-c", START, str(ROOT), str(path)]), timeout)
        self.said, self.follow = {}, {}

    def run(self, case):
        """What the student's functions give to a case, as `Adapter.run`; then

        said       {"forward": why there is no output, "backward": why there are no gradients}
        follow     {"in_bar.x": array}: the gradients where the reference's forward has gone before
        """
        self.said, self.follow = {}, {}
        return super().run(case)

    def _exchange(self, request, field):
        starting, own = field == "p4dgs_oracle", self.timeout
        self.timeout = (
            max(START_SECONDS, own) if starting else own
        )  # importing NumPy is not the student's time
        try:
            return super()._exchange(request, field)
        finally:
            self.timeout = own

    def _ask(self, request, subject, kinds):
        answer = super()._ask(request, subject, kinds)
        if isinstance(answer.get("said"), dict):
            self.said = {str(name): str(text) for name, text in answer["said"].items()}
        if "follow" in answer:
            self.follow = {f"in_bar.{name}": a for name, a in unpacked(answer, "follow").items()}
        return answer


# --- inside the process -------------------------------------------------------------------------------------------
def main(path):
    """Answer requests from stdin until it ends; whatever else is printed goes to stderr."""
    asked, told = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # a student's input() ends at once
    read_module = _once(lambda: read(path))
    for line in asked:
        request = json.loads(line)
        reply = (
            {"p4dgs_oracle": 1}
            if "p4dgs_oracle" in request
            else {"id": request["id"], **answer(read_module, Path(path).stem, request)}
        )
        told.write(json.dumps(reply).encode() + b"\n")
        told.flush()


def _once(make):
    """`make`, called at the first call; what it raised is raised again at every other."""
    kept = []

    def get():
        if not kept:
            try:
                kept.append((make(), None))
            except BaseException as error:  # a file may well call sys.exit
                kept.append((None, error))
        value, error = kept[0]
        if error is not None:
            raise error
        return value

    return get


def answer(read_module, key, request):
    """The fields of a reply to one case."""
    reference, said = EQUATIONS[key], {}
    tensors = {
        f"{role}.{name}": a
        for role in ("in", "out_bar")
        for name, a in unpacked(request, role).items()
    }
    case = Golden(
        request["id"], "", key, key, "", {"settings": request["settings"]}, tensors
    )  # copies at every call
    out, res = _tried(
        lambda: _outputs(read_module().forward(**case.inputs()), reference), said, "forward"
    ) or ({}, None)
    in_bar = follow = {}
    if reference.differentiable:
        if out:
            in_bar = (
                _tried(lambda: _gradients(read_module(), res, case, reference), said, "backward")
                or {}
            )
        remembered = reference.forward(**case.inputs())[1]
        follow = (
            _tried(
                lambda: _gradients(read_module(), remembered, case, reference),
                {} if out else said,
                "backward",
            )
            or {}
        )
    return {"out": _packed(out), "in_bar": _packed(in_bar), "follow": _packed(follow), "said": said}


def _tried(call, said, part):
    """What the call gives, or None and a line on why not."""
    try:
        with np.errstate(all="ignore"):
            return call()
    except NotImplementedError as error:
        said[part] = f"not written yet ({error})" if str(error) else "not written yet"
    except BaseException as error:
        said[part] = f"{type(error).__name__}: {error}".strip(": ")
    return None


def _outputs(made, reference):
    """(outputs as flat arrays, Res) of what a student's forward returned; fields that nobody asked for are left out."""
    names = reference.forward.__globals__["Out"]._fields
    if not isinstance(made, tuple) or len(made) != 2:
        raise TypeError("expected a pair, Out and Res")
    out = made[0]._asdict() if hasattr(made[0], "_asdict") else made[0]
    if not isinstance(out, dict) or not set(names) <= set(out):
        raise TypeError(f"expected an Out with the fields {', '.join(names)}")
    return _flat({name: out[name] for name in names}), made[1]


def _gradients(module, res, case, reference):
    made = module.backward(res, **case.cotangents())
    if not isinstance(made, dict):
        raise TypeError("expected a dictionary {input: gradient}")
    return _flat({name: made[name] for name in reference.differentiable if name in made})


def _flat(values):
    return flatten(
        {
            name: [np.asarray(b) for b in a] if isinstance(a, (list, tuple)) else np.asarray(a)
            for name, a in values.items()
            if a is not None
        }
    )


def _packed(arrays):
    """Numbers alone: what else a student returns is left out, and thus missing."""
    return {
        name: packed(np.ascontiguousarray(a).reshape(a.shape))
        for name, a in arrays.items()
        if a.dtype.kind in "fiub" and a.dtype.itemsize <= 8
    }
