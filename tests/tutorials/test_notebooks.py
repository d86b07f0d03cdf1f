"""The committed notebooks are whole and belong to the tutorials; the maker works on small files."""

import json
import re
import shutil

import pytest

from tests.tutorials import notebook_form as form
from tutorials.tools import notebooks
from tutorials.tools.shared import FOLDER

SOURCES = notebooks.tutorials(FOLDER)
FILES = sorted((FOLDER / "notebooks").glob("*.ipynb"))
EACH = pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
LARGEST = 10_000_000  # bytes of all notebooks together


# --- the committed notebooks ----------------------------------------------------------------------
def test_every_tutorial_has_a_notebook_that_is_up_to_date():
    assert form.problems(FOLDER) == [], "run `python -m tutorials.tools.notebooks NAME`"


def test_notebooks_are_small_and_alone():
    files = [file for file in (FOLDER / "notebooks").rglob("*") if "out" not in file.parts]
    assert [f for f in sorted(files) if ".ipynb_checkpoints" not in f.parts] == FILES
    assert 0 < sum(file.stat().st_size for file in FILES) <= LARGEST


@EACH
def test_notebook_shows_text_and_figures_and_links_somewhere(file):
    notebook = form.load(file)
    assert form.flaws(notebook) == []
    outputs = [o for cell in notebook["cells"] for o in cell.get("outputs", ())]
    assert any("image/png" in o.get("data", ()) for o in outputs)
    printed = "".join(o["text"] for o in outputs if o.get("name") == "stdout")
    assert printed and ": \n" not in printed  # something follows "fails: "
    links = form.links(notebook)
    assert len(links) >= 3
    assert [link for link in links if not (file.parent / link).exists()] == []


def test_the_package_is_asked_for_where_it_is_imported():
    asks, imports = (
        {file.stem for file in files if words in file.read_text(encoding="utf-8")}
        for files, words in ((FILES, "install the package"), (SOURCES, "from p4dgs_ref import"))
    )
    assert asks == imports == {source.stem for source in SOURCES} - {"00_whole_paper"}


@pytest.mark.parametrize("source", SOURCES, ids=[source.stem for source in SOURCES])
def test_prose_can_be_shown_by_viewers_of_notebooks(source):
    cells = notebooks.cells(source.read_text(encoding="utf-8"))
    flaws = {cell.line: form.prose_flaws(cell.text) for cell in cells if cell.prose}
    assert not any(flaws.values()), flaws


# --- the maker ------------------------------------------------------------------------------------
SMALL = r"""# %% [markdown]
# # A title, $x^2$
# [next](02_next.py), [here](#a), [web](https://example.org/a.py), [code](../p4dgs_ref/table.py)
# Then `02_next` and [`02_next`](02_next.py).

# %%
import sys

print("printed")
print(__name__, len(sys.argv) > 1, "__file__" in globals())

# %%
import matplotlib.pyplot as plt

from p4dgs_ref import lessons

figure, axes = lessons.pyplot().subplots(figsize=(4, 3))
axes.plot([1, 2])
lessons.show(figure, "01_small")
print("between")
plt.figure(figsize=(2, 2))
plt.plot([2, 1])
plt.show()
print("after")

# %%
plt.figure(figsize=(3, 3))
None
"""


def write_small(folder):
    """Write two tutorials into a folder; return the first."""
    (folder / "solutions").mkdir(parents=True)
    (folder / "01_small.py").write_text(SMALL, encoding="utf-8")
    (folder / "solutions" / "01_small.py").write_text("", encoding="utf-8")
    (folder / "02_next.py").write_text('# %%\n"last"\n', encoding="utf-8")
    return folder / "01_small.py"


@pytest.fixture
def small(tmp_path):
    return write_small(tmp_path / "tutorials")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return notebooks.make(write_small(tmp_path_factory.mktemp("made") / "tutorials"))


@pytest.mark.slow
def test_outputs_of_a_small_tutorial(made):
    notebook = form.load(made)
    assert form.flaws(notebook) == []
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert [cell["id"] for cell in notebook["cells"]] == ["01-links", *(f"01-0{i}" for i in "1234")]
    head, title, first, second, third = notebook["cells"]
    assert "next: [02_next](02_next.ipynb) · [all" in head["source"][0]
    assert title["source"] == [
        "# A title, $x^2$\n",
        "[next](02_next.ipynb), [here](#a), [web](https://example.org/a.py), "
        "[code](../../p4dgs_ref/table.py)\n",
        "Then [`02_next`](02_next.ipynb) and [`02_next`](02_next.ipynb).",
    ]
    (printed,) = first["outputs"]
    assert (printed["name"], printed["text"]) == ("stdout", "printed\n__main__ True False\n")
    kinds = [output.get("text") or set(output["data"]) for output in second["outputs"]]
    picture = {"image/png", "text/plain"}
    assert kinds == [picture, "between\n", picture, "after\n"]
    assert [output["output_type"] for output in third["outputs"]] == ["display_data"]
    assert [c["execution_count"] for c in (first, second, third)] == [1, 2, 3]
    assert [file.name for file in made.parent.iterdir()] == ["01_small.ipynb"]


@pytest.mark.slow
def test_notebook_is_the_same_in_every_run(made, small):
    assert notebooks.make(small).read_bytes() == made.read_bytes()


def test_missing_stale_and_orphaned_notebooks_are_found(small):
    folder = small.parent
    assert form.problems(folder) == ["01_small: missing", "02_next: missing"]
    (folder / "notebooks").mkdir()
    for source in notebooks.tutorials(folder):
        file = folder / "notebooks" / f"{source.stem}.ipynb"
        file.write_text(json.dumps(notebooks.unrun(source)), encoding="utf-8")
    assert form.problems(folder) == []
    small.write_text(SMALL + "\n", encoding="utf-8")  # the cells are the same, the hash is not
    assert form.problems(folder) == ["01_small: stale"]
    small.write_text(SMALL, encoding="utf-8")
    (folder / "notebooks" / "03_gone.ipynb").write_text("{}", encoding="utf-8")
    assert form.problems(folder) == ["03_gone: no such tutorial"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "code, message",
    [
        ("x = 1\n\n\ndef f():\n    return x / 0\n\n\nf()", "ZeroDivisionError: division by zero"),
        ("x = 1\nx = = 2", "SyntaxError: invalid syntax"),
        ("raise SystemExit(3)", "exit code 3"),
        ("import os\n\nos._exit(7)", "exit code 7"),
    ],
)
def test_error_names_the_tutorial(code, message, small):
    folder = small.parent / "notebooks"
    folder.mkdir()
    (folder / "01_small.ipynb").write_text("as before", encoding="utf-8")
    small.write_text(f"# %%\n1\n# %%\n{code}\n", encoding="utf-8")
    with pytest.raises(SystemExit) as stopped:
        notebooks.main(["01"], small.parent)
    error = str(stopped.value)
    assert error.startswith("01_small.py, ") and message in error and "\n" not in error
    assert [file.read_text(encoding="utf-8") for file in folder.iterdir()] == ["as before"]


@pytest.mark.slow
def test_command_makes_what_is_named(small, capsys):
    notebooks.main(["02"], small.parent)
    assert re.fullmatch(r"02_next: [\d,]+ bytes\n", capsys.readouterr().out)
    assert [file.name for file in (small.parent / "notebooks").iterdir()] == ["02_next.ipynb"]


@pytest.mark.slow
def test_a_committed_notebook_is_what_the_maker_makes(tmp_path):
    for source in SOURCES:
        shutil.copy(source, tmp_path)
    shutil.copytree(FOLDER / "solutions", tmp_path / "solutions")
    name = "06_deformed"
    ours = form.load(FOLDER / "notebooks" / f"{name}.ipynb")
    made = form.load(notebooks.make(tmp_path / f"{name}.py"))
    assert form.without_outputs(made) == form.without_outputs(ours)
    one, other = (
        [output.get("text") for cell in notebook["cells"] for output in cell.get("outputs", ())]
        for notebook in (ours, made)
    )
    assert one == other
