"""A checker's report: as text for a person, as JSON for continuous integration."""

import json
from collections import Counter

from .published import GROUPS, subjects

SHOWN = 8  # names of failing cases of a subject, at most
REASONS = 3  # explanations of a subject, at most
FEWER = "right formula, fewer digits here; the recipe is"


def name_of(equation):
    """Return `Eq. (11) likelihood`, `D1 activations`, or the key alone where there is no number."""
    subject = subjects().get(equation, {"number": ""})
    if "group" in subject:
        return f"{subject['number']} {equation}"
    return f"Eq. ({subject['number']}) {equation}" if subject["number"][:1].isdigit() else equation


def text(report):
    """Return the scores, the first divergence with its explanation, and what else failed."""
    results, lines = report.results, []
    for level, row in report.levels().items():
        also = f", {row['acceptable']} acceptable" if row["acceptable"] else ""
        lines.append(f"{f'{level} ' + row['says']:<18} {row['passed']:>4} of {row['of']}{also}")
    asked = {_subject(r) for r in results if r.required}
    for group in GROUPS:
        left = len({_subject(r) for r in results if r.group == group} - asked)
        if left:
            lines.append(f"{group}: {left} equation{'s' * (left > 1)} left out, which is allowed")
    left = sum(r.level == "L3" and not r.required for r in results)
    if left:
        lines.append(f"version 2: {left} streams left out, which is allowed")
    unasked = sum(r.verdict == "unasked" for r in results)
    tensors = sum(len(r.unasked) for r in results if r.verdict != "unasked")
    if unasked or tensors:
        also = f" and {tensors} tensors of other cases" if tensors else ""
        lines.append(f"{unasked} cases{also} are not checked in this precision")
    acceptable = [r for r in results if r.verdict == "acceptable"]
    for recipe in dict.fromkeys(r.recipe for r in acceptable):
        ids = ", ".join(r.id for r in acceptable if r.recipe == recipe)
        why = f"{FEWER}: {recipe}" if recipe else "another answer is defensible here"
        lines += [f"acceptable: {ids}", f"  {why}"]
    first = report.first
    if first:
        lines += ["", f"first divergence: {name_of(first.equation)}", *_case(first)]
        lines += _others([r for r in results if r.wrong and r is not first], first.explanation)
    else:
        how = "passes or is acceptable" if any(r.required for r in acceptable) else "passes"
        lines.append(f"every required case {how}" if report.ok else "no required case was run")
    return "\n".join(lines)


def _subject(result):
    return result.id.split("/")[0]


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
    if result.recipe:
        return FEWER, result.recipe
    return "explained by" if result.findings else "because", result.explanation


def _others(results, known):
    """Return what fails besides the first case, a line or two a subject."""
    lines = ["", f"{len(results)} more fail:"] if results else []
    for key in dict.fromkeys(map(_subject, results)):
        rows = [r for r in results if _subject(r) == key]
        names = [r.id.split("/")[1] for r in rows if r.verdict == "fail"]
        more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        counts = Counter(sorted(r.verdict for r in rows if r.verdict != "fail"))
        said = [", ".join(names[:SHOWN]) + more] * bool(names)
        said += [f"{count} {verdict}" for verdict, count in counts.items()]
        lines.append(f"  {key}: {'; '.join(said)}")
        reasons = Counter(_reason(r) for r in rows if _reason(r)[1])
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
            "recipe": r.recipe or None,
            "unasked": list(r.unasked),
        }
        for r in report.results
    ]
    value = {
        "ok": report.ok,
        "levels": report.levels(),
        "cases": cases,
        "first_divergence": report.first.equation if report.first else None,
    }
    return json.loads(json.dumps(value), parse_constant=lambda _: None)


def _worst(findings):
    worst = max(findings, key=lambda f: -1 if f.scaled is None else f.scaled, default=None)
    return worst._asdict() if worst else {}


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
