"""`python -m tutorials.tools.notebooks [NAME ...]` makes tutorials/notebooks/*.ipynb.

A notebook (format 4.5) holds the cells of a tutorial and, below each of them, what it printed and
drew when the file ran once, in order, in a process of its own. NAME is a tutorial of the checkout
or its number; without a name all are made.

The metadata hold the SHA-256 of the tutorial, by which a test finds notebooks that are stale. The
hash does not cover the package: where a change of its code moves what tutorials print, make the
notebooks again.
"""

import base64
import hashlib
import io
import json
import re
import sys
import tempfile
import types
from contextlib import redirect_stdout
from pathlib import Path
from typing import NamedTuple

from p4dgs_ref.output import writable_folder
from tutorials.tools.shared import FOLDER, in_few_bytes, run, write_text

DPI = 72  # of the figures: most are 600 to 950 pixels wide
PROSE, CODE = "# %% [markdown]", "# %%"
NAME = re.compile(r"(?<!\[)`(\d\d_\w+)`")  # of a tutorial in the prose, unless it is linked already
ONLY_DRAWS = re.compile(r"(?!.*(\bassert\b|\bprint\()).*figures\.show\(", re.S)  # a cell
# Jupyter reads the first mark; converters to HTML and books read the second one.
COLLAPSED = {"jupyter": {"source_hidden": True}, "tags": ["hide-input"]}
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)[^)\s]+")  # a target without https: and the like
START = "import sys; from tutorials.tools.notebooks import record; record(*sys.argv[1:])"
INSTALL = (
    "To run it, install the package: `pip install .` in the folder above `tutorials/`. "
    "`00_whole_paper` needs NumPy, SciPy and matplotlib alone."
)
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {
        "file_extension": ".py",
        "mimetype": "text/x-python",
        "name": "python",
        "pygments_lexer": "ipython3",
    },
}


# --- reading a tutorial ---------------------------------------------------------------------------
class Cell(NamedTuple):
    """One cell: the number of its first line in the file, and its lines without that first one."""

    line: int
    prose: bool
    lines: list

    @property
    def text(self):
        """The code, or the prose without the comment signs."""
        text = "\n".join(self.lines).strip("\n")
        return re.sub(r"^# ?", "", text, flags=re.M) if self.prose else text


def cells(text):
    """Return the cells of a percent file."""
    parts = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith(CODE):
            parts.append(Cell(number, line.strip() == PROSE, []))
        elif parts:
            parts[-1].lines.append(line)
    return parts


def tutorials(folder):
    """Return the tutorials of a folder in their order."""
    return sorted(folder.glob("[0-9][0-9]_*.py"))


# --- the notebook without its outputs -------------------------------------------------------------
def unrun(source):
    """Return the notebook of a tutorial with empty outputs, as a dictionary."""
    number, count = source.stem[:2], 0
    parts = [notebook_cell(f"{number}-links", "markdown", links(source))]
    for cell in cells(source.read_text(encoding="utf-8")):
        id = f"{number}-{len(parts):02d}"
        if cell.prose:
            text = NAME.sub(r"[`\1`](\1.py)", cell.text)
            parts.append(notebook_cell(id, "markdown", LINK.sub(moved, text)))
        else:
            count += 1
            parts.append(
                notebook_cell(
                    id,
                    "code",
                    cell.text,
                    metadata=COLLAPSED if ONLY_DRAWS.match(cell.text) else {},
                    execution_count=count,
                    outputs=[],
                )
            )
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    return {
        "cells": parts,
        "metadata": {**METADATA, "p4dgs_ref": {"source_sha256": digest}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def notebook_cell(id, kind, text, **more):
    """Return a cell of a notebook."""
    lines = text.splitlines(keepends=True)
    return {"cell_type": kind, "id": id, "metadata": {}, "source": lines, **more}


def links(source):
    """Return the text of the first cell, which links what belongs to the tutorial."""
    names = [file.stem for file in tutorials(source.parent)]
    i = names.index(source.stem)
    parts = [f"Made from [{source.name}](../{source.name})"]
    if (source.parent / "solutions" / source.name).is_file():
        parts.append(f"[solutions](../solutions/{source.name})")
    parts += [f"previous: [{name}]({name}.ipynb)" for name in names[max(i - 1, 0) : i]]
    parts += [f"next: [{name}]({name}.ipynb)" for name in names[i + 1 : i + 2]]
    return " · ".join([*parts, "[all tutorials](../README.md)"]) + f"\n\n{INSTALL}"


def moved(link):
    """Return a link of a tutorial as seen from the folder of the notebooks."""
    tutorial = re.fullmatch(r"(\d\d_\w+)\.py", link[0])
    return f"{tutorial[1]}.ipynb" if tutorial else f"../{link[0]}"


# --- running a tutorial ---------------------------------------------------------------------------
def make(source):
    """Run a tutorial in a process of its own and write its notebook, whose path is returned."""
    notebook = unrun(source)
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    with (
        writable_folder(source.parent / "notebooks") as folder,
        tempfile.TemporaryDirectory() as beside,
    ):
        out, result = Path(beside) / "out", Path(beside) / "outputs.json"
        out.mkdir()
        run(source.name, ["-c", START, source.resolve(), result], out)
        for cell, outputs in zip(code, json.loads(result.read_text(encoding="utf-8")), strict=True):
            cell["outputs"] = outputs
        target = folder / f"{source.stem}.ipynb"
        write_text(
            target, json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
        )
    return target


class Printed(io.TextIOBase):
    """What a cell prints, as outputs of the cell, between its figures."""

    def __init__(self, outputs):
        self.outputs = outputs

    def write(self, text):
        if not self.outputs or self.outputs[-1]["output_type"] != "stream":
            self.outputs.append({"output_type": "stream", "name": "stdout", "text": ""})
        self.outputs[-1]["text"] += text
        return len(text)


def record(source, result):
    """Run the cells of a tutorial in this process; write their outputs to the file `result`.

    The cells find what they would find in a notebook: the arguments of its kernel, an interactive
    prompt, no `__file__`, and figures that appear at `plt.show` or at the end of the cell.
    """
    import matplotlib.pyplot as plt

    source, outputs, every = Path(source), [], []
    sys.argv, sys.ps1 = ["kernel", "-f", "kernel.json"], ">>> "
    sys.modules["__main__"] = main = types.ModuleType("__main__")
    plt.show = lambda *args, **settings: outputs.extend(figures(plt))
    code = [cell for cell in cells(source.read_text(encoding="utf-8")) if not cell.prose]
    for cell in code:
        with redirect_stdout(Printed(outputs)):
            # With empty lines before the cell, errors and warnings give the line in the file.
            text = "\n" * cell.line + "\n".join(cell.lines)
            exec(compile(text, source.name, "exec"), vars(main))
        plt.show()
        every.append(outputs.copy())
        outputs.clear()
    Path(result).write_text(json.dumps(every), encoding="utf-8")


def figures(plt):
    """Close the open figures of pyplot; return them as outputs of a cell."""
    shown = []
    for number in plt.get_fignums():
        figure, file = plt.figure(number), io.BytesIO()
        figure.savefig(file, format="png", dpi=DPI, bbox_inches="tight")
        plt.close(figure)
        png = in_few_bytes(file.getvalue())
        shown.append(
            {
                "output_type": "display_data",
                "data": {"image/png": base64.b64encode(png).decode(), "text/plain": str(figure)},
                "metadata": {},
            }
        )
    return shown


# --- the command ----------------------------------------------------------------------------------
def main(names, folder=FOLDER):
    """Make the notebooks of the tutorials with these names or numbers, or of all."""
    known = {
        word: source for source in tutorials(folder) for word in (source.stem, source.stem[:2])
    }
    for name in names:
        if name not in known:
            sys.exit(f"{name}: expected the name or the number of a tutorial")
    for source in dict.fromkeys(known[name] for name in names or known):
        print(make(source).name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
