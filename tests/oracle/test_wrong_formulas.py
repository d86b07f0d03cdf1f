"""What the doctor says of wrong formulas that it does not know is contradicted by no answer."""

import random
from collections import Counter

import numpy as np
import pytest

from p4dgs_ref.oracle import doctor, published
from p4dgs_ref.oracle.compare import compare, expected
from p4dgs_ref.table import EQUATIONS
from tests.golden.kill_matrix import laboratory
from tests.golden.mutate import applied, mutations
from tests.sampling import SEED, few

CLOSE = 1e-6  # of the largest number in an array


def wrong_names(case, got):
    return {finding.tensor for finding in compare(case.tensors, got, case.tolerance("float64"))}


def close(a, b):
    """Whether two arrays are the same numbers. A NaN equals a NaN."""
    if a.shape != b.shape:
        return False
    size = np.abs(b[np.isfinite(b)]).max(initial=0)
    return np.allclose(a, b, rtol=0, atol=CLOSE * float(size), equal_nan=True)


def contradictions(diagnoses, answers):
    """The (mistake, case, tensor) in which a port differs from a mistake that is named.

    Where the port is wrong, the mistake must be wrong and equal to it; where the port is right, the
    mistake must be right. A hint is held to this in the cases that it names.
    """
    found = []
    for row in diagnoses:
        role = doctor.ROLES.get(row.part, "")
        for case, got, wrong in answers:
            if row.certain or case.id in row.cases:
                would = expected(case.tensors) | row.mistake.answers.get(case.name, {})
                shown = wrong_names(case, {name: would[name] for name in got})
                for name in (n for n in got if n.startswith(role)):
                    agrees = (name in shown) == (name in wrong)
                    if not agrees or name in wrong and not close(got[name], would[name]):
                        found.append((row.mistake.id, case.id, name))
    return found


def verdict(diagnoses):
    """`explained`, `hint` or `silent`."""
    if not diagnoses:
        return "silent"
    return "explained" if diagnoses[0].certain else "hint"


def survey(judge, sample):
    """Count the verdicts on mutated programs. None may contain a contradiction."""
    counts = Counter()
    for mutation in sample:
        try:
            with laboratory(), applied(mutation):
                answers = judge.answers(mutation.equation)
        except Exception:  # the changed file cannot be loaded, or never ends
            continue
        if any(wrong for *_, wrong in answers):
            diagnoses = doctor.diagnose(mutation.equation, answers)
            assert contradictions(diagnoses, answers) == [], mutation.id
            counts[verdict(diagnoses)] += 1
    return counts


def of_one_equation():
    """The mutations of files that serve one equation."""
    return [mutation for mutation in mutations() if mutation.equation]


def chosen():
    """Those of them that are surveyed: all in the slow lane, a sample in the short one."""
    return random.Random(12).sample(of_one_equation(), 200)


def test_mutations_of_our_code(judge, hasty):
    assert survey(judge, random.Random(SEED).sample(chosen(), 12))


@pytest.mark.slow
def test_more_mutations_of_our_code(judge):
    counts = survey(judge, chosen())
    assert counts.total() >= 100 and counts["silent"] > counts["explained"] > 0


def mixed(rng, mistakes, cases):
    """The answers of a port that has another of some mistakes in every case and direction."""
    answers = []
    for case in cases:
        got = {}
        for role in doctor.ROLES.values():
            stored = rng.choice(mistakes).answers.get(case.name, {})
            got |= {
                n: stored.get(n, a) for n, a in expected(case.tensors).items() if n.startswith(role)
            }
        answers.append((case, got, sorted(wrong_names(case, got))))
    return answers


@pytest.mark.parametrize("key, seed", few([(key, n) for key in EQUATIONS for n in range(6)], 10))
def test_mixtures_of_known_mistakes(key, seed):
    """Two mistakes in turns, of which one may be in most of the cases."""
    rng = random.Random(f"{key} {seed}")
    two = rng.sample(doctor.known(key), 2)
    answers = mixed(rng, [two[0]] * rng.choice([1, 2, 4]) + two[1:], published.cases(key))
    assert contradictions(doctor.diagnose(key, answers), answers) == []


def test_a_contradiction_is_seen():
    """Answers with which a mistake agrees, then the same with one array changed."""
    mistake = next(m for m in doctor.known("offsets") if m.id == "offsets-not-scaled")
    answers = mixed(random.Random(0), [mistake], published.cases("offsets"))
    diagnoses = doctor.diagnose("offsets", answers)
    assert verdict(diagnoses) == "explained" and contradictions(diagnoses, answers) == []
    got = answers[0][1]
    got["out.x"] = 1.01 * got["out.x"]
    assert len(contradictions(diagnoses, answers)) == 1
    assert verdict(doctor.diagnose("offsets", answers)) == "hint"
