"""What accuracy costs in time: four questions, and for each a few forms with time and loss.

A row has the question, the choice, its loss, the Times of one call (`ms`, its quartiles and the
`stretch` of the wall clock), and `arithmetic`. The first choice of a question is the reference that
the others are compared with. A training step, which has no loss, is timed together with Eq. (11).
"""

from typing import Any, NamedTuple

import numpy as np

from ...arithmetic import arithmetic
from ...training.presets import TINY
from ..clock import Times, alternate, differ, disturbance, step_at
from ..writer import align, group_rows, read_csv
from . import forms

TURNS = 5  # of every form, at least
STEP = "a training step"
TEXTS = ("question", "choice", "arithmetic")  # the columns of the record without numbers


class Question(NamedTuple):
    """One panel of the picture."""

    measure: Any  # a function of `forms`
    ours: str  # the choice of this project
    answer: str  # the choice that the title of the panel compares with the reference
    loss: str  # form of a row's loss, as text
    label: str  # of the axis of the loss


QUESTIONS = {
    "renderer": Question(
        forms.renderer,
        "fast",
        "fast",
        "off by {loss:.2g} grey levels",
        "off by (of 255)",
    ),
    "precision": Question(
        forms.precision,
        "float32",
        "float32",
        "off by {loss:.0e} of the gradient",
        "off by (of 1)",
    ),
    "Eq. (11)": Question(
        forms.eq_11,
        "ours",
        "as printed",
        "wrong in {loss:.1f} % of random bins",
        "wrong (%)",
    ),
    "noise": Question(
        forms.noise_draws,
        "1 draw",
        "1 draw",
        "off by {loss:.2g} % of the bits",
        "off by (%)",
    ),
}


def measure(model, scene, progress=lambda line: None):
    """Return the rows of all questions, measured on a trained model and its scene."""
    rows = []
    for name, question in QUESTIONS.items():
        progress(f"accuracy: {name}")
        choices = question.measure(model, scene.test)
        if name == "Eq. (11)":
            choices[STEP] = step_at(scene, TINY, 4), lambda result: np.nan
        for choice, columns in measure_in_turns(choices).items():
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


def comparison(row, group):
    """Return the speed of a row compared with the first of its group, as text."""
    times = {r["choice"]: times_of(r) for r in group}
    one, (name, other) = times[row["choice"]], next(iter(times.items()))
    if not differ(one, other):
        return f"not measurably faster or slower than {name}"
    factor = other.ms / one.ms
    text = f"{factor:.3g} times as fast" if factor > 1 else f"{1 / factor:.3g} times as slow"
    step = times.get(STEP)
    share = (
        f" (by {100 * abs(other.ms - one.ms) / step.ms:.2g} % of a training step)" if step else ""
    )
    return f"{text} as {name}{share}"


def loss_of(row):
    """Return what a row loses, as text."""
    return QUESTIONS[row["question"]].loss.format(**row)


def times_of(row):
    """Return the Times of a row."""
    return Times(*(row[name] for name in Times._fields))


def duration(ms, *quartiles):
    """Return a time in three digits, with its quartiles, if any, and its unit."""
    unit, scale = ("s", 1e-3) if ms >= 1e3 else ("ms", 1)
    between = " to ".join(f"{scale * value:.3g}" for value in quartiles)
    return f"{scale * ms:.3g}{f' ({between})' if quartiles else ''} {unit}"


def disturbance_note(rows):
    """Return a sentence if other programs disturbed the timing, else nothing."""
    return disturbance(max(row["stretch"] for row in rows))


def to_text(rows):
    """Return the table: for every choice its time, what it saves and what it loses."""
    cells = [["question", "choice", "time", "speed", "what is lost"]]
    for question, group in by_question(rows).items():
        for row in group:
            compared = lost = "-"
            if row["choice"] != STEP:
                lost = loss_of(row) if row["loss"] else "nothing"
                compared = "-" if row is group[0] else comparison(row, group)
            cells.append([question, row["choice"], duration(*times_of(row)[:3]), compared, lost])
    end = (
        "Times are processor times: the median and, in brackets, both quartiles. Random bins, from "
        "the whole domain of Eq. (11), are wrong if their bits are off by more than a tenth."
    )
    return "\n".join([*align(cells), "", end, *filter(None, [disturbance_note(rows)])])
