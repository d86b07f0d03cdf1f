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
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

from .signals import deferred

try:
    import fcntl
except ImportError:  # Windows, which can lock a file, but not a folder
    fcntl = None
try:
    import msvcrt
except ImportError:  # not Windows
    msvcrt = None

PART = ".p4dgs-part-"
LOCK = ".p4dgs-lock"  # a file in a locked folder, if the folder itself cannot be locked


class OutputError(ValueError):
    """A path that cannot be written to: one line that names it and what was expected."""


@contextmanager
def locked(folder):
    """Hold the lock of a folder, which the system releases when the process ends.

    Raises OutputError if another process holds it. Not every file system has locks.
    """
    path = Path(folder) if fcntl else Path(folder) / LOCK
    handle = os.open(path, os.O_RDONLY if fcntl else os.O_RDWR | os.O_CREAT)
    try:
        try:
            lock(handle)
        except (BlockingIOError, PermissionError):
            raise OutputError(
                f"{folder}: another process is writing to it; expected another folder"
            ) from None
        except OSError:
            pass  # no locks there
        yield
    finally:
        os.close(handle)
        if not fcntl:
            with suppress(OSError):  # another process holds it
                path.unlink()


def lock(handle):
    """Lock an open file or folder; raises BlockingIOError or PermissionError if it is locked."""
    if fcntl:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    elif msvcrt:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)


def destination(path):
    """Return the regular file that `path` stands for, following links; it need not exist."""
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        raise OutputError(
            f"{path}: expected a regular file or an unused name, found "
            f"{'a folder' if target.is_dir() else 'a device, pipe, socket or broken link'}"
        )
    return target


@contextmanager
def new_part(folder):
    """Yield a hidden folder inside `folder`, which is removed at the end.

    A system error names the file in `folder` that was written last. The hidden folder is removed
    even if the process has no file descriptors left, and never hides an earlier error.
    """
    part, spare = None, open(os.devnull)
    try:
        with deferred():  # a signal while it is made would leave it behind
            part = Path(mkdtemp(prefix=PART, dir=folder))
        yield part
    except OSError as error:
        if error.errno:  # of the system, such as a full disk
            name = error.filename2 or error.filename or [part, *files_in(part)][-1]
            error.filename = os.path.join(
                *(place for place in Path(name).parts if not place.startswith(PART))
            )
        raise
    finally:
        spare.close()  # `remove` needs one descriptor
        if part:
            remove(part)


def files_in(folder):
    """Return all files below a folder in the order in which they were written, then by size."""
    files = filter(Path.is_file, folder.rglob("*"))
    return sorted(files, key=lambda file: (file.stat().st_mtime_ns, file.stat().st_size))


def remove(part):
    """Remove a hidden folder, using one file descriptor; what cannot be removed stays."""
    for folder, _, files in os.walk(part, topdown=False):
        for name in files:
            with suppress(OSError):
                os.unlink(os.path.join(folder, name))
        with suppress(OSError):
            os.rmdir(folder)


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
        make_folder(folder)
        yield folder
    except BaseException:
        with suppress(OSError):  # the first folder that was not made, or is not empty, ends it
            for place in missing:  # the deepest one first
                place.rmdir()
        raise


def make_folder(folder):
    """Make a folder if it is not there, and prove that it can be written to."""
    try:
        with deferred():
            folder.mkdir(parents=True, exist_ok=True)
            TemporaryDirectory(prefix=PART, dir=folder).cleanup()
    except OSError as error:
        raise OutputError(f"{folder}: expected a writable folder ({error.strerror})") from None


@contextmanager
def staged_folder(path, reads=None):
    """Yield a fresh folder to write into, whose files move to the folder `path` at the end.

    The folder `path` is locked in the meantime, so its content may be checked first. After an error
    nothing is moved. None of the files may replace the file `reads`. A signal that arrives while
    they are moved raises KeyboardInterrupt afterwards, and its message says where they are.
    """
    with writable_folder(path) as folder, locked(folder), new_part(folder) as part:
        yield part
        files = files_in(part)
        targets = [writable(folder / file.relative_to(part), reads) for file in files]
        for target in targets:  # subfolders are made only if all files can be written
            make_folder(next(filter(os.path.lexists, target.parents)))
        with deferred(f"; all files are in {folder}"):  # they move, or none does
            for i, target in enumerate(targets):
                try:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    move(files[i], target)
                except OSError as error:  # despite the checks: something has changed since
                    error.strerror = f"{error.strerror}; {i} of {len(files)} files are replaced"
                    raise


def move(file, target):
    """Move `file` to `target`, which may be on another disk if a link led there."""
    try:
        os.replace(file, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        with TemporaryDirectory(prefix=PART, dir=target.parent) as beside:
            os.replace(shutil.copy(file, beside), target)


def writable(path, *reads, start=b""):
    """Return the regular file that `path` stands for, if a new one may take its place.

    It must not be one of the files `reads`, from which it is made; None stands for no file. An old
    file must be empty or begin with `start`, as the new one does.
    """
    target = destination(path)
    if target in [Path(os.path.realpath(file)) for file in reads if file]:
        raise OutputError(f"{path}: an input of this command; expected another output")
    if target.exists():
        with open(target, "rb") as old:
            if old.read(len(start)) not in (b"", start):
                raise OutputError(f"{path}: a file of another kind is there; expected a new name")
        os.replace(target, target)  # does nothing, but Windows refuses a file that a program holds
    return target


@contextmanager
def new_file(path, *reads, start=b""):
    """Prove that the file `path` can be written, as `writable` does, and make its folder."""
    with writable_folder(writable(path, *reads, start=start).parent):
        yield Path(path)


def refuse_existing(path, remedy="delete it or name another folder"):
    """Raise OutputError if the file `path`, which another training left, exists.

    Raises OSError for a name that the file system does not accept.
    """
    with suppress(FileNotFoundError, NotADirectoryError):
        os.lstat(path)
        raise OutputError(f"{path}: exists; {remedy}")
