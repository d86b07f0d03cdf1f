"""Files and folders that are never half-written: everything is made beside its place and then renamed into it."""

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path


class OutputError(ValueError):
    """A place that cannot be written to: one line naming it and what was expected."""


def write_atomically(path, write):
    """Call `write(file)` on a file beside `path`, then rename: a reader sees the old file or the whole new one."""
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
    """Delete what killed processes left beside `path` in the middle of `write_atomically`."""
    for beside in Path(path).parent.glob(f".{Path(path).name}.*.part"):
        beside.unlink(missing_ok=True)


@contextmanager
def made(path):
    """The folder `path`, made and proved writable before minutes are spent; taken away again if the work fails empty.

    Raises     OutputError
    """
    folder, missing = Path(path), []
    try:
        try:
            missing = [
                place for place in (folder, *folder.parents) if not place.exists()
            ]  # deepest first
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise OutputError(
                f"{folder}: expected a folder that can be written to ({error.strerror})"
            ) from None
        yield folder
    except BaseException:
        for place in missing:
            try:
                place.rmdir()
            except OSError:  # not made, or something worth keeping is in it
                break
        raise


@contextmanager
def filled(path):
    """A fresh folder to write into; at the end its files move to the folder `path`, after an error they vanish.

    Raises     OutputError
    """
    with made(path) as folder, tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as beside:
        yield Path(beside)
        files = sorted(
            (file for file in Path(beside).rglob("*") if file.is_file()),
            key=lambda file: file.stat().st_mtime_ns,
        )  # in order of writing
        places = [folder / file.relative_to(beside) for file in files]
        for place in places:
            if place.is_dir():
                raise OutputError(f"{place}: expected a file or nothing, found a folder")
            if any(above.exists() and not above.is_dir() for above in place.parents):
                raise OutputError(f"{place.parent}: expected a folder or nothing, found a file")
        for file, place in zip(files, places):
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, place)


@contextmanager
def new_file(path):
    """Prove that the file `path` can be written; its folder is made, and taken away again if the work fails.

    Raises     OutputError
    """
    if Path(path).is_dir():
        raise OutputError(f"{path}: expected the name of a file, found a folder")
    with made(Path(path).parent):
        yield Path(path)
