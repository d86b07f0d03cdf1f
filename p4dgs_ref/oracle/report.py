"""A checker's report: as text for a person, as JSON for continuous integration."""

import json
from collections import Counter

from .published import subjects

SHOWN = 8  # names of failing cases of a subject, at most
REASONS = 3  # explanations of a subject, at most


def name_of(equation):
    """Return `Eq. (11) likelihood`, or the key alone where the paper prints no number."""
    subject = subjects().get(equation)
    numbered = subject is not None and subject["number"][:1].isdigit()
    return f"Eq. ({subject['number']}) {equation}" if numbered else equation


def text(report):
    """Return the scores, the first divergence with its explanation, and what else failed."""
    lines = [
        f"{level} {row['says']:<15} {row['passed']:>4} of {row['of']}"
        for level, row in report.levels().items()
    ]
    verdicts = [r.verdict for r in report.results]
    if "unasked" in verdicts:
        lines.append(f"{verdicts.count('unasked')} cases are not checked in this precision")
    if "acceptable" in verdicts:
        count = verdicts.count("acceptable")
        lines.append(f"{count} cases differ, but allow other answers")
    if report.strangers:
        names = ", ".join(report.strangers[:SHOWN])
        lines.append(f"{len(report.strangers)} tensors belong to no case: {names}")
    first = report.first
    if first is None:
        lines.append("every required case passes" if report.ok else "no required case was run")
        return "\n".join(lines)
    lines += ["", f"first divergence: {name_of(first.equation)}", *_case(first)]
    others = [r for r in report.results if r.wrong and r is not first]
    return "\n".join(lines + _others(others, first.explanation))


def _case(result):
    lines = [f"  {result.id}: {result.verdict}"]
    head, said = _reason(result)
    if said:
        lines.append(f"    {head}: {said}")
    for finding in result.findings:
        head = "" if finding.kind == "value" else f"{finding.tensor}: {finding.kind}: "
        lines.append(f"    {head}{finding.message}")
    return lines


def _reason(result):
    """Return why a case fails, as far as is known, and how that is introduced."""
    if result.hint:
        return "hint", result.hint
    return "explained by" if result.findings else "because", result.explanation


def _others(results, known):
    """Return what fails besides the first case, a line or two a subject."""
    lines = ["", f"{len(results)} more fail:"] if results else []
    by_subject = {}
    for result in results:
        by_subject.setdefault(result.id.split("/")[0], []).append(result)
    for key, rows in by_subject.items():
        names = [r.id.split("/")[1] for r in rows if r.verdict == "fail"]
        said = ", ".join(names[:SHOWN])
        if len(names) > SHOWN:
            said += f" and {len(names) - SHOWN} more"
        verdicts = [r.verdict for r in rows if r.verdict != "fail"]
        counts = [f"{verdicts.count(v)} {v}" for v in sorted(set(verdicts))]
        lines.append(f"  {key}: " + "; ".join([said] * bool(names) + counts))
        reasons = Counter(_reason(r) for r in rows if r.explanation or r.hint)
        for (head, said), count in list(reasons.items())[:REASONS]:
            where = f" ({count} of these)" if count < len(rows) else ""
            lines.append(f"    {head}{where}: {'the same' if said == known else said}")
        if len(reasons) > REASONS:
            lines.append(f"    and {len(reasons) - REASONS} more reasons")
    return lines


def as_json(report):
    """Return the report for scripts. A number that is not finite becomes null."""
    cases = [
        {
            "id": r.id,
            "equation": r.equation,
            "level": r.level,
            "verdict": r.verdict,
            "required": r.required,
            "worst": _worst(r.findings),
            "explanation": r.explanation or None,
            "hint": r.hint or None,
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
    """Return a line for every case: id, level, result class, what it tests."""
    rows = [
        (case["id"], subject["level"], case["result"], case["tests"])
        for subject in manifest["subjects"]
        for case in subject["cases"]
    ]
    rows += [(row["id"], "L3", row["result"], row["says"]) for row in manifest["streams"]]
    width = max(len(row[0]) for row in rows)
    return "\n".join(
        f"{id:<{width}}  {level}  {kind:<10}  {says}" for id, level, kind, says in rows
    )
