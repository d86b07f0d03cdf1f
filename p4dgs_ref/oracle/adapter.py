"""Checks a port that runs as a process: lines of JSON go to its stdin and come from its stdout.

PROTOCOL, version 1. Every line is one JSON object in UTF-8 and gets one line back. stdout carries
nothing else. A port may log to stderr; its end is quoted when something goes wrong.

    checker   {"p4dgs_oracle": 1, "dtype": "float64"}       first; dtype may be "float32"
    port      {"p4dgs_oracle": 1}
    checker   {"id": "offsets/ordinary", "subject": "offsets", "equation": "offsets",
               "settings": {}, "in": {"x_a": ARRAY, ...}, "out_bar": {"x": ARRAY}}
    port      {"id": "offsets/ordinary", "out": {"x": ARRAY}, "in_bar": {"x_a": ARRAY, ...}}
           or {"id": "offsets/ordinary", "skip": "why this port does not do it"}
           or {"id": "offsets/ordinary", "error": "what went wrong"}
    checker   {"id": "codec/full", "stream": BASE64 of a file}
    port      {"id": "codec/full", "arrays": {"positions": ARRAY, ...}}
           or {"id": "codec/full", "refused": "why"}, or skip or error as above

ARRAY is {"dtype": "F64", "shape": [5, 3], "data": BASE64}: the numbers row by row, little-endian,
with safetensors' names of types. Lists are flat: weights.0, weights.1. Floats have the dtype of the
first line. The time limit of an answer covers compilation; `--timeout` raises it. At the end stdin
is closed, and a port that still runs a second later is killed.
Processes and their groups are those of POSIX.
"""

import base64
import contextlib
import json
import math
import os
import select
import shlex
import shutil
import signal
import subprocess
import time

import numpy as np

from .compare import cast
from .ports import PortError
from .safetensors import DTYPES, NAMES, json_object, naturals

VERSION = 1
LONGEST = 2**26  # bytes of an answer
# After this many failures in a row a subject is given up. After as many subjects in a row, or as
# many starts of the process, everything is given up.
PATIENCE = 3
QUOTED = 300  # characters of stderr, or of a line that is no answer


class AdapterError(ValueError):
    """The command of an adapter cannot be run. The message is one line."""


class Adapter(contextlib.AbstractContextManager):
    """A port that a command starts. Used as a context manager, it ends the process on exit."""

    def __init__(self, command, timeout=10.0, dtype="float64"):
        """`timeout` is for each case and for the start, in seconds. Raises AdapterError."""
        try:
            self.command = shlex.split(command)
        except ValueError as error:
            raise AdapterError(f"adapter {command!r}: expected a command ({error})") from None
        if not self.command or shutil.which(self.command[0]) is None:
            raise AdapterError(f"adapter {command!r}: expected a command that can be run")
        self.timeout, self.dtype = timeout, np.dtype(dtype)
        self.child = None
        self.lost = []  # the subject, or the start of the process, of each failure in a row
        self.last = None  # the last failure

    def run(self, case):
        """Return the outputs and gradients of one case: {"out.x": array, "in_bar.x_a": array}.

        Raises PortError of the kinds died, hung, nonsense, error, skipped and unasked.
        """
        if case.tolerance(self.dtype.name) is None:
            raise PortError("unasked", case.record["tolerance"][f"{self.dtype.name}_reason"])
        request = {
            "id": case.id,
            "subject": case.subject,
            "equation": case.equation,
            "settings": case.record["settings"],
            "in": self._packed(case, "in."),
            "out_bar": self._packed(case, "out_bar."),
        }
        answer = self._ask(request, case.subject, ("out", "skip", "error"))
        return {
            f"{role}.{name}": a
            for role in ("out", "in_bar")
            for name, a in unpacked(answer, role).items()
        }

    def decode(self, name, data):
        """Return the arrays that the port finds in a file and None, or None and its refusal.

        Raises PortError as `run` does.
        """
        answer = self._ask(
            {"id": f"codec/{name}", "stream": base64.b64encode(data).decode()},
            "codec",
            ("arrays", "refused", "skip", "error"),
        )
        if answer.get("refused") is not None:
            return None, _short(str(answer["refused"]))
        return unpacked(answer, "arrays"), None

    def __exit__(self, *_):
        self.close()

    def close(self, grace=1.0):
        """End the process, if one runs, and all that it started; return the end of its stderr."""
        child, self.child = self.child, None
        return child.end(grace) if child else ""

    def _packed(self, case, prefix):
        """Return the tensors of a role as ARRAYs in the precision of the check."""
        tensors = {n: a for n, a in case.tensors.items() if n.startswith(prefix)}
        with np.errstate(over="ignore"):  # beyond float32: infinite, as in every port
            tensors = cast(tensors, self.dtype)
        return {name.removeprefix(prefix): packed(a) for name, a in tensors.items()}

    def _ask(self, request, subject, kinds):
        """Return the answer to a request; exactly one of the fields `kinds` is in it.

        After a failure the process is ended, and the next case starts a new one.
        """
        if self.last and PATIENCE in (len({*self.lost}), self.lost.count(subject)):
            said = f"not asked, after {PATIENCE} failures in a row; the last: {self.last}"
            raise PortError(self.last.kind, said)
        stage = len(self.lost)  # a start; each has its own name, so that failed ones are counted
        try:
            if self.child is None:
                self.child = Child(self.command)
                self._exchange({"p4dgs_oracle": VERSION, "dtype": self.dtype.name}, "p4dgs_oracle")
            stage = subject
            answer = self._exchange(request, "id")
        except PortError as error:
            words = self.close(grace=0)
            self.lost.append(stage)
            self.last = PortError(error.kind, f"{error}{f'; stderr: {words}' if words else ''}")
            raise self.last from None
        except BaseException:  # after Ctrl-C too, no process may be left running
            self.close(grace=0)
            raise
        self.lost.clear()
        found = [kind for kind in kinds if answer.get(kind) is not None]
        if len(found) != 1:
            raise PortError(
                "nonsense",
                f"expected one of the fields {', '.join(kinds)}, got {', '.join(answer)}",
            )
        for field, kind in ("skip", "skipped"), ("error", "error"):
            if field in found:
                raise PortError(kind, _short(str(answer[field])))
        return answer

    def _exchange(self, request, field):
        """Return the object that answers a request; `field` must be the same in both."""
        assert self.child, "a process runs"
        line = self.child.exchange(json.dumps(request).encode() + b"\n", self.timeout)
        answer = json_object(line)
        if answer is None:
            raise PortError(
                "nonsense",
                f"expected a line with a JSON object, got {_short(repr(line[:QUOTED])[1:])}",
            )
        if answer.get(field) != request[field]:
            want, got = json.dumps(request[field]), _short(json.dumps(answer.get(field)))
            raise PortError("nonsense", f"expected {field} {want}, got {got}")
        return answer


class Child:
    """A process and the three pipes to it, which are all served at once so that none blocks."""

    def __init__(self, command):
        try:
            self.process = subprocess.Popen(
                command,
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # its own process group, which can be killed as a whole
            )
        except OSError as error:
            raise PortError("died", f"cannot be started ({error.strerror})") from None
        self.stdin, self.stdout, self.stderr = filter(
            None, (self.process.stdin, self.process.stdout, self.process.stderr)
        )
        for stream in (self.stdin, self.stdout, self.stderr):
            os.set_blocking(stream.fileno(), False)
        self.open = [self.stdout, self.stderr]  # not closed by the port
        self.unread = bytearray()  # bytes of stdout that are not yet a whole line
        self.words = b""  # the end of stderr

    def exchange(self, request, seconds):
        """Send a line and return the next line of the answer.

        Raises PortError of the kinds died, hung and nonsense (a line without an end).
        """
        deadline, unsent, end, searched = time.monotonic() + seconds, memoryview(request), -1, 0
        while end < 0 or unsent:
            left = deadline - time.monotonic()
            if left <= 0:
                raise PortError(
                    "hung",
                    f"no answer within {seconds:g} s, compilation included; --timeout raises it",
                )
            if len(self.unread) > LONGEST:
                raise PortError(
                    "nonsense", f"expected a line of at most {LONGEST:,} bytes, got more"
                )
            unsent = unsent[self._serve(unsent, min(left, 0.1)) :]
            end = self.unread.find(b"\n", searched)
            searched = len(self.unread) if end < 0 else end
        line = bytes(self.unread[:end])
        del self.unread[: end + 1]
        return line

    def _serve(self, unsent, seconds):
        """Read and write what the pipes are ready for; return the number of bytes sent."""
        readable, writable, _ = select.select(
            self.open, [self.stdin] if unsent else [], [], seconds
        )
        for stream in readable:
            part = os.read(stream.fileno(), 2**16)
            if stream is self.stdout:
                self.unread += part
            else:
                self.words = (self.words + part)[-4 * QUOTED :]
            if not part:
                self.open.remove(stream)
        # A process that the port started may still hold its stdout.
        silent = not readable and not writable and self.process.poll() is not None
        if silent or self.stdout not in self.open:
            raise self._death()
        try:
            return os.write(self.stdin.fileno(), unsent[: 2**16]) if writable else 0
        except BrokenPipeError:
            raise self._death() from None

    def _death(self):
        """Return the PortError of a process that ended or closed its pipes."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(0.5)
        code = self.process.returncode
        if code is None:
            how = "closed its pipes"
        else:
            how = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
        middle = ", in the middle of a line" if self.unread else ""
        return PortError("died", f"the process ended without an answer: {how}{middle}")

    def end(self, grace):
        """Close stdin, wait `grace` seconds, kill the group; return the end of stderr."""
        with self.process:  # closes the pipes
            try:
                self.stdin.close()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.process.wait(grace)
            finally:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(self.process.pid, signal.SIGKILL)
            with contextlib.suppress(BlockingIOError):  # empty and held by another process
                self.words += os.read(self.stderr.fileno(), 2**16)
        lines = self.words[-4 * QUOTED :].decode(errors="replace").splitlines()
        return " / ".join(line.strip() for line in lines if line.strip())[-QUOTED:]


def packed(array):
    """Return an array in the form ARRAY of the protocol."""
    dtype = NAMES[array.dtype.newbyteorder("<")]
    data = base64.b64encode(array.astype(DTYPES[dtype]).tobytes()).decode()
    return {"dtype": dtype, "shape": list(array.shape), "data": data}


def unpacked(answer, role):
    """Return the arrays of one field of an answer.

    Raises PortError, kind nonsense, which names the array and what was expected.
    """
    fields = answer.get(role)
    if not isinstance(fields, dict):
        raise PortError(
            "nonsense",
            f"field {role!r}: expected an object of arrays, got {_short(json.dumps(fields))}",
        )
    return {name: _array(field, f"{role}.{name}") for name, field in fields.items()}


def _array(field, name):
    def need(condition, expected):
        if not condition:
            raise PortError("nonsense", f"{name}: expected {expected}")

    complete = isinstance(field, dict) and {"dtype", "shape", "data"} <= set(field)
    need(complete, "the fields dtype, shape and data")
    code, shape, text = DTYPES.get(str(field["dtype"])), field["shape"], field["data"]
    need(code, f"a dtype of {', '.join(DTYPES)}, got {_short(json.dumps(field['dtype']))}")
    is_shape = naturals(shape) and len(shape) <= 32 and max(shape, default=0) < 2**31
    need(is_shape, "a shape, a list of non-negative integers")
    try:
        data = base64.b64decode(text, validate=True)
    except (TypeError, ValueError):
        raise PortError("nonsense", f"{name}: expected data in base64") from None
    size = math.prod(shape) * np.dtype(code).itemsize
    need(len(data) == size, f"{size} bytes for {field['dtype']} {shape}, got {len(data)}")
    need(code != "|b1" or not data.strip(b"\0\1"), "bytes 0 and 1 for BOOL")
    return np.frombuffer(data, code).reshape(shape)


def _short(text):
    return text if len(text) <= QUOTED else text[:QUOTED] + " ..."
