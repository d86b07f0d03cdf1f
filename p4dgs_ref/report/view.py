"""One HTML page that shows .p4dgs files: the scripts of `viewer/` and the files are inside of it."""

import base64
import json
import re
from pathlib import Path

from ..scenes.output import new_file, write_atomically

VIEWER = Path(__file__).parents[1] / "viewer"
FILES = '<script type="application/json" id="files">'  # stands before the page's empty list


def page(files):
    """The page as bytes, for files {path: bytes}, of which it shows the first one at first."""
    embedded = [
        {"name": Path(path).name, "base64": base64.b64encode(data).decode()}
        for path, data in files.items()
    ]
    text = re.sub(
        r'<script src="(.*)">',
        lambda found: "<script>\n" + (VIEWER / found[1]).read_text(encoding="utf-8"),
        (VIEWER / "page.html").read_text(encoding="utf-8"),
    )
    inside = json.dumps(embedded).replace("<", "\\u003c")  # no name of a file ends the script
    return text.replace(f"{FILES}[]", FILES + inside).encode()


def view(files, path):
    """Write the page for files {path: bytes} and return its size in bytes.

    Raises OutputError where `path` cannot be written or is one of the files.
    """
    for name in files:
        with new_file(path, name):
            data = page(files)
    write_atomically(path, lambda file: file.write(data))
    return len(data)
