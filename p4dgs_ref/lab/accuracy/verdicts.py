"""The record accuracy.csv, and what its rows say: a finding about every knob and quantity.

A row of the record is one value of a knob, of trainings and files with one seed. Seeds are compared
in pairs: a difference counts as known within twice its standard error. The times of two values can
be told apart or not (`clock.can_tell`). Both are looked at before a verdict is given.
"""

import numpy as np

from ..clock import can_tell, stretch_of
from ..writer import grouped, means, read_csv, twice_standard_error
from .knobs import PSNR

TEXTS = ("knob", "line", "value", "sha256", "arithmetic", "command")  # the columns without numbers
MAX_ERROR = 1e6  # percent or grey levels; a larger error is called unbounded
MIN_FACTOR = 1.01  # a knob that saves a smaller factor saves nothing
# What a knob is for that loses up to ten times more than is enough, by what it saves.
USES = {"ms": "for rough work", "seconds": "to try things out", "bytes": "at low rates"}
# The order of verdicts in the table.
ORDER = ("always", *USES.values(), "cannot tell", "saves nothing", "no")


def read(path):
    """The rows of the record of accuracy."""
    return read_csv(path, TEXTS)


def by_knob(rows):
    """The rows of each knob, {name: rows}, in their order."""
    return {name: of_knob for (name,), of_knob in grouped(rows, "knob").items()}


def points(rows):
    """One row for each line and value of a knob, with the means over seeds."""
    with np.errstate(invalid="ignore"):  # infinite errors have no range
        return means(rows, "line", "value")


def stretch(rows):
    """How far other programs disturbed the knob that they disturbed most; 1 without any times."""
    timed = by_knob([row for row in rows if "stretch" in row])
    return max(map(stretch_of, timed.values()), default=1.0)


# --- verdicts -------------------------------------------------------------------------------------
def paired(rows, references, column):
    """The mean difference of a column over the same seeds, and twice its standard error.

    Of a single seed the error is not known; it is infinite.
    """
    start = {row["seed"]: row[column] for row in references}
    gaps = [row[column] - start[row["seed"]] for row in rows if row["seed"] in start]
    return float(np.mean(gaps)), float(twice_standard_error(gaps))


def lost(loss, rows, references):
    """What some rows lose, in the unit of the loss, and within how much it is known.

    An error is against the truth, dB are lost against the reference.
    """
    if loss is PSNR:
        gain, within = paired(rows, references, loss.column)
        return -gain, within
    return loss.scale * max(row[loss.column] for row in rows), 0.0


def factor(knob, rows, references):
    """How many times as much the references spend; None where the two cannot be told apart."""
    if knob.spent == "bytes":
        gap, within = paired(rows, references, "bytes")
        told = abs(gap) > within or gap == 0
    else:
        told = can_tell(rows[0], references[0], knob.spent)
    spent = (np.mean([row[knob.spent] for row in some]) for some in (references, rows))
    return float(np.divide(*spent)) if told else None


def finding(knob, loss, rows):
    """A row of the page's table: what the first line of a knob loses in one quantity.

    It reports the cheapest value that loses no more than is enough. Where there is none, it is the
    first value that saves anything.
    """
    first, *_ = grouped(rows, "line").values()
    groups = {value: of_value for (value,), of_value in grouped(first, "value").items()}
    reference, *cheaper = groups
    factors = {value: factor(knob, groups[value], groups[reference]) for value in cheaper}
    losses = {value: lost(loss, groups[value], groups[reference]) for value in cheaper}
    saving = [value for value in cheaper if (factors[value] or 1) >= MIN_FACTOR]
    good = [value for value in saving if sum(losses[value]) <= loss.enough]
    value = max(good, key=factors.get, default=[*saving, *cheaper][0])
    (amount, within), times = losses[value], factors[value]
    verdicts = {
        "no": amount - within > 10 * loss.enough,
        "cannot tell": times is None or amount - within <= loss.enough < amount + within,
        "saves nothing": (times or 1) < MIN_FACTOR,
        "always": amount <= loss.enough,
        USES[knob.spent]: True,
    }
    return {
        "knob": knob.name,
        "reference": reference,
        "cheaper": value,
        "lost": in_words(loss, amount, within),
        "saved": " → ".join(
            short(np.mean([row[knob.spent] for row in groups[name]])) for name in (reference, value)
        )
        + f" {knob.spent.replace('seconds', 's')}",
        "factor": times or 1.0,
        "verdict": next(verdict for verdict, holds in verdicts.items() if holds),
    }


def in_words(loss, amount, within):
    """A loss in words."""
    if loss is not PSNR:
        return (
            f"{float(f'{amount:.2g}'):g} {loss.unit}"
            if amount < MAX_ERROR
            else f"unbounded ({loss.unit})"
        )
    known = f" ± {within:.2f}" * bool(np.isfinite(within))
    return f"{-amount:+.2f}{known} {loss.unit}".replace("-", "−")


def short(value):
    """A time or a size in three digits or more."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def pays_from(rows):
    """From how many anchors on the context pays, extrapolated from the two values of its knob."""
    prior, alone = points(rows)
    per_anchor = (alone["attribute_bytes"] - prior["attribute_bytes"]) / prior["anchors"]
    cost = (prior["bytes"] - prior["attribute_bytes"]) - (alone["bytes"] - alone["attribute_bytes"])
    return float(f"{cost / max(per_anchor, 1e-9):.2g}")


def findings(knobs, rows):
    """The rows of the page's table about the knobs in a record, sorted by verdict and factor."""
    of, table = by_knob(rows), []
    for knob in (knob for knob in knobs if knob.name in of):
        table += [finding(knob, loss, of[knob.name]) for loss in knob.losses]
    table.sort(key=lambda row: (ORDER.index(row["verdict"]), -row["factor"]))
    for row in table:
        if row["knob"] == "context":
            row["verdict"] = f"below {pays_from(of['context']):,.0f} anchors"
    return table
