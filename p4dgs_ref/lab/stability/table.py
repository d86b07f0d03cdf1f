"""The table of hard cases: literal formula, ours, true value, errors, verdict."""

from .cases import hard_cases
from .judge import measure, number

DTYPES = ("float64", "float32")


def rows(only=None, report=lambda row: None):
    """Run all cases in both precisions, or only the case or the group of cases `only`.

    Return a list of dictionaries for JSON with id, equation, says, dtype, literal, ours, true,
    error, grad_error, bound, grad_bound and verdict. Infinities and NaN are text; the error of a
    gradient is None where there is no gradient.
    """
    found = []
    for case in hard_cases().values():
        if only is not None and only != case.id and not case.id.startswith(only + "."):
            continue
        about = {"id": case.id, "equation": case.equation, "says": case.says}
        for dtype in DTYPES:
            found.append({**about, "dtype": dtype, **judged(measure(case, dtype))})
            report(found[-1])
    return found


def judged(measured):
    """The fields of a Measured and its verdict. An error that is NaN fails."""
    good = measured.error <= measured.bound
    if measured.grad_error is not None:
        good = good and measured.grad_error <= measured.grad_bound
    errors = {name: number(getattr(measured, name)) for name in ("error", "grad_error")}
    return {**measured._asdict(), **errors, "verdict": "ok" if good else "fails"}


def describe(rows):
    """The table as text, and at the end the rows that fail."""
    lines = [
        f"{'case':26} {'equation':20} {'dtype':8} {'literal':>16} {'ours':>16} {'true':>16} "
        f"{'error':>8} {'gradient':>8}  verdict"
    ]
    for row in rows:
        numbers = " ".join(_shown(row[name]) for name in ("literal", "ours", "true"))
        errors = " ".join(_error(row[name]) for name in ("error", "grad_error"))
        about = f"{row['id']:26} {row['equation']:20} {row['dtype']:8}"
        lines.append(f"{about} {numbers} {errors}  {row['verdict']}")
    failed = [f"  {row['id']} {row['dtype']}" for row in rows if row["verdict"] == "fails"]
    lines += ["", f"{len(rows)} rows, {len(failed)} beyond their bounds", *failed]
    return "\n".join(lines)


def _shown(value):
    """A value in 16 characters."""
    text = f"{value:.8g}" if isinstance(value, float) else str(value)
    return f"{text if len(text) <= 16 else text[:15] + '~':>16}"


def _error(value):
    """An error in 8 characters."""
    text = f"{value:.1e}" if isinstance(value, float) else value or ""
    return f"{text:>8}"
