"""One HTML page that shows .p4dgs files: it contains the scripts of `viewer/` and the files."""

import base64
import json
import re
from pathlib import Path

from ..output import new_file, write_atomically

VIEWER = Path(__file__).parents[1] / "viewer"


def page(files, notes=None):
    """Return the page as bytes, complete in one file: `with_files` with the scripts inside."""
    return re.sub(
        r'<script src="(.*)">',
        lambda tag: "<script>\n" + (VIEWER / tag[1]).read_text(encoding="utf-8"),
        with_files(files, notes),
    ).encode()


def with_files(files, notes=None):
    """Return the text of page.html with files {path: bytes}; the first one is shown first.

    `notes` {path: {...}} say more about a file: `anchor` is the one that the guide follows. Files
    with `lambda_rate` and `psnr_db` (against the true pictures) give the guide its last step.
    """
    notes = notes or {}
    embedded = [
        {"name": Path(path).name, **notes.get(path, {}), "base64": base64.b64encode(data).decode()}
        for path, data in files.items()
    ]
    # The page has an empty list of files. No "<" in a name may end the script that contains it.
    files = 'id="files">' + json.dumps(embedded).replace("<", r"\u003c")
    return (VIEWER / "page.html").read_text(encoding="utf-8").replace('id="files">[]', files)


def view(files, path):
    """Write the page for files {path: bytes} and return its size in bytes.

    Raises OutputError if `path` cannot be written or is one of the files.
    """
    data = page(files)
    with new_file(path, *files, start=data[:9]):  # <!doctype
        write_atomically(path, lambda file: file.write(data))
    return len(data)
