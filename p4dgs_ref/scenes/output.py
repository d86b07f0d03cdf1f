"""Files and folders that are never half-written.

Everything is written beside its place and then renamed. A rename replaces a file in one step, so a
reader sees the old file or the whole new one.
"""

import os
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path


class OutputError(ValueError):
    """A place that cannot be written to: one line that names it and what was expected."""


def write_atomically(path, write):
    """Call `write(file)` on a new file beside `path`, then rename it to `path`."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(beside, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def remove_leftovers(path):
    """Delete the files that killed processes left beside `path` in `write_atomically`."""
    for beside in Path(path).parent.glob(f".{Path(path).name}.*.part"):
        beside.unlink(missing_ok=True)


@contextmanager
def made(path):
    """Make the folder `path` and prove that it can be written to, before any long work begins.

    If the work fails, the folders that were made for it are removed again where they are empty.
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
    with made(path) as folder, tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as part:
        yield Path(part)
        files = [file for file in Path(part).rglob("*") if file.is_file()]
        places = {file: folder / file.relative_to(part) for file in files}
        for place in places.values():
            if place.is_dir():
                raise OutputError(f"{place}: expected a file or nothing, found a folder")
            if any(above.exists() and not above.is_dir() for above in place.parents):
                raise OutputError(f"{place.parent}: expected a folder or nothing, found a file")
        for file in sorted(files, key=lambda file: file.stat().st_mtime_ns):  # oldest first
            places[file].parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, places[file])


@contextmanager
def new_file(path):
    """Prove that the file `path` can be written; its folder is made as in `made`."""
    if Path(path).is_dir():
        raise OutputError(f"{path}: expected the name of a file, found a folder")
    with made(Path(path).parent):
        yield Path(path)
