"""A checker's report as text for a person and as JSON for continuous integration."""

import json

from ..equations import EQUATIONS

SHOWN, REASONS = 8, 3  # names and explanations of failing cases, at most, a subject


def name_of(equation):
    """`Eq. (11) likelihood`, or the name alone where the paper prints no number."""
    eq = EQUATIONS.get(equation)
    return f"Eq. ({eq.number}) {equation}" if eq and eq.number[:1].isdigit() else equation


def text(report):
    """Credit by level, the first divergence and its explanation, then what else failed."""
    lines = [
        f"{level} {row['says']:<15} {row['passed']:>4} of {row['of']}"
        for level, row in report.levels().items()
    ]
    unasked, may = (sum(r.verdict == v for r in report.results) for v in ("unasked", "acceptable"))
    if unasked:
        lines.append(f"{unasked} cases are not asked in this precision")
    if may:
        lines.append(f"{may} cases differ where another answer is acceptable")
    if report.strangers:
        lines.append(
            f"{len(report.strangers)} tensors belong to no case: {', '.join(report.strangers[:SHOWN])}"
        )
    first = report.first
    if first is None:
        return "\n".join(
            lines + ["every required case passes" if report.ok else "no required case was run"]
        )
    lines += ["", f"first divergence: {name_of(first.equation)}", *_case(first)]
    return "\n".join(
        lines
        + _others([r for r in report.results if r.wrong and r is not first], first.explanation)
    )


def _others(results, known):
    """What fails besides the first case, a line or two a subject."""
    lines = ["", f"{len(results)} more fail:"] if results else []
    for key in dict.fromkeys(r.id.split("/")[0] for r in results):
        rows = [r for r in results if r.id.split("/")[0] == key]
        names = [r.id.split("/")[1] for r in rows if r.verdict == "fail"]
        said = ", ".join(names[:SHOWN]) + (
            f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        )
        counts = [
            f"{sum(r.verdict == v for r in rows)} {v}"
            for v in sorted({r.verdict for r in rows} - {"fail"})
        ]
        lines.append(f"  {key}: " + "; ".join([said] * bool(said) + counts))
        why = dict.fromkeys((bool(r.findings), r.explanation) for r in rows if r.explanation)
        lines += [
            f"    {'explained by' if found else 'because'}: {said if said != known else 'the same'}"
            for found, said in list(why)[:REASONS]
        ]
        lines += [f"    and {len(why) - REASONS} more reasons"] if len(why) > REASONS else []
    return lines


def _case(result):
    lines = [f"  {result.id}: {result.verdict}"]
    lines += [
        f"    {f.tensor}: {f.kind}: {f.message}" if f.kind != "value" else f"    {f.message}"
        for f in result.findings
    ]
    if result.explanation:
        what = "explained by" if result.findings else "because"
        lines.insert(1, f"    {what}: {result.explanation}")
    return lines


def as_json(report):
    """The contract for scripts: {"levels", "cases", "first_divergence"}; null where a number is not finite."""
    cases = [
        {
            "id": r.id,
            "equation": r.equation,
            "level": r.level,
            "verdict": r.verdict,
            "required": r.required,
            "worst": _worst(r.findings),
            "explanation": r.explanation or None,
        }
        for r in report.results
    ]
    value = {
        "ok": report.ok,
        "levels": report.levels(),
        "cases": cases,
        "strangers": list(report.strangers),
        "first_divergence": report.first.equation if report.first else None,
    }
    return json.loads(json.dumps(value), parse_constant=lambda _: None)


def _worst(findings):
    if not findings:
        return {}
    worst = max(findings, key=lambda f: -1 if f.scaled is None else f.scaled)
    return {**worst._asdict(), "index": list(worst.index)}


def listing(manifest):
    """Every case in a line: id, level, result class, what it tests."""
    rows = [
        (case["id"], subject["level"], case["result"], case["tests"])
        for subject in manifest["subjects"]
        for case in subject["cases"]
    ]
    rows += [
        (stream["id"], "L3", stream["result"], stream["says"]) for stream in manifest["streams"]
    ]
    width = max(len(row[0]) for row in rows)
    return "\n".join(
        f"{id:<{width}}  {level}  {result:<10}  {tests}" for id, level, result, tests in rows
    )
