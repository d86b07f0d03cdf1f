"""Files and folders that are never half-written.

Everything is written into a hidden folder `.p4dgs-part-...` beside its place and then renamed. A
rename replaces a file in one step, so a reader sees the old file or the whole new one. If a process
is killed, its hidden folder stays. A command that writes several files into a folder holds the lock
of that folder, from the check of what is there until the last file is written.

A command may replace only regular files that it does not read. A file that the user names must be
empty or of the kind that is written, which its first bytes tell. In a folder that the user names,
only files with the names of the command's own files are replaced. A checkpoint of `train` or a
report of `demo` is never replaced by another training.
"""

import errno
import os
import shutil
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from .signals import deferred

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there
    fcntl = None

PART = ".p4dgs-part-"
SPARE = 6  # file descriptors, more than removing a hidden folder takes


class OutputError(ValueError):
    """A place that cannot be written to: one line that names it and what was expected."""


@contextmanager
def locked(folder):
    """Hold the lock of a folder, which the system releases when the process ends.

    Raises OutputError where another process holds it. Not every file system has locks.
    """
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"{folder}: another process is writing to it; expected a folder of its own"
            ) from None
        except OSError:
            pass  # no locks there
        yield
    finally:
        os.close(handle)


def destination(path):
    """The regular file that `path` stands for; it need not exist, and links are followed."""
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        raise OutputError(
            f"{path}: expected a regular file or nothing, found "
            f"{'a folder' if target.is_dir() else 'a device, pipe, socket or broken link'}"
        )
    return target


@contextmanager
def new_part(folder):
    """Yield a hidden folder inside `folder`, which is removed at the end.

    An error of the system names the file in `folder` that was written last. The hidden folder is
    removed even if the process has no file descriptors left; this hides no earlier error.
    """
    with ExitStack() as spare:
        for _ in range(SPARE):
            spare.enter_context(open(os.devnull))
        with deferred():  # a signal while it is made would leave it behind
            hidden = TemporaryDirectory(prefix=PART, dir=folder, ignore_cleanup_errors=True)
        with hidden as name, spare:
            part = Path(name)
            try:
                yield part
            except OSError as error:
                if error.errno:  # of the system, such as that the disk is full
                    name = error.filename2 or error.filename or [part, *files_in(part)][-1]
                    error.filename = os.path.join(
                        *(place for place in Path(name).parts if not place.startswith(PART))
                    )
                raise


def files_in(folder):
    """All files below a folder in the order in which they were written; at one time, by size."""
    files = filter(Path.is_file, folder.rglob("*"))
    return sorted(files, key=lambda file: (file.stat().st_mtime_ns, file.stat().st_size))


@contextmanager
def replaced(path):
    """Yield the name of a new file, which at the end replaces the file that `path` stands for."""
    target = destination(path)
    with new_part(target.parent) as part:
        yield part / target.name
        os.replace(part / target.name, target)


def write_atomically(path, write):
    """Call `write(file)` on a new file, then put it in the place of `path`."""
    with replaced(path) as part, open(part, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def writable_folder(path):
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
def staged_folder(path, reads=None):
    """Yield a fresh folder to write into, whose files move to the folder `path` at the end.

    The folder `path` is locked in the meantime, so its content may be checked first. After an error
    nothing is moved. None of the files may replace the file `reads`. A signal that arrives while
    they move raises KeyboardInterrupt at the end, and its message says that they are written.
    """
    with writable_folder(path) as folder, locked(folder), new_part(folder) as part:
        yield part
        files = files_in(part)
        with ExitStack() as proven:  # takes away folders that it made if not all can be written
            for file in files:
                proven.enter_context(new_file(folder / file.relative_to(part), reads))
            with deferred(f"; all files are in {folder}"):  # they move, or none does
                for file in files:
                    place = folder / file.relative_to(part)
                    try:
                        os.replace(file, destination(place))
                    except OSError as error:
                        if error.errno != errno.EXDEV:
                            raise
                        with replaced(place) as there:  # on another disk, where a link leads
                            shutil.move(file, there)


@contextmanager
def new_file(path, *reads, start=b""):
    """Prove that the file `path` can be written; its folder is made as in `writable_folder`.

    It must be none of the files `reads`, from which it is made; None stands for no file. An old
    file must be empty or begin with `start`, as the new one does.
    """
    target = destination(path)
    if target in [Path(os.path.realpath(file)) for file in reads if file]:
        raise OutputError(f"{path}: this is the input; expected another place to write to")
    if target.exists():
        with open(target, "rb") as old:
            if old.read(len(start)) not in (b"", start):
                raise OutputError(f"{path}: a file of another kind; expected a new name")
    with writable_folder(target.parent):
        yield Path(path)


def refuse_existing(path, remedy="delete it, or name another folder"):
    """Refuse to train where another training has left the file `path`.

    Raises OSError for a name that the file system does not take.
    """
    with suppress(FileNotFoundError, NotADirectoryError):
        os.lstat(path)
        raise OutputError(f"{path}: exists; {remedy}")
