"""Every known mistake of the doctor against its twin, a patch of our source: same numbers, noticed, and told from others."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest

from p4dgs_ref.equations import EQUATIONS
from p4dgs_ref.oracle.mistakes import MISTAKES, NotApplicable
from p4dgs_ref.oracle.subjects import subjects
from tests.core.test_equations import cast, draw_cotangents, leaves
from tests.golden.known_mistakes import PATCHES, patched, patched_source

SUBJECTS = subjects()
CLOSE = 1e-9  # of the largest number in an array
NOISE = 1e-16  # what is left of a sum that is exactly zero
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # mistakes divide by zero
EVERY = pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.id)


def answer(out, gradients):
    """Outputs and gradients as one flat dictionary of arrays."""
    flat = {("out", name): a for name, a in out.items()} | {
        ("in_bar", name): a for name, a in gradients.items()
    }
    return {(*key, i): a for key, value in flat.items() for i, a in enumerate(leaves(value))}


def of_code(eq, inputs, cotangents):
    """What the code as it stands answers."""
    with np.errstate(all="ignore"):
        out, res = eq.forward(**inputs)
        out = {
            name: np.copy(a) if isinstance(a, np.ndarray) else a
            for name, a in out._asdict().items()
        }
        return answer(out, eq.backward(res, **cotangents) if eq.differentiable else {})


@cache
def questions(key):
    """[(name, inputs, cotangents, right answer)] of an equation or a stage, made before anything is patched."""
    eq, asked = SUBJECTS[key].eq, []
    for n, case in enumerate(SUBJECTS[key].cases()):
        cotangents = draw_cotangents(
            eq, eq(**case.inputs), np.random.default_rng(n).standard_normal
        )
        asked.append((case.name, case.inputs, cotangents, of_code(eq, case.inputs, cotangents)))
    return asked


def differ(a, b):
    """Whether two arrays differ by more than rounding; a NaN equals a NaN."""
    if a.shape != b.shape:
        return True
    a, b = (x.astype(float) for x in (a, b))
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.where(same, 0, np.nan_to_num(np.abs(a - b), nan=np.inf))
    return bool((off > max(CLOSE * np.abs(b[np.isfinite(b)]).max(initial=0), NOISE)).any())


def difference(got, want):
    """Names of arrays in which two answers differ."""
    return sorted(
        name
        for name in {*got, *want}
        if name not in got or name not in want or differ(got[name], want[name])
    )


@cache
def told(mistake):
    """The mistake's answers to all questions, None where it has none."""
    answers = []
    for _, inputs, cotangents, _ in questions(mistake.subject):
        try:
            answers.append(answer(*mistake.run(inputs, cotangents)))
        except NotApplicable:
            answers.append(None)
    return answers


def test_list():
    ids = [mistake.id for mistake in MISTAKES]
    assert len(set(ids)) == len(ids) >= 60
    assert set(ids) == set(PATCHES)
    assert all(id == id.lower() and " " not in id and "_" not in id for id in ids)
    descriptions = [(mistake.equation, mistake.description) for mistake in MISTAKES]
    assert len(set(descriptions)) == len(descriptions)
    assert {mistake.subject for mistake in MISTAKES} >= set(EQUATIONS)
    assert all(mistake.equation == SUBJECTS[mistake.subject].equation for mistake in MISTAKES)
    assert not [
        d
        for _, d in descriptions
        if "\n" in d or d.endswith(".") and not d.endswith("...") or len(d) > 120
    ]


@EVERY
def test_doctor_and_patch_agree(mistake):
    asked, answers, noticed = questions(mistake.subject), told(mistake), []
    eq = SUBJECTS[mistake.subject].eq
    with patched(mistake.id):
        patient = [of_code(eq, inputs, cotangents) for _, inputs, cotangents, _ in asked]
    for (name, _, _, right), said, got in zip(asked, answers, patient):
        if difference(got, right):
            noticed.append(name)
            assert said is not None, f"case {name}: the patch shows, the mistake does not apply"
        if said is not None:
            assert not difference(said, got), f"case {name}: {difference(said, got)}"
    assert noticed, "no case notices it"
    for name, inputs, cotangents, right in asked:
        assert not difference(of_code(eq, inputs, cotangents), right), (
            f"case {name}: the patch was not taken back"
        )


@EVERY
def test_works_in_float32(mistake):
    for name, inputs, cotangents, _ in questions(mistake.subject):
        with np.errstate(over="ignore"):
            low, bars = (
                {n: cast(a, np.float32) for n, a in tree.items()} for tree in (inputs, cotangents)
            )
        try:
            out, gradients = mistake.run(low, bars)
        except NotApplicable:
            continue
        floats = [a for a in answer(out, gradients).values() if a.dtype.kind == "f"]
        assert all(np.asarray(a).dtype in (np.float32, np.float64) for a in floats), name


@pytest.mark.parametrize("key", sorted({mistake.subject for mistake in MISTAKES}))
def test_mistakes_differ_from_each_other(key):
    alike = []
    for one, other in combinations([m for m in MISTAKES if m.subject == key], 2):
        compared = [
            (a, b, right)
            for a, b, (*_, right) in zip(told(one), told(other), questions(key))
            if a is not None and b is not None
        ]
        shown = [(a, b) for a, b, right in compared if difference(a, right) or difference(b, right)]
        if shown and not any(difference(a, b) for a, b in shown):
            alike.append((one.id, other.id))
    assert not alike


# --- the tests of the tests --------------------------------------------------------------------------------------
def test_a_patch_must_find_its_text():
    with pytest.raises(ValueError, match="offsets.py: 0 times, expected once: 'nowhere'"):
        patched_source("equations/offsets.py", [("nowhere", "")])
    with pytest.raises(ValueError, match="times, expected once: 'l_a'"):
        patched_source("equations/offsets.py", [("l_a", "")])


def test_another_patch_is_not_taken_for_the_mistake():
    mistakes = {mistake.id: mistake for mistake in MISTAKES}
    for id, other in (
        ("offsets-log-gradient", "offsets-mean-gradient"),
        ("ssim-box", "ssim-constants"),
        ("rounding-half-away", "rounding-half-up"),
    ):
        with pytest.raises(AssertionError, match="case ordinary|case ties"):
            test_doctor_and_patch_agree(mistakes[id]._replace(run=mistakes[other].run))


def test_restored_after_an_error():
    for id in ("ssim-box", "ssim-renormalised", "deformed-product"):
        with pytest.raises(RuntimeError, match="in between"), patched(id):
            raise RuntimeError("in between")
        key = id.split("-")[0]
        for name, inputs, cotangents, right in questions(key):
            assert not difference(of_code(SUBJECTS[key].eq, inputs, cotangents), right), (id, name)
