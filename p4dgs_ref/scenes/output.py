"""Files and folders that are never half-written.

Everything is written into a hidden folder `.part-...` beside its place and then renamed. A rename
replaces a file in one step, so a reader sees the old file or the whole new one. The hidden folder
is locked while its process lives; whatever writes to the same place next deletes one that is not.
"""

import os
import shutil
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path

from ..signals import deferred

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there, and what killed processes left stays
    fcntl = None

PART = ".part-"


class OutputError(ValueError):
    """A place that cannot be written to: one line that names it and what was expected."""


@contextmanager
def locked(folder):
    """Hold the lock of a folder, which the system releases when the process ends.

    Yields whether the folder is locked now: not every system and file system has such locks. Raises
    OutputError where another process holds the lock.
    """
    if fcntl is None:
        yield False
        return
    handle, held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY), False
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held = True
        except BlockingIOError:
            raise OutputError(
                f"{folder}: another process is writing to it; expected a folder of its own"
            ) from None
        except OSError:
            pass  # a file system without locks
        yield held
    finally:
        os.close(handle)


@contextmanager
def new_part(folder):
    """Yield a new hidden folder in `folder`, locked, which is deleted at the end."""
    with tempfile.TemporaryDirectory(prefix=PART, dir=folder) as part, locked(part):
        yield Path(part)


def remove_leftovers(folder):
    """Delete the hidden folders that killed processes left in `folder`."""
    for left in Path(folder).glob(PART + 8 * "?"):
        with suppress(OSError, OutputError), locked(left) as free:
            # Between its creation and its lock, a folder of a living process is a moment old.
            if free and time.time() - left.stat().st_mtime > 1:
                shutil.rmtree(left)


def destination(path):
    """The regular file that `path` stands for; it need not exist, and links are followed."""
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        kind = "a folder" if target.is_dir() else "a device, pipe, socket or broken link"
        raise OutputError(f"{path}: expected a regular file or nothing, found {kind}")
    return target


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

    What killed processes left in it is deleted. If the work fails, the folders that were made for
    it are removed again where they are empty.
    """
    folder, missing = Path(path), []
    try:
        try:
            missing = [place for place in (folder, *folder.parents) if not place.exists()]
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise OutputError(
                f"{folder}: expected a folder that can be written to ({error.strerror})"
            ) from None
        remove_leftovers(folder)
        yield folder
    except BaseException:
        with suppress(OSError):  # the first folder that was not made, or is not empty, ends it
            for place in missing:  # the deepest one first
                place.rmdir()
        raise


@contextmanager
def filled(path):
    """Yield a fresh folder to write into, whose files move to the folder `path` at the end.

    After an error nothing is moved.
    """
    with made(path) as folder, new_part(folder) as part:
        yield part
        files = [file for file in part.rglob("*") if file.is_file()]
        places = {file: folder / file.relative_to(part) for file in files}
        for place in places.values():
            destination(place)
            if any(above.exists() and not above.is_dir() for above in place.parents):
                raise OutputError(f"{place.parent}: expected a folder or nothing, found a file")
        with deferred():  # all files move, or none
            for file in sorted(files, key=lambda file: file.stat().st_mtime_ns):  # oldest first
                places[file].parent.mkdir(parents=True, exist_ok=True)
                with replaced(places[file]) as beside:
                    shutil.move(file, beside)


@contextmanager
def new_file(path):
    """Prove that the file `path` can be written; its folder is made as in `made`."""
    with made(destination(path).parent):
        yield Path(path)
