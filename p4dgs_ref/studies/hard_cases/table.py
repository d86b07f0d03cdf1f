"""The table of hard cases: literal formula, ours, true value, errors, verdict; for people, and as JSON."""

from .catalogue import ENTRIES
from .entry import DTYPES


def rows(only=None, report=lambda row: None):
    """Run the catalogue, or the one entry `only` or those whose id begins with it up to a dot, in both precisions.

    Returns    [{id, equation, says, dtype, literal, ours, true, error, grad_error, bound, grad_bound, verdict}, ...];
               numbers that JSON does not have are text, a gradient error where there is no gradient is null
    """
    found = []
    for id, entry in ENTRIES.items():
        if only is not None and only != id and not id.startswith(only + "."):
            continue
        for dtype in DTYPES:
            found.append(
                {
                    "id": id,
                    "equation": entry.equation,
                    "says": entry.says,
                    "dtype": dtype,
                    **_judged(entry.measure(dtype)),
                }
            )
            report(found[-1])
    return found


def _judged(measured):
    """The fields of a Measured and its verdict: an error that is not a number fails too."""
    within = measured.error <= measured.bound and (
        measured.grad_error is None or measured.grad_error <= measured.grad_bound
    )
    finite = lambda error: error if error is None or abs(error) < float("inf") else str(error)
    return {
        **measured._asdict(),
        "error": finite(measured.error),
        "grad_error": finite(measured.grad_error),
        "verdict": "ok" if within else "fails",
    }


def describe(rows):
    """The table as text, a line a row, what fails last as well."""
    lines = [
        f"{'case':26} {'equation':20} {'dtype':8} {'literal':>16} {'ours':>16} {'true':>16} {'error':>8} "
        f"{'gradient':>8}  verdict"
    ]
    lines += [
        f"{row['id']:26} {row['equation']:20} {row['dtype']:8} {_shown(row['literal'])} {_shown(row['ours'])} "
        f"{_shown(row['true'])} {_error(row['error'])} {_error(row['grad_error'])}  {row['verdict']}"
        for row in rows
    ]
    failed = [f"{row['id']} {row['dtype']}" for row in rows if row["verdict"] == "fails"]
    return "\n".join(
        [
            *lines,
            "",
            f"{len(rows)} rows, {len(failed)} beyond their "
            "bounds" + "".join(f"\n  {name}" for name in failed),
        ]
    )


def _shown(value):
    text = f"{value:.8g}" if isinstance(value, float) else str(value)
    return f"{text if len(text) <= 16 else text[:15] + '~':>16}"


def _error(value):
    return f"{'' if value is None else f'{value:.1e}' if isinstance(value, float) else value:>8}"
