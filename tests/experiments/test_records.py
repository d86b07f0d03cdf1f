"""The records: all their rows are there, and one of them is made again each day."""

import random

import pytest

import p4dgs_ref as p4
from p4dgs_ref.lab.writer import read_csv
from tests.sampling import SEED, turn
from tests.workshop import demo
from tutorials.experiments import RECORDS
from tutorials.experiments.coded_networks import decision
from tutorials.experiments.equal_terms import curve
from tutorials.experiments.tables import ablate, effects, likelihood, training
from tutorials.experiments.tables.rows import KEY, TEXTS, make_row

LONGEST = 150  # seconds of the processor that the row of a day may take


def ablations():
    """All steps with 200 anchors; behind them, the step that has 400, which has D3DGS again."""
    found = {}
    for anchors in (None, 400):
        for name in ("bouncing", "figure"):
            tasks = ablate.plan(p4.load_scene(name), 3, ablate.ITERATIONS, anchors)
            found |= {task.key: task for task in tasks}
    return [*found.values()]


def of_bouncing(table):
    return lambda: table.plan(p4.load_scene("bouncing"), 3, table.ITERATIONS)


PLANS = {
    "beyond_networks": decision.plan,
    "ablate": ablations,
    "curve": curve.plan,
    "training": of_bouncing(training),
    "effects": of_bouncing(effects),
    "likelihood": of_bouncing(likelihood),
}


def rows_of(name):
    """The rows of a record by their keys."""
    found = read_csv(RECORDS / f"{name}.csv", TEXTS)
    return {tuple(row[column] for column in KEY): row for row in found}


@pytest.mark.parametrize("name", PLANS)
def test_a_record_has_all_rows_of_its_plan(name):
    assert [*rows_of(name)] == [task.key for task in PLANS[name]()]


@pytest.mark.parametrize("name", ["training", "effects"])
def test_each_training_has_its_own_seconds(name):
    seconds = [row["train_seconds"] for row in rows_of(name).values()]
    assert len({*seconds}) == len(seconds), "several rows share one time, as a copied median would"


@turn("a row of a record")
def test_one_row_of_a_record_is_made_again(tmp_path):
    """Another one each day. `P4DGS_TEST_SEED=20260131 pytest -m slow` makes that of a day."""
    pairs = [
        (task, row)
        for name, plan in PLANS.items()
        for task, row in zip(plan(), rows_of(name).values())
        if row["train_seconds"] <= LONGEST
    ]
    task, row = random.Random(SEED).choice(pairs)
    if not row["arithmetic"].endswith(f", {demo.with_what()}"):  # whatever version of the package
        pytest.skip(f"{row['label']}: made with {row['arithmetic']}; here is {demo.with_what()}")
    again = make_row(task, tmp_path)
    for column in ("sha256", "bytes", "psnr_db"):
        assert again[column] == row[column], (row["label"], row["scene"], row["seed"], column)
