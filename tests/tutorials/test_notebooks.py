"""The committed notebooks are fresh and whole; the maker works on small files."""

import json
import re
import tempfile
from pathlib import Path

import pytest

from tutorials.tools import notebooks
from tutorials.tools.shared import FOLDER

FILES = sorted((FOLDER / "notebooks").glob("*.ipynb"))
# Folders of this machine, which no output may name, and addresses.
PRIVATE = re.compile(
    "|".join(map(re.escape, map(str, (tempfile.gettempdir(), Path.home(), FOLDER.parent))))
    + r"|site-packages|Traceback| at 0x[0-9a-f]{6}"
)


def load(file):
    return json.loads(file.read_text(encoding="utf-8"))


def without_outputs(notebook):
    """The notebook as the maker has it before it runs the cells."""
    cells = [
        {**cell, "outputs": []} if cell["cell_type"] == "code" else cell
        for cell in notebook["cells"]
    ]
    return {**notebook, "cells": cells}


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


def test_every_tutorial_has_a_notebook_that_is_up_to_date():
    assert problems(FOLDER) == [], "run `python -m tutorials.tools.notebooks NAME`"


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_notebook_shows_text_and_figures(file):
    outputs = [o for cell in load(file)["cells"] for o in cell.get("outputs", ())]
    assert any("image/png" in o.get("data", ()) for o in outputs)
    printed = "".join(o["text"] for o in outputs if o.get("name") == "stdout")
    assert printed and ": \n" not in printed  # something follows "fails: "
    assert not PRIVATE.search(printed)


# --- the maker ------------------------------------------------------------------------------------
SMALL = r"""# %% [markdown]
# # A title, $x^2$
# [next](02_next.py), [web](https://example.org/a.py), [code](../p4dgs_ref/model.py), `02_next`.

# %%
import sys

print(__name__, len(sys.argv) > 1, "__file__" in globals())

# %%
import matplotlib.pyplot as plt

from tutorials.tools import figures

figure, axes = figures.pyplot().subplots(figsize=(4, 3))
axes.plot([1, 2])
figures.show(figure, "01_small")
print("between")
plt.figure(figsize=(2, 2))
plt.plot([2, 1])
"""


@pytest.fixture
def small(tmp_path):
    folder = tmp_path / "tutorials"
    (folder / "notebooks").mkdir(parents=True)
    (folder / "01_small.py").write_text(SMALL, encoding="utf-8")
    (folder / "02_next.py").write_text('# %%\n"last"\n', encoding="utf-8")
    return folder / "01_small.py"


@pytest.mark.slow
def test_notebook_of_a_small_tutorial_is_the_same_in_every_run(small):
    head, title, first, second = load(notebooks.make(small))["cells"]
    assert "next: [02_next](02_next.ipynb) · [all" in head["source"][0]
    assert title["source"][1] == (
        "[next](02_next.ipynb), [web](https://example.org/a.py), "
        "[code](../../p4dgs_ref/model.py), [`02_next`](02_next.ipynb)."
    )
    assert [output["text"] for output in first["outputs"]] == ["__main__ True False\n"]
    kinds = [output.get("text") or set(output["data"]) for output in second["outputs"]]
    assert kinds == [{"image/png", "text/plain"}, "between\n", {"image/png", "text/plain"}]
    before = (small.parent / "notebooks" / "01_small.ipynb").read_bytes()
    assert notebooks.make(small).read_bytes() == before


def test_missing_stale_and_orphaned_notebooks_are_found(small):
    folder = small.parent
    assert problems(folder) == ["01_small: missing", "02_next: missing"]
    for source in notebooks.tutorials(folder):
        file = folder / "notebooks" / f"{source.stem}.ipynb"
        file.write_text(json.dumps(notebooks.unrun(source)), encoding="utf-8")
    assert problems(folder) == []
    small.write_text(SMALL + "\n", encoding="utf-8")  # the cells are the same, the hash is not
    assert problems(folder) == ["01_small: stale"]
    (folder / "notebooks" / "03_gone.ipynb").write_text("{}", encoding="utf-8")
    assert problems(folder) == ["03_gone: no such tutorial", "01_small: stale"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "code, message",
    [
        ("x = 1\n\n\ndef f():\n    return x / 0\n\n\nf()", "ZeroDivisionError: division by zero"),
        ("raise SystemExit(3)", "exit code 3"),
    ],
)
def test_error_names_the_tutorial_and_keeps_the_notebook(code, message, small):
    target = small.parent / "notebooks" / "01_small.ipynb"
    target.write_text("as before", encoding="utf-8")
    small.write_text(f"# %%\n1\n# %%\n{code}\n", encoding="utf-8")
    with pytest.raises(SystemExit, match=f"^01_small.py, .*{message}") as stopped:
        notebooks.main(["01"], small.parent)
    assert "\n" not in str(stopped.value) and target.read_text(encoding="utf-8") == "as before"
