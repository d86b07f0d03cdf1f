"""Checks notebooks: their outputs, and mathematics and links of the prose."""

import json
import re
import tempfile
from pathlib import Path

from tutorials.tools import notebooks

# Folders of this machine, which no output may name.
HERE = tuple(map(str, (tempfile.gettempdir(), Path.home(), Path(__file__).resolve().parents[2])))
LONGEST_TEXT = 6_000  # characters that one cell prints
ITEM = r"(\d+\.|[-+*]) "


# --- what differs from the tutorials --------------------------------------------------------------
def problems(folder):
    """The notebooks that are missing, stale or without a tutorial, one line each."""
    known = {source.stem: source for source in notebooks.tutorials(folder)}
    files = {file.stem: file for file in (folder / "notebooks").glob("*.ipynb")}
    lines = [f"{name}: no such tutorial" for name in sorted(files.keys() - known.keys())]
    for name, source in known.items():
        if name not in files:
            lines.append(f"{name}: missing")
        elif without_outputs(load(files[name])) != notebooks.unrun(source):
            lines.append(f"{name}: stale")
    return lines


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
def flaws(notebook):
    """What no output may show, one line each; the rest of a notebook is the maker's."""
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", ())]
    texts = [output.get("text") or output["data"]["text/plain"] for output in outputs]
    return [f"{flaw}: {text[:80]!r}" for text in texts for flaw in text_flaws(text)]


def text_flaws(text):
    path = re.search(r"(?<![\w.])/(tmp|work|home|root|usr|Users)/|site-packages|[A-Z]:\\", text)
    here = any(folder in text for folder in HERE)
    return those(
        ("a path or a traceback", path or here or "Traceback" in text),
        ("an address", re.search(r" at 0x[0-9a-f]{6}", text)),
        (f"{len(text):,} characters", len(text) > LONGEST_TEXT),
    )


def those(*rows):
    """The flaws of the rows (flaw, whether it is there) that are there."""
    return [flaw for flaw, is_there in rows if is_there]


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
