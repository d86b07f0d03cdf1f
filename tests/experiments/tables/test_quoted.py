"""Every numeral of a page that quotes a record is an entry of it or follows from its rows.

In a page, `<!-- from records/curve.csv: label d3dgs; scene figure -->` stands before a table or
before sentences, up to the next blank line or comment, whose numerals come from the rows with these
values: entries, means over seeds and scenes with half their range, differences and ratios between
the named labels. `without text` leaves out the labels that have this text. `factors` are those of
the bytes of all methods at equal PSNR, and the BD-rates; `factors of p4dgs` are against the paper's
design instead of ours, `hundredfold` are the steps from the file of D3DGS to ours, and `shorter` is
what fewer iterations change.
"""

import re
from itertools import permutations

import numpy as np
import pytest

from p4dgs_ref.lab import effect_ledger, writer
from p4dgs_ref.lab.tables import ablate, curve, hundredfold
from p4dgs_ref.lab.tables.methods import CODED
from p4dgs_ref.lab.writer import bd_rate, means
from tests.budget import ROOT
from tutorials import growing_detail
from tutorials.tools import records

PAGES = (
    *("README.md", "tutorials/reference.md", "tutorials/tour.md"),
    "p4dgs_ref/beyond/README.md",
)
MARK = re.compile(r"<!-- from records/(\w+)\.csv(?:: (.+?))? -->(.+?)(?=\n\n|<!--|\Z)", re.DOTALL)
NUMERAL = re.compile(r"(?<![\w.,])\d+(?:,\d{3})*(?:\.\d+)?(?![\w]|[.,]\d)")
UNQUOTED = re.compile(r"`[^`]*`|\]\([^)]*\)")  # names and links
QUANTITIES = ("psnr_db", "ssim", "lambda_rate", "iterations", "anchors", "gaussians")
ABOUT_ALL = ("factors", "hundredfold", "shorter")
QUOTES = [
    pytest.param(page, *quote, id=f"{page}: {' '.join(quote[2].split())[:30]}")
    for page in PAGES
    for quote in MARK.findall((ROOT / page).read_text(encoding="utf-8"))
]


def sentences(text, labels):
    """The sentences of prose or the rows of a table, each with the labels that it is about.

    A table with a row for each label, in the order of the record, is read row by row.
    """
    if not text.startswith("\n|"):
        return [(one, labels) for one in re.split(r"(?<=[.:;])\s+", " ".join(text.split()))]
    head, rule, *body = text.strip().splitlines()
    each = [[label] for label in labels] if len(body) == len(labels) else [labels] * len(body)
    return [(head, labels), *zip(body, each)]


def numerals(sentence):
    """Its numerals, without those of names, code and links."""
    return NUMERAL.findall(UNQUOTED.sub("", sentence))


def chosen(rows, terms):
    """The rows with the values of the terms, such as "label d3dgs; scene figure"."""
    wanted = {}
    for term in terms:
        column, _, value = term.partition(" ")
        if column == "without":
            rows = [row for row in rows if value not in row["label"]]
        else:
            wanted.setdefault(column, set()).add(value)
    for column, values in wanted.items():
        assert values <= {str(row[column]) for row in rows}, f"no row with {column} {values}"
        rows = [row for row in rows if str(row[column]) in values]
    return rows


def entries(rows):
    """The entries of rows, their means over seeds and scenes, half ranges, seeds and years."""
    found = {*range(3), *(int(row["made"][:4]) for row in rows)}
    for keys in ((), ("scene",), ("scene", "seed")):
        for row in means(rows, "label", *keys):
            found |= {
                row[column]
                for column in row
                if column.removesuffix("_spread") in QUANTITIES or "bytes" in column
            }
    return found


def pairs(rows):
    """What distinguishes two labels: in the mean, on a scene, and at the extremes."""
    found, each = set(), {}
    for keys in ((), ("scene",), ("scene", "seed")):
        for one, other in permutations(means(rows, "label", *keys), 2):
            if all(one[key] == other[key] for key in keys):
                ratio = one["bytes"] / other["bytes"]
                change = ratio, 100 * (1 - ratio), one["psnr_db"] - other["psnr_db"]
                each.setdefault((keys, one["label"], other["label"]), []).append(change)
    for (keys, *_), changes in each.items():
        found |= {*np.mean(changes, axis=0), *np.min(changes, axis=0)}
        found |= {value for change in changes for value in change if keys == ("scene",)}
    return found


def steps(rows, labels):
    """What the steps of an ablation change, on each scene, here and in the paper."""
    found = set()
    for scene in {row["scene"] for row in rows}:
        for step in ablate.summaries([row for row in rows if row["scene"] == scene]):
            if step["label"] in labels:
                found |= {step.get(unit, 0.0) for unit in ablate.UNITS} | {*step["paper"].values()}
    return found


def factors(rows, base=CODED):
    """How one curve compares with every other one, in bytes at equal PSNR."""
    if "storage" in rows[0]:
        found = [row for row in curve.comparisons(rows) if row["against"] == base]
        return {value for row in found for value in row.values() if isinstance(value, float)}
    curves = {}
    for row in means(rows, "label", "method"):
        curves.setdefault(row["method"], []).append((row["bytes"], row["psnr_db"]))
    ours = curves.pop(base)
    rates = {bd_rate(ours, other)[0] for other in curves.values()}
    return rates.union(*(writer.factors(ours, other).values() for other in curves.values()))


def numbers(name, terms, rows, labels):
    """The numbers that a sentence about some labels may quote."""
    own = [row for row in rows if row["label"] in labels]
    lengths = {row["iterations"] for row in own}
    for term in terms:
        if term.startswith("factors"):
            return factors(own, *term.split(" of ")[1:]) | lengths
        if term == "hundredfold":
            of_steps = hundredfold.steps(own)
            found = {value for row in of_steps for value in row.values()}
            found |= {1 / row["factor"] for row in of_steps if "factor" in row}  # what grows
            return {value for value in found if isinstance(value, float)} | lengths
        if term == "shorter":
            values = {value for row in curve.shorter(own) for value in row.values()}
            return {value for value in values if not isinstance(value, str)} | lengths
    if name == "growing_detail":
        found = growing_detail.summaries(growing_detail.with_kinds(own))
        each = [row.pop("factors", {}) | row for row in found]
        values = {value for row in each for pair in row.items() for value in pair}
        return entries(own) | {value for value in values if isinstance(value, float)}
    if name == "effects":
        found = [row.values() for row in effect_ledger.summaries(own)]
        return entries(own) | {value for row in found for value in row if isinstance(value, float)}
    if name == "ablate":
        return entries(own) | steps(records.rows(name), labels)
    return entries(own) | (pairs(own) if "label " in " ".join(terms) else set())


def is_in(numeral, found):
    """Whether a number of the record is written like this."""
    text = numeral.replace(",", "")
    decimals = len(text.partition(".")[2])
    return any(f"{abs(value):.{decimals}f}" == text for value in found)


def unfound(name, terms, text):
    """The numerals of a text that are not in the record, each with its sentence.

    A row of a table that begins with a scene, or with the pixels of one, is about this scene.
    """
    terms = terms.split("; ") if terms else []
    rows = chosen(records.rows(name), [term for term in terms if not term.startswith(ABOUT_ALL)])
    found, missing = {}, []
    for sentence, labels in sentences(text, [*dict.fromkeys(row["label"] for row in rows)]):
        first, _, rest = sentence.partition(" | ")
        own = [row for row in rows if row["scene"].removeprefix("detail_") == first.strip("| `")]
        about = first if own else "", *labels
        if about not in found:
            found[about] = numbers(name, terms, own or rows, labels)
        missing += [
            f"{one} in {sentence!r}"
            for one in numerals(rest if own else sentence)
            if not is_in(one, found[about])
        ]
    return missing


@pytest.mark.parametrize("page, name, terms, text", QUOTES)
def test_the_numerals_are_those_of_the_record(page, name, terms, text):
    assert numerals(text)
    missing = unfound(name, terms, text)
    assert not missing, f"{page}: not in records/{name}.csv: " + "\n".join(missing)


def test_every_record_is_quoted_and_most_changed_digits_are_noticed():
    """A wrong digit passes only where the record has such a number, too."""
    changed = noticed = 0
    for quote in QUOTES:
        _, name, terms, text = quote.values
        other = NUMERAL.sub(lambda one: f"{one[0][:-1]}{(int(one[0][-1]) + 5) % 10}", text)
        changed += len(numerals(other))
        noticed += len(unfound(name, terms, other))
    assert {quote.values[1] for quote in QUOTES} == {*records.PLANS, "growing_detail"}
    assert 0.8 * changed < noticed <= changed
