"""Python in processes of its own, with the package that the tests themselves import."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import p4dgs_ref
from p4dgs_ref.signals import SIGNALS
from tests import ROOT

# PYTHONPATH of every process: the package first, which the checkout has, too.
PATHS = os.pathsep.join(map(str, (Path(p4dgs_ref.__file__).resolve().parents[1], ROOT)))
# A folder where `python -c` and `python -m`, which look into it first, find no package.
ASIDE = ROOT / "tests"
CAPTURED = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8")


def run(*options, env=None):
    """Run Python with options to its end."""
    return subprocess.run([sys.executable, *options], cwd=ASIDE, env=env, **CAPTURED)


def start(*options, cwd=ASIDE):
    """Start Python with options; signals reach it, also where the tests themselves ignore them."""
    return subprocess.Popen(
        [sys.executable, *options],
        cwd=cwd,
        preexec_fn=lambda: [signal.signal(number, signal.SIG_DFL) for number in SIGNALS],
        **CAPTURED,
    )


def alive(pid):
    """Whether a process runs; one that has ended, but that nobody has looked at since, does not."""
    try:
        return fields(pid)[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def fields(pid):
    """What the system says of a process, from its state on."""
    return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()


def wait_until_gone(pids, seconds=5.0):
    """A killed process is gone when whoever inherits it has looked; that is a moment later."""
    end = time.monotonic() + seconds
    while any(map(alive, pids)):
        assert time.monotonic() < end, "a process outlives its parent"
        time.sleep(0.02)


def workers(pid, count, word=b"spawn_main"):
    """The processes with a word in their command that a process has started; waits for `count`."""
    while True:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()
        commands = {child: Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
        found = [int(child) for child, words in commands.items() if word in words]
        if len(found) == count:
            return found
        time.sleep(0.02)


def busy(pids, seconds=0.3):
    """Wait until processes have used some processor time; returns them.

    A pool that is still starting a worker when another one is killed may end with a traceback of
    CPython's own thread, or wait for ever: it counts its workers while the start changes them.
    """
    while any(spent(pid) < seconds for pid in pids):
        time.sleep(0.02)
    return pids


def spent(pid):
    """The processor seconds of a process so far."""
    return sum(map(int, fields(pid)[11:13])) / os.sysconf("SC_CLK_TCK")
