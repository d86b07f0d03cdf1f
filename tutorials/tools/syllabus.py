"""The index of the tutorials: tutorials/README.md with its tables, its graph and its pictures.

python -m tutorials.tools.syllabus               run all tutorials, draw all, write the index
python -m tutorials.tools.syllabus 00 06 demo    only these tutorials and the pictures of the demo
python -m tutorials.tools.syllabus accuracy      the pictures of accuracy and the reference's table
python -m tutorials.tools.syllabus tour          only the ten pictures of the tour
python -m tutorials.tools.syllabus curve         only the picture of the curve, from its record
python -m tutorials.tools.syllabus effects       only the picture of effects, from its record
python -m tutorials.tools.syllabus index         only the index, with the times it already holds

Each of these also draws the architecture anew and writes the glossary and the handout.
"""

import re
import sys
import tempfile
import time
from collections import namedtuple
from functools import cache
from pathlib import Path

from p4dgs_ref.lessons import TUTORIALS, tutorial_of
from p4dgs_ref.oracle.published import subjects
from p4dgs_ref.splatting.table import EQUATIONS
from tutorials.tools import architecture, gallery, glossary, handout, shared
from tutorials.tools.notebooks import cells
from tutorials.tools.shared import FOLDER, write_text

CAPTION = "The architecture of P-4DGS; numbers are those of the paper's equations"
PATHS = {  # through the ideas of the method, by what a reader knows
    "you know 3DGS": ("01", "02", "03", "05", "07", "08", "09", "10", "11"),
    "you do not": ("01", "02", "03", "05", "07", "08", "10", "13", "14", "15"),
}
WORDS, LINES = 120, 12  # of prose and of code that are read in a minute: formulas take time
EACH = 4  # minutes to think about an exercise or a question
WRITTEN = 3  # lines of a solution that are written in a minute


# --- the facts that a tutorial states about itself ------------------------------------------------
# What is read from a tutorial's file: its title, the numbers of the tutorials that a reader should
# know, the minutes for reading and for the exercises, and the exercises with the keys of the
# equations that they are about, {"01.2": keys}.
Facts = namedtuple("Facts", "title after reading doing exercises")


@cache
def facts(tutorial, folder=FOLDER):
    """The Facts of a tutorial. Raises ValueError naming the file if its first cell lacks one."""
    source = (Path(folder) / f"{tutorial.name}.py").read_text(encoding="utf-8")
    title = re.match(r"# %% \[markdown\]\n# # (.*)\n", source)
    first_cell = " ".join(
        line.lstrip("# ").strip() for line in source.split("\n# %%", 1)[0].splitlines()[2:]
    )
    head = re.search(
        r"\*\*Before it:\*\*(.*?)\*\*Takes\*\*.*? two cores, "
        r"(\d+) minutes of reading and (\d+) of exercises\.",
        first_cell,
    )
    if not title or not head:
        raise ValueError(
            f"{tutorial.name}.py: expected a title, then "
            "**Before it:** ... **Takes** ... on two cores, "
            "... minutes of reading and ... of exercises."
        )
    asked = exercises(source, tutorial.keys)
    return Facts(title[1], prerequisites(head[1]), int(head[2]), int(head[3]), asked)


def minutes(name, folder=FOLDER):
    """The minutes that it takes to read a tutorial and to do its exercises, measured in its files.

    Reading ends at the exercises. Both are rounded to five minutes.
    """
    text = (Path(folder) / f"{name}.py").read_text(encoding="utf-8")
    taught, _, asked = text.partition("# ## Exercises")
    solution = Path(folder) / "solutions" / f"{name}.py"
    doing = time_to_read(f"# %% [markdown]\n#{asked}")
    doing += EACH * len(re.findall(r"\*\*(\d\d\.\d|Predict, then run\.)\*\*", asked))
    if solution.is_file():
        doing += len(code_lines(solution.read_text(encoding="utf-8"))) / WRITTEN
    return tuple(5 * max(1, round(time / 5)) for time in (time_to_read(taught), doing))


def time_to_read(source):
    """Minutes to read the prose and the code of some cells."""
    words = [word for cell in cells(source) if cell.prose for word in cell.text.split()]
    return len(words) / WORDS + len(code_lines(source)) / LINES


def code_lines(source):
    """The lines of the cells of code, without imports and without blank ones."""
    lines = [line for cell in cells(source) if not cell.prose for line in cell.lines]
    return [line for line in lines if line.strip() and not line.startswith(("from ", "import "))]


def prerequisites(text):
    """The numbers of the tutorials that a text names.

    "`01_offsets` to `15_compositing`" also names all tutorials between the two.
    """
    named = []
    for first, last in re.findall(r"`(\d\d)\w*`(?: to `(\d\d)\w*`)?", text):
        named += [t.name[:2] for t in TUTORIALS if first <= t.name[:2] <= (last or first)]
    return tuple(dict.fromkeys(named))


def exercises(source, keys):
    """{exercise: keys of its equations} in the source of a tutorial or of its solutions.

    An exercise whose check names none of the tutorial's equations is about all of them.
    """
    calls = re.findall(r'lessons\.(\w+)\(\s*"(\d\d\.\d)",([^\n]*(?:\n    [^\n]*)*)', source)
    keys_of = {}
    for check, exercise, arguments in calls:
        words = set(re.findall(r"\w+", arguments))
        if check != "check_number":
            words = {subjects()[word]["equation"] for word in words & set(subjects())}
        keys_of[exercise] = tuple(key for key in keys if key in words) or keys
    return dict(sorted(keys_of.items()))


# --- tables ---------------------------------------------------------------------------------------
def equations_table(folder=FOLDER):
    """A Markdown table with one row for each equation."""
    asked = [item for t in TUTORIALS for item in facts(t, folder).exercises.items()]
    files = {key: equation.module.__name__.replace(".", "/") + ".py" for key, equation in EQUATIONS.items()}
    rows = [
        (
            EQUATIONS[key].number,
            f"`{key}`",
            f"[`{file}`](../{file})",
            f"[`{key}.safetensors`](../p4dgs_ref/oracle/v1/{key}.safetensors)",
            f"[{tutorial_of(key).name}](notebooks/{tutorial_of(key).name}.ipynb)",
            ", ".join(exercise for exercise, keys in asked if key in keys),
        )
        for key, file in files.items()
    ]
    return shared.markdown_table(("no.", "key", "file", "vectors", "tutorial", "exercises"), rows)


def path_table(folder=FOLDER):
    """A Markdown table of both paths with the minutes of their tutorials, and the sums below."""
    reading = {t.name[:2]: facts(t, folder).reading for t in TUTORIALS}
    rows = [
        (
            both_forms(t.name),
            facts(t, folder).title,
            *(f"{reading[t.name[:2]]}" if t.name[:2] in path else "" for path in PATHS.values()),
        )
        for t in TUTORIALS
        if any(t.name[:2] in path for path in PATHS.values())
    ]
    sums = [f"{sum(reading[number] for number in path)}" for path in PATHS.values()]
    head = ("tutorial", "what it is about", *(f"minutes, if {knows}" for knows in PATHS))
    return shared.markdown_table(head, [*rows, ("together", "", *sums)])


def both_forms(name):
    """Links to the notebook of a tutorial and to its source."""
    return f"[{name}](notebooks/{name}.ipynb) ([source]({name}.py))"


def order_table(seconds, folder=FOLDER):
    """A Markdown table of the tutorials in order; `seconds` is {number: measured}."""
    rows = []
    for tutorial in TUTORIALS:
        title, after, reading, doing, asked = facts(tutorial, folder)
        rows.append(
            (
                both_forms(tutorial.name),
                title,
                ", ".join(after),
                str(len(asked)),
                f"{seconds[tutorial.name[:2]]:.1f}" if tutorial.name[:2] in seconds else "",
                f"{reading} + {doing}",
            )
        )
    return shared.markdown_table(
        ("tutorial", "what it is about", "after", "exercises", "seconds", "minutes"), rows
    )


def measured_before(folder=FOLDER):
    """{number: seconds} as README.md states them."""
    rows = re.findall(
        r"^\| \[(\d\d)_.*\| (\d+\.\d) \| [^|]* \|$",
        (Path(folder) / "README.md").read_text(encoding="utf-8"),
        re.M,
    )
    return {number: float(seconds) for number, seconds in rows}


def index(seconds, folder=FOLDER):
    """The text of README.md with new tables.

    Only the text between a mark such as <!-- order --> and the next <!-- end --> is replaced.
    """
    text = (Path(folder) / "README.md").read_text(encoding="utf-8")
    sections = {
        "architecture": f"![{CAPTION}](pictures/{gallery.DRAWING})",
        "paths": path_table(folder),
        "order": order_table(seconds, folder),
        "equations": equations_table(folder),
        "gallery": gallery.gallery(),
    }
    for name, made in sections.items():
        before, mark, after = text.partition(f"<!-- {name} -->\n")
        text = f"{before}{mark}{made}\n<!-- end -->{after.split('<!-- end -->', 1)[1]}"
    return text


# --- measuring ------------------------------------------------------------------------------------
def run(name, out):
    """Run a tutorial, figures in `out`; return its seconds."""
    start = time.perf_counter()
    shared.run(f"{name}.py", [FOLDER / f"{name}.py"], out)
    return time.perf_counter() - start


MADE = {  # what draws pictures and is no numbered tutorial with a solution
    # Without a file of its own it writes into `out` below the current folder, as in a notebook.
    "00": lambda out: shared.run(
        "00", ["-c", (FOLDER / "00_whole_paper.py").read_text(encoding="utf-8")], out
    ),
    "beyond": lambda out: run("beyond_networks", out) + run("growing_detail", out),
    "demo": gallery.draw_demo,
    "accuracy": gallery.draw_accuracy,
    "tour": gallery.draw_tour,
    "curve": gallery.draw_curve,
    "effects": gallery.draw_effects,
}


def main(words):
    """Run what the words name, or everything, renew its pictures, and write the index."""
    names = {tutorial.name[:2]: tutorial.name for tutorial in TUTORIALS}
    unknown = sorted(set(words) - {*names, *MADE, "index"})
    if unknown:
        sys.exit(f"{' '.join(unknown)}: expected numbers of tutorials, index, {', '.join(MADE)}")
    seconds = measured_before()
    with tempfile.TemporaryDirectory() as out:
        for number in [number for number in names if not words or number in words]:
            seconds[number] = run(names[number], out)
            print(f"{names[number]}: {seconds[number]:.1f} s", flush=True)
        for make in [make for word, make in MADE.items() if not words or word in words]:
            make(out)
        architecture.save(Path(out) / gallery.DRAWING)
        gallery.record(gallery.take(out, FOLDER / "pictures"))
    handout.save(FOLDER / gallery.HANDOUT)
    gallery.record([gallery.HANDOUT])
    write_text(FOLDER / "glossary.md", glossary.glossary())
    write_text(FOLDER / "README.md", index(seconds))


if __name__ == "__main__":
    main(sys.argv[1:])
