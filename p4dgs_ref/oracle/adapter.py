"""Checks a port that runs as a process: lines of JSON go to its stdin and come from its stdout.

PROTOCOL, version 1. Every line is one JSON object in UTF-8 and gets one line back. stdout carries
nothing else: a second line is taken for the answer to the next request. A port may log to stderr;
its end is quoted when something goes wrong.

    checker   {"p4dgs_oracle": 1, "dtype": "float64"}       first; dtype may be "float32"
    port      {"p4dgs_oracle": 1}
    checker   {"id": "offsets/ordinary", "subject": "offsets", "equation": "offsets",
               "settings": {}, "differentiable": ["x_a", ...], "in": {"x_a": ARRAY, ...},
               "out_bar": {"x": ARRAY}}
    port      {"id": "offsets/ordinary", "out": {"x": ARRAY}, "in_bar": {"x_a": ARRAY, ...}}
           or {"id": "offsets/ordinary", "skip": "why this port does not do it"}
           or {"id": "offsets/ordinary", "error": "what went wrong"}
    checker   {"id": "codec/full", "stream": BASE64 of a file}
    port      {"id": "codec/full", "arrays": {"positions": ARRAY, ...}}
           or {"id": "codec/full", "refused": "why"}, or skip or error as above; a decoder that
              fails may add the "arrays" that it has so far

`differentiable` lists the inputs whose gradients are expected in `in_bar`; others are ignored. A
port may say in its first line what it lacks. With "gradients": false only its outputs are judged,
and `in_bar` may be missing. With a list "subjects", such as ["offsets", "codec"], it is asked for
these only, and no other subject is required of it. The report says both.

ARRAY is {"dtype": "F64", "shape": [5, 3], "data": BASE64}: the numbers row by row, little-endian,
with the type names of safetensors. Lists are flat: weights.0, weights.1. Floats have the dtype of
the first line. The time limit of an answer covers compilation; `--timeout` raises it. At the end
stdin is closed, and a port that still runs a second later is killed, with all processes that it
started if the system has process groups (Windows has none).
"""

import base64
import contextlib
import io
import json
import os
import shlex
import shutil
import signal
import subprocess
import threading
import time

import numpy as np

from ..messages import shorten
from .compare import cast
from .ports import ROLES, PortError, refuse_not_judged, refuse_other_types
from .published import subjects
from .safetensors import TensorError, array_of, json_object, record_of

VERSION = 1
# After this many failures in a row a subject is given up. After as many subjects in a row, or as
# many starts of the process, everything is given up.
PATIENCE = 3
MAX_LINE_BYTES = 2**26  # of an answer
QUOTE_LENGTH = 300  # characters of stderr, or of a line that is not an answer


class AdapterError(ValueError):
    """The command of an adapter cannot be run. The message is one line."""


class Adapter(contextlib.AbstractContextManager):
    """A port that a command starts. As a context manager, it ends the process on exit."""

    def __init__(self, command, timeout=10.0, dtype="float64"):
        """Take the command of a port: one string, as for a shell, or a list of words.

        `timeout` is for each case and for the start, in seconds. Raises AdapterError.
        """
        self.command = words_of(command) if isinstance(command, str) else command
        if not self.command or shutil.which(self.command[0]) is None:
            raise AdapterError(f"adapter {command!r}: expected a command that can be run")
        self.timeout, self.dtype = timeout, np.dtype(dtype)
        # The process, what its first line says of it, and the tensors that it is asked for.
        self.child, self.says, self.asked = None, {}, ROLES
        self.lost = []  # the subject, or the start of the process, of each failure in a row
        self.last = None  # the last failure

    def run(self, case):
        """Return the outputs and gradients of one case: {"out.x": array, "in_bar.x_a": array}.

        Raises PortError of the kinds died, hung, nonsense, error, skipped, absent and not_judged.
        """
        refuse_not_judged(case, self.dtype)
        request = {
            "id": case.id,
            "subject": case.subject,
            "equation": case.equation,
            "settings": case.record["settings"],
            "differentiable": [
                name.removeprefix("in_bar.") for name in case.tensors if name.startswith("in_bar.")
            ],
            "in": self._pack(case, "in."),
            "out_bar": self._pack(case, "out_bar."),
        }
        answer = self._ask(request, case.subject)
        got = {
            f"{role}{name}": a
            for role in self.asked
            for name, a in unpack(answer, role.strip(".")).items()
        }
        refuse_other_types(case, got, self.dtype)
        return got

    def decode(self, name, data):
        """Return the arrays that the port finds in a file, and why it refuses it, or None.

        Raises PortError as `run` does.
        """
        request = {"id": f"codec/{name}", "stream": base64.b64encode(data).decode()}
        answer = self._ask(request, "codec")
        refused = answer.get("refused")
        if refused is not None:
            refused = shorten(str(refused))
        arrays = {} if refused and "arrays" not in answer else unpack(answer, "arrays")
        return arrays, refused

    def __exit__(self, *_):
        self.close()

    def close(self, grace=1.0):
        """End the process, if it runs, and all that it started; return the last of its stderr."""
        child, self.child = self.child, None
        return child.end(grace) if child else ""

    @np.errstate(over="ignore")  # beyond float32: infinite, as in every port
    def _pack(self, case, prefix):
        """Return the tensors of a role as ARRAYs in the precision of the check."""
        return {
            name.removeprefix(prefix): pack(a)
            for name, a in cast(case.tensors, self.dtype).items()
            if name.startswith(prefix)
        }

    def _ask(self, request, subject):
        """Return the answer to a request. Raises PortError, also if the port skips or fails.

        After any other failure the process is ended, and the next case starts a new one.
        """
        if self.last and PATIENCE in (len({*self.lost}), self.lost.count(subject)):
            raise PortError(
                self.last.kind,
                f"not asked, after {PATIENCE} failures in a row; the last: {self.last}",
            )
        stage = len(self.lost)  # a start; each has its own name, so that failed ones are counted
        try:
            if self.child is None:
                self.child = Child(self.command)
                self.says = self._exchange(
                    {"p4dgs_oracle": VERSION, "dtype": self.dtype.name}, "p4dgs_oracle"
                )
                self.asked = ROLES[:1] if self.says.get("gradients") is False else ROLES
                listed, known = self.says.get("subjects", []), [*subjects(), "codec"]
                require_protocol(
                    isinstance(listed, list) and all(name in known for name in listed),
                    "subjects",
                    f"expected a list of some of {', '.join(known)}, got {listed}",
                )
            stage = subject
            named = subject in self.says.get("subjects", [subject])
            answer = self._exchange(request, "id") if named else {}
        except PortError as error:
            words = self.close(grace=0)
            self.lost.append(stage)
            self.last = PortError(error.kind, f"{error}{f'; stderr: {words}' if words else ''}")
            raise self.last from None
        self.lost.clear()
        if not named:
            raise PortError("absent", "the port does not name this subject in its first line")
        for field, kind in ("skip", "skipped"), ("error", "error"):
            if answer.get(field) is not None:
                raise PortError(kind, str(answer[field]))
        return answer

    def _exchange(self, request, field):
        """Return the object that answers a request; `field` must be the same in both."""
        assert self.child, "a process runs"
        line = self.child.exchange(json.dumps(request).encode() + b"\n", self.timeout)
        answer = json_object(line)
        require_protocol(
            answer is not None,
            "answer",
            f"expected a line with a JSON object, got {repr(line[:QUOTE_LENGTH])[1:]}",
        )
        want, got = json.dumps(request[field]), json.dumps(answer.get(field))
        require_protocol(
            got == want,
            "answer",
            f"expected {field} {want}, got {got}; every request gets one line",
        )
        return answer


class Child:
    """A process and its pipes. Threads wait for the pipes, because Windows has no other way."""

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
        self.stdin, stdout, self.stderr = filter(
            None, (self.process.stdin, self.process.stdout, self.process.stderr)
        )
        self.stdout = io.BufferedReader(stdout)
        self.words = b""  # the end of stderr
        # The latest thread at work on each pipe.
        self.threads = {self.stderr: start_thread(self._listen)}

    def _listen(self):
        while part := self.stderr.read(2**16):
            self.words = (self.words + part)[-4 * QUOTE_LENGTH :]

    def _send(self, request):
        unsent = memoryview(request)
        with contextlib.suppress(OSError):  # nobody reads: stdout ends too, or time is up
            while unsent:
                unsent = unsent[self.stdin.write(unsent) :]

    def exchange(self, request, seconds):
        """Send a line and return the next line that the process writes.

        If the process wrote extra lines earlier, this is the oldest one that has not been read.
        Raises PortError of the kinds died, hung and nonsense (a line without an end).
        """
        deadline, lines = time.monotonic() + seconds, []
        sender = start_thread(self._send, request)
        receiver = start_thread(lambda: lines.append(self.stdout.readline(MAX_LINE_BYTES + 1)))
        self.threads.update({self.stdin: sender, self.stdout: receiver})
        receiver.join(seconds)
        if lines:
            require_protocol(
                len(lines[0]) <= MAX_LINE_BYTES,
                "answer",
                f"expected a line of at most {MAX_LINE_BYTES:,} bytes, got more",
            )
            if not lines[0].endswith(b"\n"):
                raise self._failure(PortError("died", "the process closed its pipes"))
            sender.join(max(deadline - time.monotonic(), 0))
        if not lines or sender.is_alive():
            late = f"no answer within {seconds:g} s, compilation included"
            raise self._failure(PortError("hung", late))
        return lines[0][:-1]

    def _failure(self, running):
        """Return the PortError of a process that has ended, or `running` if it still runs."""
        try:
            code = self.process.wait(0.5)
        except subprocess.TimeoutExpired:
            return running
        how = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
        return PortError("died", f"the process ended without an answer: {how}")

    def end(self, grace):
        """Close stdin, wait `grace` seconds, kill the group; return the end of stderr."""
        try:
            if grace:
                start_thread(self._close, self.stdin)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.process.wait(grace)
        finally:
            self.process.kill()
            with contextlib.suppress(AttributeError, ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            pipes = (*self.threads, self.stdin)
            for closing in [start_thread(self._close, pipe) for pipe in pipes]:
                closing.join(1)  # another process may hold the pipe
        lines = map(str.strip, self.words.decode(errors="replace").splitlines())
        return " / ".join(filter(None, lines))[-QUOTE_LENGTH:]

    def _close(self, pipe):
        """Close a pipe when no thread is at work on it; Windows would wait for that thread."""
        if pipe in self.threads:
            self.threads[pipe].join()
        pipe.close()


def words_of(command):
    """Return the words of a command, as a shell would split it; none if a quote is not closed."""
    if os.sep == "\\":  # Windows: a backslash belongs to a path
        command = command.replace("\\", r"\\")
    try:
        return shlex.split(command)
    except ValueError:
        return []


def start_thread(function, *arguments):
    """Return a started thread, which does not keep this process alive."""
    thread = threading.Thread(target=function, args=arguments, daemon=True)
    thread.start()
    return thread


def pack(array):
    """Return an array as an ARRAY of the protocol."""
    record, data = record_of(array)
    return {**record, "data": base64.b64encode(data).decode()}


def unpack(answer, role):
    """Return the arrays of one field of an answer.

    Raises PortError, kind nonsense, which names the array and what was expected.
    """
    fields = answer.get(role)
    require_protocol(isinstance(fields, dict), f"field {role!r}", "expected an object of arrays")
    return {name: _array(f"{role}.{name}", field) for name, field in fields.items()}


def _array(name, field):
    require_protocol(isinstance(field, dict), name, "expected the fields dtype, shape and data")
    try:
        return array_of(name, field, base64.b64decode(field.get("data"), validate=True))
    except TensorError as error:
        raise PortError("nonsense", str(error)) from None
    except (TypeError, ValueError):
        raise PortError("nonsense", f"{name}: expected data in base64") from None


def require_protocol(condition, where, expected):
    """Raise a PortError unless the condition holds: an answer breaks the protocol."""
    if not condition:
        raise PortError("nonsense", f"{where}: {expected}")
