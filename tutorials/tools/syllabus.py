"""The index of the tutorials: tables, the two paths, the glossary, the handout, the gallery.

python -m tutorials.tools.syllabus            draw all pictures and write the index
python -m tutorials.tools.syllabus 06 demo    only those of these tutorials and of the demo
python -m tutorials.tools.syllabus tour       only the ten pictures of the tour
python -m tutorials.tools.syllabus front      only the three that commands draw on the first page
python -m tutorials.tools.syllabus index      only the index

Each of these also draws the architecture and writes the glossary and the handout.
"""

import re
import sys
import tempfile
from collections import namedtuple
from functools import cache
from pathlib import Path

from p4dgs_ref import EQUATIONS
from p4dgs_ref.lessons import TUTORIALS, tutorial_of
from tutorials.tools import gallery, glossary, handout, shared, tour
from tutorials.tools.shared import FOLDER, write_text

PATHS = {  # through the ideas of the method, by what a reader knows
    "you know 3DGS": ("01", "02", "03", "05", "07", "08", "09", "10", "11", "12"),
    "you do not": ("01", "02", "03", "05", "07", "08", "10", "13", "14", "15"),
}


# --- the facts that a tutorial states about itself ------------------------------------------------
# What is read from a tutorial's file: its title, the numbers of the tutorials that a reader should
# know, the minutes for reading and for the exercises, and the exercises.
Facts = namedtuple("Facts", "title after reading doing exercises")


@cache
def facts(tutorial):
    """The Facts of a tutorial. Raises ValueError naming the file if its first cell lacks one."""
    source = (FOLDER / f"{tutorial.name}.py").read_text(encoding="utf-8")
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
    minutes = int(head[2]), int(head[3])
    return Facts(title[1], prerequisites(head[1]), *minutes, exercises(source))


def prerequisites(text):
    """The numbers of the tutorials that a text names.

    "`01_offsets` to `15_compositing`" also names all tutorials between the two.
    """
    named = []
    for first, last in re.findall(r"`(\d\d)\w*`(?: to `(\d\d)\w*`)?", text):
        named += [t.name[:2] for t in TUTORIALS if first <= t.name[:2] <= (last or first)]
    return tuple(dict.fromkeys(named))


def exercises(source):
    """The numbers of the exercises in the source of a tutorial or of its solutions, "01.2"."""
    return sorted(set(re.findall(r'lessons\.check_\w+\(\s*"(\d\d\.\d)"', source)))


# --- tables ---------------------------------------------------------------------------------------
def equations_table():
    """A Markdown table with one row for each equation."""
    rows = [
        (
            equation.number,
            f"`{key}`",
            f"[`{shared.file_of(equation)}`](../{shared.file_of(equation)})",
            f"[`{key}.safetensors`](../p4dgs_ref/oracle/v1/{key}.safetensors)",
            f"[{tutorial_of(key).name}](notebooks/{tutorial_of(key).name}.ipynb)",
        )
        for key, equation in EQUATIONS.items()
    ]
    return shared.markdown_table(("no.", "key", "file", "vectors", "tutorial"), rows)


def path_table():
    """A Markdown table of both paths with the minutes of their tutorials, and the sums below."""
    rows = [
        (
            both_forms(t.name),
            facts(t).title,
            *(f"{facts(t).reading}" if t.name[:2] in path else "" for path in PATHS.values()),
        )
        for t in TUTORIALS
        if any(t.name[:2] in path for path in PATHS.values())
    ]
    head = ("tutorial", "what it is about", *(f"minutes, if {knows}" for knows in PATHS))
    sums = [sum(facts(t).reading for t in TUTORIALS if t.name[:2] in p) for p in PATHS.values()]
    return shared.markdown_table(head, [*rows, ("together", "", *map(str, sums))])


def both_forms(name):
    """Links to the notebook of a tutorial and to its source."""
    return f"[{name}](notebooks/{name}.ipynb) ([source]({name}.py))"


def order_table():
    """A Markdown table of the tutorials in order."""
    rows = []
    for tutorial in TUTORIALS:
        title, after, reading, doing, asked = facts(tutorial)
        times = f"{reading} + {doing}"
        rows.append((both_forms(tutorial.name), title, ", ".join(after), str(len(asked)), times))
    head = ("tutorial", "what it is about", "after", "exercises", "minutes")
    return shared.markdown_table(head, rows)


def index():
    """The text of README.md with new tables.

    Only the text between a mark such as <!-- order --> and the next <!-- end --> is replaced.
    """
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    sections = {
        "paths": path_table(),
        "order": order_table(),
        "equations": equations_table(),
    }
    for name, made in sections.items():
        before, mark, after = text.partition(f"<!-- {name} -->\n")
        text = f"{before}{mark}{made}\n<!-- end -->{after.split('<!-- end -->', 1)[1]}"
    return text


# --- the command ----------------------------------------------------------------------------------
def draw_whole_paper(out):
    """Run 00 without a file of its own, so that it writes into `out` below the current folder."""
    source = (FOLDER / "00_whole_paper.py").read_text(encoding="utf-8")
    shared.run("00_whole_paper.py", ["-c", source], out)


def draw_tutorial(name):
    """A function that runs a tutorial, which writes its figures into the folder `out`."""
    return lambda out: shared.run(f"{name}.py", [FOLDER / f"{name}.py"], out)


MAKERS = {  # {word: what draws pictures into a folder}; `tour` has a folder of its own
    "00": draw_whole_paper,
    **{tutorial.name[:2]: draw_tutorial(tutorial.name) for tutorial in TUTORIALS},
    "demo": gallery.draw_demo,
    "front": gallery.draw_front,
    "tour": lambda _: tour.draw_pictures(),
}


def main(words):
    """Draw what the words name, or everything, and write the index."""
    unknown = sorted(set(words) - {*MAKERS, "index"})
    if unknown:
        sys.exit(f"{' '.join(unknown)}: expected index or some of {', '.join(MAKERS)}")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for word, make in MAKERS.items():
            if not words or word in words:
                print(word, flush=True)
                make(out)
        gallery.draw_architecture(out)
        gallery.take(out)
    handout.save(FOLDER / "handout.pdf")
    write_text(FOLDER / "glossary.md", glossary.glossary())
    write_text(FOLDER / "README.md", index())


if __name__ == "__main__":
    main(sys.argv[1:])
