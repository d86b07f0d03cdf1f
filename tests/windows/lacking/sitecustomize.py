"""Takes away from Python on Linux what it does not have on Windows; PYTHONPATH names this folder.

This cannot prove that the package runs on Windows. It keeps the faults that are known from coming
back. `sys.platform` stays as it is, because the standard library would look for a real Windows.
"""

import builtins
import ctypes
import fcntl
import io
import os
import platform
import select
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

lockf = fcntl.lockf
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None  # importing it raises ImportError


def lock(handle, mode, count):
    """Lock bytes of a file, without waiting, as msvcrt does."""
    try:
        lockf(handle, 2 | 4, count)  # LOCK_EX | LOCK_NB
    except BlockingIOError:
        raise PermissionError(13, "Permission denied") from None


# After subprocess was imported, which looks for this module.
sys.modules["msvcrt"] = SimpleNamespace(locking=lock, LK_NBLCK=2)

LACKING = {
    os: "killpg getpgid setsid setpgid fork mkfifo mknod getuid geteuid sysconf nice "
    "getloadavg sched_getaffinity O_DIRECTORY O_NOFOLLOW",
    signal: "SIGHUP SIGKILL SIGALRM SIGPIPE alarm pthread_sigmask",
    select: "PIPE_BUF poll epoll",
}
kill = signal.SIGKILL
for module, names in LACKING.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
platform.machine = lambda: "AMD64"
shutil._use_fd_functions = False  # there a folder has no descriptor
subprocess.Popen.kill = subprocess.Popen.terminate = lambda self: self.send_signal(kill)


class CDLL(ctypes.CDLL):
    """Refuses a library without a name as ctypes of Python 3.10 to 3.13 does on Windows."""

    def __init__(self, name=None, *others, **options):
        if name is None:
            raise TypeError("argument of type 'NoneType' is not iterable")
        super().__init__(name, *others, **options)


ctypes.CDLL = CDLL


def guarded(module, name, check):
    """Replace a function by one that first calls `check` with the same arguments."""
    function = getattr(module, name)

    def checked(*arguments, **options):
        check(*arguments, **options)
        return function(*arguments, **options)

    setattr(module, name, checked)


def sockets_alone(*arguments):
    """What select takes."""
    for file in (file for files in arguments[:3] for file in files):
        if not hasattr(file, "getsockname"):
            raise OSError(10038, "an operation was attempted on something that is not a socket")


def no_folder(path, *others, **options):
    """What os.open opens."""
    takes_name(path)
    if not isinstance(path, int) and os.path.isdir(path):
        raise PermissionError(13, "Permission denied", os.fspath(path))


def takes_name(path, *others, **options):
    """The names of files and folders."""
    if not isinstance(path, int) and any(c in '<>:"|?*' for c in os.fspath(path)):
        raise OSError(22, "The filename, directory name, or volume label syntax is incorrect", path)


def held(path):
    """Whether this process or its parent has a file open: that one, or one in that folder."""
    path = os.path.realpath(path)
    for process in ("self", os.getppid()):
        for link in Path(f"/proc/{process}/fd").iterdir():
            try:
                at = os.readlink(link)
            except OSError:  # it has just been closed
                continue
            if at == path or at.startswith(f"{path}/"):
                return True
    return False


def nobody_holds(path, other=None, **options):
    """What is renamed, replaced or removed."""
    for name in filter(None, (path, other)):
        if options.get("dir_fd") is None and os.path.exists(name) and held(name):
            words = "The process cannot access the file because it is being used by another process"
            raise PermissionError(13, words, os.fspath(name))


guarded(select, "select", sockets_alone)
guarded(os, "open", no_folder)
guarded(os, "mkdir", takes_name)
for name in ("rename", "replace", "unlink", "remove"):
    guarded(os, name, nobody_holds)
open_file = io.open


def open_text(
    file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, *others, **options
):
    """Text is written with the line ends of Windows."""
    takes_name(file)
    if newline is None and "b" not in mode and not {*"wax"}.isdisjoint(mode):
        newline = "\r\n"
    return open_file(file, mode, buffering, encoding, errors, newline, *others, **options)


io.open = builtins.open = open_text
