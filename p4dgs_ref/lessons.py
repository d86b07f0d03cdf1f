"""What the tutorials share: claims, checks of gradients, and exercises that check themselves."""

import json
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from .splatting.table import EQUATIONS


class Tutorial(NamedTuple):
    """One file of tutorials/, and the keys of the equations that it explains."""

    name: str
    keys: tuple


# The tutorials in their order, and the equations that they explain.
TUTORIALS = [
    Tutorial(name, tuple(keys.split()))
    for name, keys in {
        "01_offsets": "offsets",
        "02_view": "view",
        "03_opacity_and_masking": "opacity masking mlp",
        "04_color_rotation_scale": "color rotation scale",
        "05_positional_encoding_and_deformation": "positional_encoding deformation",
        "06_deformed": "deformed",
        "07_noise_and_rounding": "noise rounding",
        "08_step": "step",
        "09_hash_grid": "hash_grid",
        "10_prior_and_likelihood": "likelihood prior",
        "11_rate": "anchor_rate hash_rate rate_loss",
        "12_rate_distortion": "total_loss",
        "13_covariance": "covariance",
        "14_projection": "projection",
        "15_compositing": "compositing",
        "16_render_loss": "render_loss ssim",
        "17_pipeline_by_hand": "",
        "18_four_stages": "",
        "19_one_training_step": "",
        "20_file_byte_by_byte": "",
        "21_intervals_to_rans": "",
        "22_desync": "",
        "23_accuracy_versus_time": "",
        "24_hard_cases": "",
        "25_effects": "",
        "26_porting_in_an_afternoon": "",
    }.items()
]
ROUNDING_TOLERANCE = 1e-6  # of a number: a smaller error comes from rounding, not from the formula
NEAR_TOLERANCE = 0.01  # of a number: an answer with a smaller error is nearly right
# Factors between a wrong answer and the right one that a message names, because they do not give
# the answer away.
TELLING_FACTORS = (
    *(0, 0.5, 1, 2),
    *(8, 1 / 8),  # bits and bytes
    *(1 / np.log(2), np.log(2)),  # bits and nats
    *(180 / np.pi, np.pi / 180),  # degrees and radians
    *(100, 1 / 100),  # per cent and shares
    *(1000, 1 / 1000),  # thousandths
)
RESULTS = {}  # exercise -> whether it is solved, for tests that run a tutorial or its solutions
HINTS_GIVEN = {}  # exercise -> how many hints were asked for


def oracle():
    """Return the module p4dgs_ref.oracle, imported on first use; most cells do not need it."""
    from . import oracle

    return oracle


def tutorial_of(key):
    """Return the tutorial that explains an equation."""
    for tutorial in TUTORIALS:
        if key in tutorial.keys:
            return tutorial
    raise KeyError(f"{key!r}: no tutorial in TUTORIALS of p4dgs_ref/lessons.py explains it")


# --- the checkout ---------------------------------------------------------------------------------
def find_tools():
    """Let the running tutorial import `tutorials.tools`, which only a checkout has."""
    for folder in folder_of_tutorial().parents:
        if (folder / "tutorials" / "tools").is_dir():
            sys.path.append(str(folder))


def folder_of_tutorial():
    """Return the folder of the running tutorial, or of its notebook."""
    script = Path(sys.argv[0]).resolve().parent
    return script if script.name in ("tutorials", "solutions") else Path.cwd()


# --- checks of gradients --------------------------------------------------------------------------
def random_like(rng, values):
    """Return normal random numbers in the shape of an array, a list of arrays or a dictionary."""
    if isinstance(values, dict):
        return {name: random_like(rng, value) for name, value in values.items()}
    if isinstance(values, list):
        return [random_like(rng, value) for value in values]
    return rng.normal(size=np.shape(values))


def shift(values, directions, h):
    """Return values + h * directions, for an array, a list of arrays or a dictionary.

    Entries of a dictionary that have no direction stay as they are.
    """
    if isinstance(values, dict):
        return values | {name: shift(values[name], d, h) for name, d in directions.items()}
    if isinstance(values, list):
        return [shift(value, d, h) for value, d in zip(values, directions)]
    return values + h * directions


def inner(a, b):
    """Return the sum of all products of entries; of dictionaries, over the names in b."""
    if isinstance(b, dict):
        return sum(inner(a[name], b[name]) for name in b)
    if isinstance(b, (list, tuple)):
        return sum(inner(x, y) for x, y in zip(a, b))
    return float(np.sum(a * b))


def close(a, b, tolerance=1e-12):
    """Return whether a and b agree, up to a fraction of the largest number in b."""
    off = np.abs(np.asarray(a) - b).max(initial=0)
    return bool(off <= tolerance * np.abs(b).max(initial=0))


def adjoint(rng, forward, inputs, cotangents, gradients, tolerance=1e-7):
    """Check gradients by the adjoint identity along a random direction of all `inputs`.

    `forward(**inputs)` returns a pair whose first part is outputs in the form of `cotangents`.
    Returns the direction, and the change of the loss along it by differences.
    """
    d, h = random_like(rng, inputs), 1e-6
    up, down = (inner(forward(**shift(inputs, d, step))[0], cotangents) for step in (h, -h))
    difference, gradient = (up - down) / (2 * h), inner(gradients, d)
    print(f"by differences {difference:.9f}, by gradient {gradient:.9f}")
    assert close(difference, gradient, tolerance)
    return d, difference


# --- checks of ports ------------------------------------------------------------------------------
def passes(*keys, port=None):
    """Check equations of this project, or a port of one, with the golden vectors; print the report.

    The gradients of this project's equations are checked as well.
    """
    for key in keys:
        vjp = None if port else lambda inputs, bars: EQUATIONS[key].vjp(**inputs)[1](**bars)
        report = oracle().check(port or EQUATIONS[key], key, vjp)
        print(report)
        assert report.ok


def check_mistake(mistaken, key, *says, vjp=None):
    """Check that a port with a mistake fails; print where and why, which contains all of `says`."""
    first = oracle().check(mistaken, key, vjp).first
    assert first, f"{key}: the mistake is not noticed"
    message = f"{first.id} fails: {first.explanation or first.hint or first.findings[0].message}"
    print(message)
    assert all(words in message for words in says), message


# --- exercises ------------------------------------------------------------------------------------
def golden(id):
    """Return the tensors of one case of the golden vectors: golden("offsets/ordinary")["out.x"]."""
    cases = {case.id: case for case in oracle().published.cases(id.partition("/")[0])}
    if id not in cases:
        raise KeyError(f"{id!r}: expected one of {', '.join(cases)}")
    return cases[id].tensors


def check_number(exercise, mine, want=None, digits=6):
    """Check an exercise whose answer is a number or an array; Ellipsis stands for no answer.

    Whole numbers must be equal; others need as many right digits as `digits` says. Without `want`,
    the answer is compared with the one that is stored for the exercise.
    """
    want = np.asarray(read_stored("answers")[exercise] if want is None else want)
    try:
        mine = np.asarray(mine, float)
    except (TypeError, ValueError, OverflowError):
        return settle(exercise, "no answer yet" if mine is ... else "expected a number")
    if mine.shape != want.shape:
        shapes = f"{list(mine.shape)}, expected {list(want.shape)}"
        return settle(exercise, f"shape {shapes}; [] means a single number")
    near, smallest = (0, 0) if is_whole(want) else (NEAR_TOLERANCE, 10.0**-digits)
    right = np.isclose(mine, want, 0, smallest * np.abs(want).max(initial=0))
    if right.all():
        return settle(exercise, "")
    first = tuple(np.argwhere(~right)[0].tolist())
    example = f"; the first, {list(first)}: {difference(mine[first], want[first])}"
    for wrong, reason in read_stored("mistakes").get(exercise, ()):
        if mine.shape == np.shape(wrong) and np.isclose(mine, wrong, near / 10, 0).all():
            return settle(exercise, reason)
    if np.isclose(mine, want, near, 0).all():
        return settle(exercise, f"nearly right, but {digits} right digits are expected")
    return settle(exercise, difference(mine, want, example))


def exercise_cases(key):
    """Return the published cases of an equation that exercises use.

    Without rows, a right `y.reshape(len(y), -1, 3)` fails, so those cases are left to ports.
    """
    return [c for c in oracle().published.cases(key) if "empty" not in c.record["flags"]]


def check_forward(exercise, mine, key):
    """Check a forward: `mine(**inputs)` returns one array, a tuple or a dictionary of outputs."""
    cases = exercise_cases(key)
    names = dict.fromkeys(n.split(".")[1] for n in cases[0].tensors if n.startswith("out."))
    port = oracle().FunctionPort(lambda **inputs: outputs_of(mine(**inputs), names))
    settle(exercise, *problem(cases, port, ("out.",)))


def check_backward(exercise, mine, key, *wanted):
    """Check a backward: `mine(inputs, cotangents)` returns {input name: gradient}.

    `wanted` names the gradients to check; without it all are checked.
    """

    def vjp(inputs, cotangents):
        answer = mine(inputs, cotangents)
        return gradients_of(answer, wanted or answer)

    roles = tuple(f"in_bar.{name}" for name in wanted or [""])
    cases, port = exercise_cases(key), oracle().FunctionPort(lambda **_: {}, vjp)
    settle(exercise, *problem(cases, port, roles))


def settle(exercise, problem, waived=""):
    """Record and print whether an exercise is solved; `waived` names faults that do not count."""
    RESULTS[exercise] = not problem
    message = "no answer yet" if "NotImplementedError" in problem else problem
    offer = f'\n  lessons.hint("{exercise}") gives a hint'
    print(
        f"exercise {exercise}: {f'not solved: {message}{offer}' if problem else 'solved'}{waived}"
    )


def hint(exercise):
    """Print the first hint on an exercise and, when called again, the second one."""
    hints = read_stored("hints")[exercise]
    HINTS_GIVEN[exercise] = min(HINTS_GIVEN.get(exercise, 0) + 1, len(hints))
    print(f"hint {HINTS_GIVEN[exercise]} of {len(hints)}: {hints[HINTS_GIVEN[exercise] - 1]}")


@cache
def read_stored(name):
    """Return what is stored by exercise: `answers`, `hints`, or typical `mistakes`."""
    return json.loads(Path(__file__).with_name(f"{name}.json").read_text(encoding="utf-8"))


# --- what is wrong with an answer -----------------------------------------------------------------
class WrongForm(TypeError):
    """An answer that does not have the requested form. The message is one sentence."""


def outputs_of(answer, names):
    """Return what a forward returned as {name: value}. Raises WrongForm for too few or too many."""
    if isinstance(answer, dict):
        return answer
    outputs = answer if isinstance(answer, tuple) else (answer,)
    if len(outputs) != len(names):
        asked = "the output" if len(names) == 1 else f"a tuple of {len(names)} outputs,"
        got = f"{len(outputs)} of type {type(answer).__name__}"
        raise WrongForm(f"expected {asked} {', '.join(names)}, got {got}")
    return dict(zip(names, outputs))


def gradients_of(answer, names):
    """Return those gradients of a backward that are in `names`. Raises WrongForm."""
    if not isinstance(answer, dict):
        raise WrongForm(
            f"expected a dictionary {{input name: gradient}}, got {type(answer).__name__}"
        )
    return {name: answer[name] for name in names if name in answer}


@np.errstate(all="ignore")
def problem(cases, port, roles):
    """Return what is wrong with a port in its first wrong case, and which faults do not count.

    Each is "" if there is none. The checker sees the answers to all cases and names a mistake that
    it knows. Where only gradients are asked for, outputs count as right.
    """
    answers = {}  # the judged ones; asked again, a port may answer something else

    def run(case):
        right = case.tensors.items() if "out." not in roles else ()
        outputs = {name: a for name, a in right if name.startswith("out.")}
        return answers.setdefault(case.id, outputs | port.run(case))

    checker = oracle().checker
    kept = SimpleNamespace(run=run, asked=("out.", *roles))
    report = checker.Report(checker.check_subject(cases, kept))
    first, spared = report.first, [r.id for r in report.results if r.recipe or r.not_judged]
    if first is None:
        recipe = checker.RECIPES.get(cases[0].subject)
        return "", f", but digits are lost in {', '.join(spared)}: {recipe}" if spared else ""
    if not first.findings:
        message = f"{first.verdict} in {first.id}: {first.explanation}"
        return message.rpartition(f"{WrongForm.__name__}: ")[2], ""
    finding, known = first.findings[0], first.explanation or first.hint
    role, name = finding.tensor.split(".", 1)
    message = f" ({finding.kind}): {finding.message}"
    if finding.kind == "value":
        case = next(case for case in cases if case.id == first.id)
        mine, right = answers[case.id][finding.tensor], case.tensors[finding.tensor]
        place = finding.message.partition(" (")[0]
        message = f": {difference(mine, right)}\n  Case {case.id}: {place}"
    if known:
        message += f"\n  It looks like this: {known}"
    return f"{'the output' if role == 'out' else 'the gradient of'} {name}{message}", ""


@np.errstate(all="ignore")
def difference(mine, right, example=""):
    """Return how an array differs from the right one of the same shape.

    For a single number only factors in TELLING_FACTORS are named; others would give the answer
    away. `example` is added if the errors of several numbers have nothing in common.
    """
    near, rounding = (0, 0) if is_whole(right) else (NEAR_TOLERANCE, ROUNDING_TOLERANCE)
    wrong = ~np.isclose(mine, right, rounding, 0)
    not_finite = np.argwhere(np.isfinite(right) & ~np.isfinite(mine))[:1].tolist()
    exact = right.astype(float)  # sums of squares of small integers would overflow
    factor = np.vdot(exact, mine) / np.vdot(exact, exact)
    some = f"{wrong.sum()} of {right.size} numbers"
    if not_finite:
        (place,) = not_finite
        return f"{place or 'it'} is {mine[tuple(place)]}"
    if not wrong.any():
        return "too few right digits"
    if np.isclose(mine, right, near, 0).all():
        return "nearly right"
    if right.size == 1 and np.isclose(abs(factor), TELLING_FACTORS, near, 0).any():
        return f"it is {factor:.3g} times the right number"
    if right.size == 1 and np.isfinite(factor):
        sign = "right" if factor > 0 else "wrong"
        size = "large" if abs(factor) > 1 else "small"
        return f"it is wrong: its sign is {sign}, its magnitude too {size}"
    if right.size == 1:
        return "it is wrong"
    if np.isclose(mine, factor * right, rounding, 0).all():
        return f"all {right.size} numbers are {factor:.6g} times the right ones"
    if np.isclose(np.abs(mine), np.abs(right), rounding, 0).all():
        return f"{some} have the wrong sign"
    return f"{some} are wrong{example}"


def is_whole(right):
    """Return whether the right numbers are integers, for which no answer is nearly right."""
    return right.dtype.kind in "iub"
