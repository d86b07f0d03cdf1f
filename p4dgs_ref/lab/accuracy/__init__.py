"""What accuracy costs in time: four questions, and for each a few forms with time and loss.

A row has the question, the choice, its loss, the Times of one call (`ms`, its quartiles and the
`stretch` of the wall clock), and `arithmetic`. The first choice of a question is the reference that
the others are compared with.
"""

from typing import Any, NamedTuple

import numpy as np

from ...arithmetic import arithmetic
from ..clock import Times, alternate, differ, disturbance
from ..writer import group_rows, read_csv, text_table
from . import forms

TURNS = 5  # of every form, at least
TEXTS = ("question", "choice", "arithmetic")  # the columns of the record without numbers


class Question(NamedTuple):
    """One panel of the picture."""

    measure: Any  # a function of `forms`
    ours: str  # the choice of this project
    answer: str  # the choice that the title of the panel compares with the reference
    loss: str  # form of a row's loss, as text
    axis: str  # what the loss is
    unit: str
    scale: str  # of its axis


QUESTIONS = {
    "renderer": Question(
        forms.renderer,
        "fast",
        "fast",
        "off by {loss:.2g} grey levels",
        "error (grey levels of 255)",
        "grey levels",
        "log",
    ),
    "precision": Question(
        forms.precision,
        "float32",
        "float32",
        "off by {loss:.0e} of the gradient",
        "error of the gradient (of 1)",
        "of 1",
        "log",
    ),
    "Eq. (11)": Question(
        forms.eq_11,
        "ours",
        "as printed",
        "wrong in {loss:.1f} % of bins",
        "bins with wrong bits (%)",
        "% of bins",
        "linear",
    ),
    "noise": Question(
        forms.noise_draws,
        "1 draw",
        "1 draw",
        "off by {loss:.2g} % of the bits",
        "error of the rate (%)",
        "% of bits",
        "log",
    ),
}


def measure(progress=lambda line: None):
    """Return the rows of all questions."""
    rows = []
    for name, question in QUESTIONS.items():
        progress(f"accuracy: {name}")
        for choice, columns in measure_in_turns(question.measure()).items():
            rows.append({"question": name, "choice": choice, **columns, "arithmetic": arithmetic()})
    return rows


def measure_in_turns(choices):
    """Return {choice: its loss and Times} of forms {choice: (run, loss)}, which take turns."""
    with np.errstate(all="ignore"):
        times = alternate({choice: run for choice, (run, _) in choices.items()}, TURNS)
        return {
            choice: {"loss": float(loss(run())), **times[choice]._asdict()}
            for choice, (run, loss) in choices.items()
        }


def read(path):
    """Return the rows of a record, accuracy.csv."""
    return read_csv(path, TEXTS)


def by_question(rows):
    """Return the rows of each question, {name: rows}, the reference first."""
    return {name: group for (name,), group in group_rows(rows, "question").items()}


def comparison(row, reference):
    """Return a row beside its reference as text: what is lost, and how many times as fast it is."""
    one, other = (Times(r["ms"], r["ms_low"], r["ms_high"], 1) for r in (row, reference))
    factor = one.ms / other.ms
    faster = f"{1 / factor:.3g} times as fast" if factor < 1 else f"{factor:.3g} times as slow"
    return {
        **row,
        "reference": reference["choice"],
        "time": duration(one.ms),
        "was": duration(other.ms),
        "faster": faster if differ(one, other) else "as fast",
        "lost": QUESTIONS[row["question"]].loss.format(**row),
    }


def duration(ms):
    """Return a time in three digits, with its unit."""
    return f"{ms / 1e3:.3g} s" if ms >= 1e3 else f"{ms:.3g} ms"


def disturbance_note(rows):
    """Return a sentence if other programs disturbed what was timed, else nothing."""
    return disturbance(max(row["stretch"] for row in rows))


def to_text(rows):
    """Return the table: every choice but the references, with what it saves and loses."""
    columns = {"question": "{question}", "choice": "{choice}", "time": "{time}"}
    columns |= {"instead of": "{reference}", "its time": "{was}", "so it is": "{faster}"}
    columns |= {"what is lost": "{lost}"}
    cells = [comparison(row, group[0]) for group in by_question(rows).values() for row in group[1:]]
    end = "Times are of one processor."
    return "\n".join(
        [*text_table(columns, cells), "", end, *filter(None, [disturbance_note(rows)])]
    )
