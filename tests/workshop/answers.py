"""The answers to short exercises: p4dgs_ref/answers.json, made from the solutions.

python -m tests.workshop.answers

A solution gives its answer and what a second way to it computes; the second one is stored. The
tutorials then compare without showing an answer below its blank.
"""

import ast
import contextlib
import io
import json
import runpy
from pathlib import Path
from unittest import mock

import numpy as np

from p4dgs_ref import lessons
from p4dgs_ref.lessons import TUTORIALS
from tutorials.tools.syllabus import FOLDER, write_text

FROM_DATA = {  # compared with arrays of the golden data or of a file, or with counts in the text
    "10.2",
    "20.3",
    "21.2",
    "21.3",
    "22.2",
    "22.3",
}
FILE = Path(lessons.__file__).with_name("answers.json")


def asked(source):
    """The exercises that a tutorial compares with a stored answer."""
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    return {
        call.args[0].value
        for call in calls
        if ast.unparse(call.func) == "lessons.check_number" and len(call.args) == 2
    }


def answers():
    """{exercise: answer} of all exercises that ask for a stored answer."""
    made = {}
    for tutorial in TUTORIALS:
        wanted = asked((FOLDER / f"{tutorial.name}.py").read_text(encoding="utf-8"))
        if wanted:
            of_solution = computed(FOLDER / "solutions" / f"{tutorial.name}.py")
            made |= {exercise: of_solution[exercise] for exercise in sorted(wanted)}
    return made


def computed(solution):
    """{exercise: what its solution compares the answer with}."""
    wanted = {}

    def store(exercise, mine, want, digits=6):
        wanted[exercise] = np.asarray(want).tolist()

    without_checks = mock.patch.multiple(
        lessons, check_number=store, check_forward=mock.DEFAULT, check_backward=mock.DEFAULT
    )
    with without_checks, contextlib.redirect_stdout(io.StringIO()):
        runpy.run_path(str(solution))
    return wanted


def text(made):
    rows = [f"  {json.dumps(exercise)}: {json.dumps(answer)}" for exercise, answer in made.items()]
    return "{\n" + ",\n".join(rows) + "\n}\n"


if __name__ == "__main__":
    write_text(FILE, text(answers()))
