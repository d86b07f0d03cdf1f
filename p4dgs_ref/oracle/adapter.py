"""Speaks with a port's process: one line of JSON to its stdin, one from its stdout, for one case after the other.

PROTOCOL, version 1.  Every line is one JSON object in UTF-8 and gets one line back; stdout carries nothing else, what is
written to stderr is quoted when something goes wrong.

    checker   {"p4dgs_oracle": 1, "dtype": "float64"}        first of all; dtype is "float32" where that was asked for
    port      {"p4dgs_oracle": 1}
    checker   {"id": "offsets/ordinary", "subject": "offsets", "equation": "offsets", "settings": {},
               "in": {"x_a": ARRAY, ...}, "out_bar": {"x": ARRAY}}
    port      {"id": "offsets/ordinary", "out": {"x": ARRAY}, "in_bar": {"x_a": ARRAY, ...}}
           or {"id": "offsets/ordinary", "skip": "why this port does not do it"}
           or {"id": "offsets/ordinary", "error": "what went wrong"}
    checker   {"id": "codec/full", "stream": BASE64 of a file}
    port      {"id": "codec/full", "arrays": {"positions": ARRAY, ...}} or {"id": "codec/full", "refused": "why"}, or as above

ARRAY is {"dtype": "F64", "shape": [5, 3], "data": BASE64}: the numbers row by row, little-endian, with the names of types
of safetensors.  Lists are flat: weights.0, weights.1.  Floats come in the dtype of the first line.  At the end stdin is
closed, and a port that still runs a second later is killed.  Processes and their groups are those of POSIX.
"""

import base64
import contextlib
import json
import math
import os
import selectors
import shlex
import shutil
import signal
import subprocess
import time

import numpy as np

from .ports import PortError
from .safetensors import DTYPES, NAMES

VERSION = 1
LONGEST = 2**26  # bytes of an answer
PATIENCE = 3  # cases lost in a row before a subject is given up; subjects, or starts of the process, before all is
QUOTED = 300  # characters of stderr, or of a line that is no answer


class AdapterError(ValueError):
    """A command that cannot be run: one line naming it and what was expected."""


class Adapter:
    """A port behind a command; a context manager, so that no process outlives the check."""

    def __init__(self, command, timeout=10.0, dtype="float64"):
        """`timeout` in seconds, for each case and for the start.

        Raises     AdapterError
        """
        try:
            self.command = shlex.split(command)
        except ValueError as error:
            raise AdapterError(f"adapter {command!r}: expected a command ({error})") from None
        if not self.command or shutil.which(self.command[0]) is None:
            raise AdapterError(f"adapter {command!r}: expected a command that can be run")
        self.timeout, self.dtype = timeout, np.dtype(dtype)
        self.child, self.lost, self.last = None, {}, None  # lost: subject -> cases in a row

    def run(self, case):
        """Outputs and gradients of one case of the vectors: {"out.x": array, "in_bar.x_a": array}.

        Raises     PortError, kind died, hung, nonsense, error, skipped, or unasked where this precision has no tolerance
        """
        if case.tolerance(self.dtype.name) is None:
            raise PortError("unasked", case.record["tolerance"][f"{self.dtype.name}_reason"])
        request = {
            "id": case.id,
            "subject": case.subject,
            "equation": case.equation,
            "settings": case.record["settings"],
            **{
                role: {
                    name[len(role) + 1 :]: self._packed(a)
                    for name, a in case.tensors.items()
                    if name.startswith(role + ".")
                }
                for role in ("in", "out_bar")
            },
        }
        answer = self._ask(request, case.subject, ("out", "skip", "error"))
        return {
            f"{role}.{name}": a
            for role in ("out", "in_bar")
            for name, a in unpacked(answer, role).items()
        }

    def decode(self, name, data):
        """What the port finds in a file: ({name: array}, None), or (None, why it refuses it).

        Raises     PortError as `run`
        """
        request = {"id": f"codec/{name}", "stream": base64.b64encode(data).decode()}
        answer = self._ask(request, "codec", ("arrays", "refused", "skip", "error"))
        refused = answer.get("refused")
        return (
            (unpacked(answer, "arrays"), None) if refused is None else (None, _short(str(refused)))
        )

    def close(self):
        """End the process, if there is one, with everything that it started."""
        child, self.child = self.child, None
        if child is not None:
            child.end(grace=1.0)

    def strangers(self):
        """None: an answer bears the id of its case."""
        return []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def _packed(self, array):
        if array.dtype.kind == "f":
            with np.errstate(
                over="ignore"
            ):  # beyond float32: infinite, as for every port that computes in it
                array = array.astype(self.dtype)
        return packed(array)

    def _ask(self, request, subject, kinds):
        """The answer to a request, one of `kinds`.

        A process that died, hung, or may be a line ahead of us is of no more use: the next case starts another one.
        """
        if max(len(self.lost), self.lost.get(subject, 0)) >= PATIENCE:
            raise PortError(
                self.last.kind,
                f"not asked, after {PATIENCE} failures in a row; the last: {self.last}",
            )
        stage = f"start {len(self.lost)}"  # another one each time: starts that fail add up
        try:
            if self.child is None:
                self.child = Child(self.command)
                self._exchange({"p4dgs_oracle": VERSION, "dtype": self.dtype.name}, "p4dgs_oracle")
            stage = subject
            answer = self._exchange(request, "id")
        except BaseException as error:  # Ctrl-C too must not leave a process that owes an answer
            child, self.child = self.child, None
            words = child.end(grace=0.0) if child else ""
            if not isinstance(error, PortError):
                raise
            self.lost[stage] = self.lost.get(stage, 0) + 1
            self.last = PortError(error.kind, f"{error}{f'; stderr: {words}' if words else ''}")
            raise self.last from None
        self.lost.clear()
        found = [kind for kind in kinds if answer.get(kind) is not None]
        if len(found) != 1:
            raise PortError(
                "nonsense",
                f"expected one of the fields {', '.join(kinds)}, got {', '.join(answer)}",
            )
        if found[0] in ("skip", "error"):
            raise PortError(
                "skipped" if found[0] == "skip" else "error", _short(str(answer[found[0]]))
            )
        return answer

    def _exchange(self, request, field):
        """The object that answers a request: `field` must be the same in both."""
        line = self.child.exchange(json.dumps(request).encode() + b"\n", self.timeout)
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict):
            raise PortError(
                "nonsense",
                f"expected a line with a JSON object, got {_short(repr(bytes(line[:QUOTED]))[1:])}",
            )
        if answer.get(field) != request[field]:
            raise PortError(
                "nonsense",
                f"expected {field} {json.dumps(request[field])}, "
                f"got {_short(json.dumps(answer.get(field)))}",
            )
        return answer


class Child:
    """A process and the three pipes to it, none of which is ever waited for alone."""

    def __init__(self, command):
        pipe = subprocess.PIPE
        try:
            self.process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0, start_new_session=True
            )  # a group of its own, to be killed as one
        except OSError as error:
            raise PortError("died", f"cannot be started ({error.strerror})") from None
        self.unread, self.words = bytearray(), b""  # of stdout, not yet a line; the end of stderr
        for stream in self._streams():
            os.set_blocking(stream.fileno(), False)

    def _streams(self):
        return self.process.stdin, self.process.stdout, self.process.stderr

    def exchange(self, request, seconds):
        """Send a line and wait for one.

        Raises     PortError, kind died, hung or nonsense (a line without an end)
        """
        deadline, unsent, searched = time.monotonic() + seconds, memoryview(request), 0
        with selectors.DefaultSelector() as ready:
            for stream, event in zip(
                self._streams(), (selectors.EVENT_WRITE, *[selectors.EVENT_READ] * 2)
            ):
                if not stream.closed:
                    ready.register(stream, event)
            while True:
                end = self.unread.find(b"\n", searched)
                if end >= 0 and not unsent:
                    line = bytes(self.unread[:end])
                    del self.unread[: end + 1]
                    return line
                searched = end if end >= 0 else len(self.unread)
                if len(self.unread) > LONGEST:
                    raise PortError(
                        "nonsense", f"expected a line of at most {LONGEST:,} bytes, got more"
                    )
                left = deadline - time.monotonic()
                if left <= 0:
                    raise PortError("hung", f"no answer within {seconds:g} s")
                events = ready.select(min(left, 0.1))
                if (
                    not events and self.process.poll() is not None
                ):  # a child of it may still hold its stdout
                    raise self._death()
                for key, _ in events:
                    unsent = self._serve(key.fileobj, ready, unsent)

    def _serve(self, stream, ready, unsent):
        """Move what one pipe is ready for; what is then still to be sent."""
        if stream is self.process.stdin:
            try:
                unsent = unsent[os.write(stream.fileno(), unsent[: 2**16]) :] if unsent else unsent
            except BrokenPipeError:
                raise self._death() from None
            if not unsent:
                ready.unregister(stream)
            return unsent
        part = os.read(stream.fileno(), 2**16)
        if stream is self.process.stdout:
            if not part:
                raise self._death()
            self.unread += part
        elif part:
            self.words = (self.words + part)[-4 * QUOTED :]
        else:  # it may do without stderr
            ready.unregister(stream)
            stream.close()
        return unsent

    def _death(self):
        """The PortError of a process that ended, or hung up on us."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(0.5)
        code = self.process.returncode
        how = (
            "closed its pipes"
            if code is None
            else f"killed by signal {-code}"
            if code < 0
            else f"exit code {code}"
        )
        return PortError(
            "died",
            f"the process ended without an answer: {how}"
            + (", in the middle of a line" if self.unread else ""),
        )

    def end(self, grace):
        """Close stdin, wait `grace` seconds, kill what is left of the group; the last words on stderr."""
        try:
            self.process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(grace)
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            with contextlib.suppress(
                OSError, ValueError
            ):  # closed, or empty and still held by someone
                self.words += os.read(self.process.stderr.fileno(), 2**16)
            for stream in self._streams():
                stream.close()
        lines = [
            line.strip() for line in self.words[-4 * QUOTED :].decode(errors="replace").splitlines()
        ]
        return " / ".join(line for line in lines if line)[-QUOTED:]


def packed(array):
    """An array as {dtype, shape, data}."""
    dtype = NAMES[array.dtype.newbyteorder("<")]
    return {
        "dtype": dtype,
        "shape": list(array.shape),
        "data": base64.b64encode(array.astype(DTYPES[dtype]).tobytes()).decode(),
    }


def unpacked(answer, role):
    """The arrays of one field of an answer.

    Raises     PortError, kind nonsense, naming the array and what was expected
    """
    fields = answer.get(role)
    if not isinstance(fields, dict):
        raise PortError(
            "nonsense",
            f"field {role!r}: expected an object of arrays, got {_short(json.dumps(fields))}",
        )
    try:
        return {name: _array(field, f"{role}.{name}") for name, field in fields.items()}
    except ValueError as error:
        raise PortError("nonsense", str(error)) from None


def _array(field, name):
    def need(condition, expected):
        if not condition:
            raise ValueError(f"{name}: expected {expected}")

    need(
        isinstance(field, dict) and {"dtype", "shape", "data"} <= set(field),
        "the fields dtype, shape and data",
    )
    code, shape = DTYPES.get(str(field["dtype"])), field["shape"]
    need(code, f"a dtype of {', '.join(DTYPES)}, got {_short(json.dumps(field['dtype']))}")
    need(
        isinstance(shape, list)
        and len(shape) <= 32
        and all(type(n) is int and 0 <= n < 2**31 for n in shape),
        "a shape, a list of whole numbers",
    )
    need(isinstance(field["data"], str), "data in base64")
    try:
        data = base64.b64decode(field["data"], validate=True)
    except ValueError:
        need(False, "data in base64")
    size = math.prod(shape) * np.dtype(code).itemsize
    need(len(data) == size, f"{size} bytes for {field['dtype']} {shape}, got {len(data)}")
    need(code != "|b1" or not data.strip(b"\0\1"), "bytes 0 and 1 for BOOL")
    return np.frombuffer(data, code).reshape(shape)


def _short(text):
    return text if len(text) <= QUOTED else text[:QUOTED] + " ..."
