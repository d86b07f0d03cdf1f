"""Checks notebooks: their outputs, and mathematics and links of the prose."""

import base64
import binascii
import json
import re
import struct
import tempfile
from pathlib import Path

from tutorials.tools import notebooks

# Folders of this machine, which no output may name.
HERE = tuple(map(str, (tempfile.gettempdir(), Path.home(), Path(__file__).resolve().parents[2])))
SIDES = range(60, 2401)  # pixels of a picture
LARGEST_PICTURE = 600_000  # bytes
LONGEST_TEXT = 6_000  # characters that one cell prints
ITEM = r"(\d+\.|[-+*]) "


# --- what differs from the tutorials --------------------------------------------------------------
def problems(folder):
    """The notebooks that are missing, stale or without a tutorial, one line each."""
    known = {source.stem: source for source in notebooks.tutorials(folder)}
    files = {file.stem: file for file in (folder / "notebooks").glob("*.ipynb")}
    found = [f"{name}: no such tutorial" for name in sorted(files.keys() - known.keys())]
    for name, source in known.items():
        if name not in files:
            found.append(f"{name}: missing")
        elif without_outputs(load(files[name])) != notebooks.unrun(source):
            found.append(f"{name}: stale")
    return found


def load(file):
    return json.loads(file.read_text(encoding="utf-8"))


def without_outputs(notebook):
    """The notebook as the maker has it before it runs the cells."""
    return {
        **notebook,
        "cells": [
            {**cell, "outputs": []} if cell["cell_type"] == "code" else cell
            for cell in notebook["cells"]
        ],
    }


# --- the outputs ----------------------------------------------------------------------------------
def those(*rows):
    """What is said in the rows (said, whether it is so) that are so."""
    return [said for said, is_so in rows if is_so]


def flaws(notebook):
    """What no output may show or be, one line each; the rest of a notebook is the maker's."""
    found = []
    for output in (output for cell in notebook["cells"] for output in cell.get("outputs", ())):
        data = output.get("data", {})
        found += text_flaws(output.get("text") or data["text/plain"])
        found += picture_flaws(data["image/png"]) if "image/png" in data else []
    return found


def text_flaws(text):
    path = re.search(r"(?<![\w.])/(tmp|work|home|root|usr|Users)/|site-packages|[A-Z]:\\", text)
    here = any(folder in text for folder in HERE)
    return those(
        (f"path or traceback in the output: {text[:80]!r}", path or here or "Traceback" in text),
        (f"an address in the output: {text[:80]!r}", re.search(r" at 0x[0-9a-f]{6}", text)),
        (f"{len(text):,} characters in one output", len(text) > LONGEST_TEXT),
    )


def picture_flaws(picture):
    try:
        data = base64.b64decode(picture, validate=True)
    except (binascii.Error, TypeError, ValueError):
        return ["picture: not base64"]
    if data[:16] != b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" or data[-8:-4] != b"IEND":
        return ["picture: not a PNG"]
    width, height = struct.unpack(">II", data[16:24])
    if width not in SIDES or height not in SIDES or len(data) > LARGEST_PICTURE:
        return [f"picture: {width}x{height}, {len(data):,} bytes"]
    return []


def picture(output):
    """The bytes of the picture of an output."""
    return base64.b64decode(output["data"]["image/png"])


# --- the prose ------------------------------------------------------------------------------------
def links(notebook):
    """The relative links of the prose."""
    prose = ("".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "markdown")
    return [link.split("#")[0] for text in prose for link in notebooks.LINK.findall(text)]


def prose_flaws(text):
    """Mathematics and marks that the viewers of notebooks show in another way than intended.

    MathJax knows the macros of amsmath. The viewers look for formulas before they look for other
    marks, except for code between backticks, and end a formula at an empty line.
    """
    text = re.sub(r"```.*?```|`[^`\n]*`", "code", text, flags=re.S)
    displayed = re.findall(r"\$\$(.*?)\$\$", text, flags=re.S)
    text = re.sub(r"\$\$.*?\$\$", "formula", text, flags=re.S)
    inline = re.findall(r"\$(.+?)\$", text, flags=re.S)
    text = re.sub(r"\$.+?\$", "formula", text, flags=re.S)
    lines = text.splitlines()
    return [
        *(flaw for formula in displayed + inline for flaw in formula_flaws(formula)),
        *those(
            ("a tag in a formula of a line", any(r"\tag" in formula for formula in inline)),
            ("a dollar sign without its partner", "$" in text),
            *((f"HTML: {mark}", True) for mark in re.findall(r"</?[a-zA-Z!][^\n]{0,20}", text)),
            *(
                (f"a list without an empty line before it: {line[:50]!r}", re.match(ITEM, line))
                for before, line in zip(lines, lines[1:])
                if not re.match(rf"$|  |{ITEM}", before)
            ),
        ),
    ]


def formula_flaws(formula):
    inner = re.sub(r"\\begin\{(\w+\*?)\}.*?\\end\{\1\}", "", formula, flags=re.S)
    macro = re.search(r"\\(label|ref|eqref|require|newcommand|def|bm|mbox|SI|unit)\b", formula)
    hidden = r"\tag" in formula and r"\tag" not in inner
    return those(
        (f"empty line or backtick in {formula[:50]!r}", "\n\n" in formula or "`" in formula),
        (f"macro that MathJax does not know: {formula[:50]!r}", macro),
        (f"tags within a formula: {formula[:50]!r}", formula.count(r"\tag") > 1 or hidden),
        (f"braces: {formula[:50]!r}", formula.count("{") != formula.count("}")),
    )
