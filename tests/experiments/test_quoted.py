"""Numbers on the page of experiments and in the tour are those of the records.

`<!-- from records/NAME.csv: KIND -->` marks what stands up to the next comment. KIND says which
numbers: those of a table of `equal_terms`, otherwise means of rows over seeds and scenes.
"""

import re
from pathlib import Path

import pytest

import p4dgs_ref as p4
from p4dgs_ref.lab.writer import fill_form, read_csv
from tutorials.experiments import RECORDS, equal_terms
from tutorials.experiments.coded_networks import decision
from tutorials.experiments.equal_terms import curve, numbers, steps
from tutorials.experiments.tables import ablate, effects, training
from tutorials.experiments.tables.rows import TEXTS
from tutorials.experiments.tables.writer import means

PAGE = Path(equal_terms.__file__).parents[1] / "README.md"
MARK = re.compile(r"<!-- from records/(\w+)\.csv(?:: (.+?))? -->(.+?)(?=<!--|\Z)", re.DOTALL)
NUMERAL = re.compile(r"(?<![\w.,=])\d+(?:,\d{3})*(?:\.\d+)?(?![\w]|[.,]\d)")
TOUR = PAGE.parents[1] / "tour.md"
QUOTES = [
    quote for page in (PAGE, TOUR) for quote in MARK.findall(page.read_text(encoding="utf-8"))
]


def compared(name):
    """All rows of comparisons, and what they have of each seed."""
    rows = [row for s in (curve.STORED, curve.ALIKE) for row in curve.compare(of_curve(name), s)]
    return rows + [seed for row in rows for seed in row["each"]]


def of_curve(name):
    """The rows of a record that curves show."""
    return curve.shown(read_csv(RECORDS / f"{name}.csv", TEXTS))


def coded(name):
    """What coded networks change, each row and the means."""
    rows = [*decision.comparisons(read_csv(RECORDS / f"{name}.csv", TEXTS))]
    return rows + means(rows, "lambda_rate") + means(rows, "lambda_rate", "scene")


KINDS = {
    "coded": coded,
    "compare": compared,
    "steps": lambda name: steps.bands(of_curve(name)),
    "numbers": lambda name: numbers.inferred() + numbers.measured(of_curve(name)),
}


def values_of(name, kind):
    """The numbers that a quote may have."""
    if kind in KINDS:
        rows = KINDS[kind](name)
    else:
        rows = read_csv(RECORDS / f"{name}.csv", TEXTS)
        keys = (), ("scene",), ("scene", "seed")
        rows += [row for key in keys for row in means(rows, "label", *key)]
    return {value for row in rows for value in row.values() if isinstance(value, (int, float))}


def is_in(numeral, values):
    text = numeral.replace(",", "")
    decimals = len(text.partition(".")[2])
    return any(f"{abs(value):.{decimals}f}" == text for value in values)


@pytest.mark.parametrize("name, kind, text", QUOTES, ids=[f"{q[0]} {q[1]}" for q in QUOTES])
def test_the_numbers_are_those_of_the_record(name, kind, text):
    values, found = values_of(name, kind), NUMERAL.findall(re.sub(r"`[^`]*`", "", text))
    assert found and not [one for one in found if not is_in(one, values)]


def test_tables_of_lengths_and_effects_are_those_of_the_records():
    page, found = PAGE.read_text(encoding="utf-8"), []
    empty = effects.psnr_of_nothing(p4.load_scene("bouncing"))
    for table in (training, effects):
        record = read_csv(RECORDS / f"{table.__name__.rpartition('.')[2]}.csv", TEXTS)
        rows = training.summaries(record) if table is training else effects.summaries(record, empty)
        for row in rows:
            cells = [fill_form(form, row) for form in table.COLUMNS.values()]
            found.append(f"| {' | '.join(cells)} |")
    missing = [line for line in found if line not in page]
    assert not missing, "the page of experiments lacks these rows:\n" + "\n".join(missing)


def steps_of_bouncing():
    """The means of each step of Table 3 on `bouncing`, by its label."""
    rows = [row for row in read_csv(RECORDS / "ablate.csv", TEXTS) if row["scene"] == "bouncing"]
    return {row["label"]: row for row in means(rows, "label")}


def test_the_tour_says_what_motion_is_worth():
    whole, still = (steps_of_bouncing()[label] for label in (ablate.WHOLE, "no deformation"))
    size = f"{round(whole['bytes']) - round(still['bytes']):,} bytes"  # of the printed numbers
    words = f"motion: {whole['psnr_db']:.1f} dB instead of {still['psnr_db']:.1f}, for {size}"
    drawing = (TOUR.parent / "tools" / "show.py").read_text(encoding="utf-8")
    assert words in drawing, f"picture 4 of the tour lacks: {words}"
    assert size in TOUR.read_text(encoding="utf-8"), f"the tour lacks: {size}"


def test_the_first_page_shows_table_3_beside_the_papers():
    page = (PAGE.parents[2] / "README.md").read_text(encoding="utf-8")
    ours = steps_of_bouncing()
    theirs = {label: papers.split() for label, papers in ablate.PAPER.items()}
    shown = {label: f"{float(p[0]):.3g} MB | {p[1]} dB" for label, p in theirs.items()}
    shown[f"{ablate.SPATIAL}, 400 anchors"] = "- | -"
    for label, papers in shown.items():
        here = "{bytes:,.0f} bytes | {psnr_db:.2f} dB | {gaussians:.0f}".format_map(ours[label])
        line = f"| {label} | {papers} | {here} |"
        assert line in page, f"README.md lacks the row {line}"
