"""Files and folders that are never half-written.

Everything is written into a hidden folder `.part-...` beside its place and then renamed. A rename
replaces a file in one step, so a reader sees the old file or the whole new one. Only the hidden
folder of a process that was killed stays.
"""

import os
import shutil
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from ..signals import deferred

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there
    fcntl = None

PART = ".part-"


class OutputError(ValueError):
    """A place that cannot be written to: one line that names it and what was expected."""


@contextmanager
def locked(folder):
    """Hold the lock of a folder, which the system releases when the process ends.

    Raises OutputError where another process holds it. Not every file system has such locks.
    """
    with ExitStack() as stack:
        if fcntl is not None:
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            with suppress(OSError):  # a file system without locks
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise OutputError(
                        f"{folder}: another process is writing to it; expected a folder of its own"
                    ) from None
        yield


def destination(path):
    """The regular file that `path` stands for; it need not exist, and links are followed."""
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        kind = "a folder" if target.is_dir() else "a device, pipe, socket or broken link"
        raise OutputError(f"{path}: expected a regular file or nothing, found {kind}")
    return target


@contextmanager
def new_part(folder):
    """Yield a hidden folder inside of `folder`, which is removed at the end."""
    with ExitStack() as stack:
        with deferred():  # a signal between its making and its `with` would leave it behind
            part = stack.enter_context(TemporaryDirectory(prefix=PART, dir=folder))
        yield Path(part)


@contextmanager
def replaced(path):
    """Yield the name of a new file, which at the end replaces the file that `path` stands for."""
    target = destination(path)
    with new_part(target.parent) as part:
        yield part / target.name
        os.replace(part / target.name, target)


def write_atomically(path, write):
    """Call `write(file)` on a new file, then put it in the place of `path`."""
    with replaced(path) as beside, open(beside, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def made(path):
    """Make the folder `path` and prove that it can be written to, before any long work begins.

    If the work fails, the folders that were made for it are removed again where they are empty.
    """
    folder = Path(path)
    missing = [place for place in (folder, *folder.parents) if not os.path.lexists(place)]
    try:
        try:
            with deferred():
                folder.mkdir(parents=True, exist_ok=True)
                TemporaryDirectory(prefix=PART, dir=folder).cleanup()
        except OSError as error:
            raise OutputError(
                f"{folder}: expected a folder that can be written to ({error.strerror})"
            ) from None
        yield folder
    except BaseException:
        with suppress(OSError):  # the first folder that was not made, or is not empty, ends it
            for place in missing:  # the deepest one first
                place.rmdir()
        raise


@contextmanager
def filled(path, reads=None):
    """Yield a fresh folder to write into, whose files move to the folder `path` at the end.

    After an error nothing is moved. None of them may take the place of the file `reads`.
    """
    with made(path) as folder, new_part(folder) as part:
        yield part
        files = [file for file in part.rglob("*") if file.is_file()]
        for file in files:
            with new_file(folder / file.relative_to(part), reads):
                pass
        with deferred():  # all files move, or none
            for file in sorted(files, key=lambda file: file.stat().st_mtime_ns):  # oldest first
                with replaced(folder / file.relative_to(part)) as beside:
                    shutil.move(file, beside)


@contextmanager
def new_file(path, reads=None):
    """Prove that the file `path` can be written; its folder is made as in `made`.

    It must not be the file `reads`, from which it is made.
    """
    if reads is not None and destination(path) == Path(os.path.realpath(reads)):
        raise OutputError(f"{path}: this is the input; expected another place to write to")
    with made(destination(path).parent):
        yield Path(path)
