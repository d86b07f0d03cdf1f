"""The doctor: what it says of mistakes in one direction, in some cases, and of unknown ones."""

import numpy as np
import pytest
from scipy.special import erf

from p4dgs_ref import EQUATIONS, oracle
from p4dgs_ref.oracle import checker, doctor, published, tolerance
from p4dgs_ref.oracle.compare import compare, expected_tensors
from tests.oracle.answers import Port, in_precision
from tests.sampling import few
from tests.workshop.rewriting import edited

MISTAKES = [mistake for key in published.subjects() for mistake in doctor.known_mistakes(key)]
BOTH = ("out.", "in_bar.")


def patient(mistake, roles=BOTH, others=()):
    """A port with a known mistake, perhaps in outputs or gradients alone.

    In the cases `others` it has another error too.
    """

    def compute(case, _):
        wrong = mistake.answers.get(case.name, {})
        wrong = {name: a for name, a in wrong.items() if name.startswith(roles)}
        got = expected_tensors(case.tensors) | wrong
        return {n: a + 1 for n, a in got.items()} if case.name in others else got

    return Port(compute)


def diagnosis(mistake, others):
    """The failing cases of a port with a known mistake."""
    port = patient(mistake, others=others)
    results = checker.check_subject(published.cases(mistake.subject), port)
    return [r for r in results if r.verdict == "fail"]


def told(key, answer, dtype=np.float64):
    """The diagnoses of a port whose `answer(case)` is {tensor: array}; the rest is right."""
    answers = []
    for case in published.cases(key):
        with np.errstate(all="ignore"):
            got = in_precision(expected_tensors(case.tensors) | answer(case), dtype)
        answers.append((case, got, wrong_names(case, got, np.dtype(dtype).name)))
    assert any(wrong for *_, wrong in answers)
    return doctor.diagnose(key, answers)


def wrong_names(case, got, precision="float64"):
    """The tensors that are wrong, in their order."""
    return [finding.tensor for finding in compare(case.tensors, got, case.tolerance(precision))]


def by_id(id):
    return next(mistake for mistake in MISTAKES if mistake.id == id)


# --- what was once diagnosed wrongly ------------------------------------------------------------
def test_a_mistake_that_contradicts_most_cases_is_not_named():
    """The gradient of O_a lacks l_a. Where l_a is 0 that is the gradient of O_a exp(l_a)."""

    def answer(case):
        bar = case.cotangents()["x_bar"]
        return {"in_bar.O_a": np.broadcast_to(bar, case.inputs()["O_a"].shape)}

    assert told("offsets", answer) == []


@pytest.mark.parametrize(
    "key, changes, ids",
    [
        (
            "step",
            {"np.where(share > SMALLEST, ": "(", "psi_q), 0)": "psi_q))"},
            ["step-floor-gradient"],
        ),
        # The step is halved, and its slope with it.
        ("step", {"= 2 * sigmoid(": "= sigmoid(", "4 * Q_0": "2 * Q_0"}, []),
    ],
)
def test_a_mistake_is_not_offered_where_its_outputs_are_not_the_ports(key, changes, ids):
    """Of ports that are the equation's own file with some of its text replaced."""
    wrong = edited(key, changes)
    rows = told(key, lambda case: tolerance.answer_of(wrong)(case.inputs(), case.cotangents()))
    assert [row.mistake.id for row in rows] == ids


def test_an_inverted_mask_is_not_an_ignored_one():
    """Although both cost the same where everything is masked, or infinite: in 2 of 3 cases."""
    eq = EQUATIONS["anchor_rate"]
    results = oracle.check(lambda mask, **bits: eq(mask=~mask, **bits), "anchor_rate").results
    assert sum(r.wrong for r in results) == 3 and not any(r.hint or r.explanation for r in results)


# --- ports with mistakes, written without the definitions of `tests/workshop/mistakes` -----------


def straight_through(case):
    """Signs as h + p - stop_gradient(p): a count of 0 keeps the rounding."""
    grids = case.inputs()["grids"]
    count = sum(((1 + (np.where(p >= 0, 1, -1) + p - p)) / 2).sum() for p in grids)
    if not 0 < count < 1:
        return {}
    share = count / sum(p.size for p in grids)
    bar = 1.5 * np.log2(1 / share - 1)
    slopes = {f"in_bar.grids.{i}": np.where(abs(p) <= 1, bar, 0) for i, p in enumerate(grids)}
    return {"out.R_hash": np.asarray(-count * np.log2(share)), **slopes}


def cell_before_the_last_node(case):
    x, lo, hi, res = case.inputs().values()
    u = np.clip((x - lo) / (hi - lo), 0, 1) * (res - 1)
    node = np.clip(u, 0, max(res - 2, 0)).astype(int) if hi > lo else 0 * x.astype(int)
    weight = np.where(hi > lo, u - node, 0)
    return {
        "out.node": np.stack([node, np.minimum(node + 1, res - 1)], axis=1),
        "out.weight": np.stack([1 - weight, weight], axis=1),
    }


def phi_from_erf(case):
    """Eq. (11) as printed, whose last digits are not those of SciPy's ndtr."""
    f, mu, sigma, q = case.inputs().values()
    up, down = (erf((f + half - mu) / (sigma * 2**0.5)) for half in (q / 2, -q / 2))
    return {"out.bits": -np.log2((up - down) / 2)}


@pytest.mark.parametrize(
    "answer, id",
    [
        (phi_from_erf, "likelihood-literal"),
        (straight_through, "hash-rate-rounded-count-float64"),
        (cell_before_the_last_node, "grid-cell-last-node"),
    ],
)
def test_a_port_with_a_common_mistake_is_explained(answer, id):
    rows = told(by_id(id).subject, answer)
    assert [row.mistake.id for row in rows] == [id] and rows[0].certain


# --- what agrees with some of the answers -------------------------------------------------------
def halves(outputs, gradients):
    """An answer with the outputs of one mistake and the gradients of another."""

    def answer(case):
        wrong = patient(gradients, ("in_bar.",)).run(case)
        outputs_of = patient(outputs, ("out.",)).run(case)
        return wrong | {name: a for name, a in outputs_of.items() if name.startswith("out.")}

    return answer


def test_two_mistakes_one_in_each_direction():
    """Each is named in the cases where its direction is wrong."""
    rows = told("likelihood", halves(by_id("likelihood-nats"), by_id("likelihood-mean-gradient")))
    parts = {row.mistake.id: row.part for row in rows}
    assert parts == {"likelihood-nats": "outputs", "likelihood-mean-gradient": "gradients"}
    assert all(row.certain and len(row.cases) == row.failed for row in rows)


def test_a_mistake_that_agrees_with_most_failing_cases_is_a_hint():
    """It is given where it agrees, and the report does not say that it explains."""
    wrong = diagnosis(by_id("likelihood-floor"), {"tail"})
    hints = {r.id: r.hint for r in wrong}
    assert not any(r.explanation for r in wrong) and hints.pop("likelihood/tail") == ""
    (hint,) = set(hints.values())
    assert (
        f"[likelihood-floor] (agrees with {len(hints)} of {len(hints) + 1} failing cases)" in hint
    )
    report = str(checker.Report(wrong))
    assert f"    hint: {hint}" in report and "explained by" not in report


def test_a_mistake_that_agrees_with_few_failing_cases_is_not_mentioned():
    names = [case.name for case in published.cases("likelihood")]
    wrong = diagnosis(by_id("likelihood-floor"), names[: len(names) * 3 // 4])
    assert wrong and not any(r.explanation or r.hint for r in wrong)


def test_a_mistake_that_would_show_in_a_right_case_is_not_mentioned():
    """nats in a single case: a port that takes nats for bits has them in all cases."""

    def answer(case):
        wrong = case.name == "ordinary"
        return patient(by_id("likelihood-nats")).run(case) if wrong else {}

    assert told("likelihood", answer) == []


def test_an_explanation_is_lent_to_no_other_subject():
    """Primes exchanged, and 0 read as -1: a case that hashes nothing is not explained by primes."""
    primes = patient(by_id("hash-index-prime-order")).compute

    def change(case, got):
        wrong = case.subject == "hash_grid"
        return {n: a + 1.0 for n, a in got.items() if a.dtype.kind == "f"} if wrong else got

    report = checker.check_port(Port(primes, change=change), only="hash_grid")
    explained = {r.subject for r in report.results if r.findings and r.explanation}
    assert explained == {"hash_index"}


# --- factors, which need no stored answers ------------------------------------------------------
QUANTITIES = [
    (key, quantity)
    for key in (key for key, row in published.subjects().items() if row["level"] == "L1")
    for quantity in dict.fromkeys(
        name.rsplit(".", name.count(".") - 1)[0]
        for case in published.cases(key)
        for name, a in expected_tensors(case.tensors).items()
        if a.dtype.kind == "f"
    )
]


def times(quantity, factor):
    """An answer with one quantity, a list too, multiplied by a factor."""

    def answer(case):
        tensors = expected_tensors(case.tensors).items()
        return {n: factor * a for n, a in tensors if (n + ".").startswith(quantity + ".")}

    return answer


@pytest.mark.parametrize("key, quantity", few(QUANTITIES, 6, 30))
def test_zero_negated_doubled_and_halved(key, quantity):
    what = quantity.replace("out.", "the output ").replace("in_bar.", "the gradient of ")
    for factor, words in doctor.FACTORS.items():
        rows = told(key, times(quantity, factor))
        assert rows and all(row.certain for row in rows)
        # Some are known by a name of their own.
        assert rows[0].mistake.id or rows[0].mistake.description == f"{what} {words}"


@pytest.mark.usefixtures("right_reference")
def test_the_report_says_what_factor_which_gradient_has():
    eq = EQUATIONS["offsets"]

    def wrong(inputs, bars):
        right = eq.vjp(**inputs)[1](**bars)
        return right | {"x_a": -right["x_a"], "l_a": right["l_a"] / 2}

    explanation = "the gradient of x_a has the wrong sign and the gradient of l_a is halved"
    assert f"explained by: {explanation}\n" in str(oracle.check(eq, "offsets", wrong))


def test_another_factor_is_not_explained():
    assert told("offsets", times("in_bar.x_a", 1.7)) == []
