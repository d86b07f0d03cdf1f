"""A checker's report: text for a person, JSON for continuous integration."""

import json
from collections import Counter

from ..version import __version__
from .published import read_manifest, stream_rows, subjects

MAX_LISTED = 8  # failing cases of a subject, wrong tensors of a case
RECIPE_HEAD = "right formula, fewer digits here; the recipe is"


def name_of(equation):
    """Return `Eq. (11) likelihood`, or the key alone if there is no number."""
    number = subjects().get(equation, {"number": ""})["number"]
    return f"Eq. ({number}) {equation}" if number else equation


def text(report):
    """Return the scores, what was not judged, the first divergence, and what else failed."""
    return "\n".join(
        line
        for section in (
            score_lines,
            lacking_lines,
            left_out_lines,
            not_judged_lines,
            acceptable_lines,
            divergence_lines,
        )
        for line in section(report)
    )


def score_lines(report):
    """Yield a line for every level and group with required cases."""
    for level, row in report.levels().items():
        also = f", {row['acceptable']} acceptable" if row["acceptable"] else ""
        yield f"{f'{level} ' + row['says']:<18} {row['passed']:>4} of {row['of']}{also}"


def lacking_lines(report):
    """Yield what the port said in its first line that it lacks."""
    absent = Counter(r.subject for r in report.results if r.verdict == "absent")
    if report.says.get("gradients") is False:
        yield "the port gives no gradients: only outputs were judged"
    if absent:
        yield f"the port lacks {', '.join(absent)}; cases not asked: {absent.total()}"


def left_out_lines(report):
    """Return a line for every level or group of which the port leaves out cases, as it may."""
    left = Counter(
        r.group or r.level
        for r in report.results
        if not r.required and r.verdict in ("skipped", "missing")
    )
    return [f"{name}: cases left out, which is allowed: {count}" for name, count in left.items()]


def not_judged_lines(report):
    """Yield a line with the cases and tensors for which no bound catches wrong answers."""
    results = [r for r in report.results if r.not_judged or r.verdict == "not_judged"]
    names = [
        r.id if r.verdict == "not_judged" else f"{r.id} ({', '.join(r.not_judged)})"
        for r in results
    ]
    if names:
        yield f"not judged, because a wrong answer would pass too: {', '.join(names)}"
    for recipe in filter(None, dict.fromkeys(r.recipe for r in results)):
        yield f"  what keeps the digits: {recipe}"


def acceptable_lines(report):
    """Yield the cases that are acceptable, by the reason."""
    results = [r for r in report.results if r.verdict == "acceptable"]
    for recipe in dict.fromkeys(r.recipe for r in results):
        yield f"acceptable: {', '.join(r.id for r in results if r.recipe == recipe)}"
        yield f"  {RECIPE_HEAD}: {recipe}" if recipe else "  another answer is defensible here"


def divergence_lines(report):
    """Yield the first wrong case with its explanation, then a line or two per subject."""
    first, required = report.first, [r.verdict for r in report.results if r.required]
    if first:
        yield from ("", f"first divergence: {name_of(first.equation)}")
        yield from _case(first)
        yield from _others(
            [r for r in report.results if r.wrong and r is not first], first.explanation
        )
    elif report.ok:
        how = "passes or is acceptable" if "acceptable" in required else "passes"
        yield f"every required case {how}"
    else:
        yield "no required case was run"


def _case(result):
    head, reason = _reason(result)
    yield f"  {result.id}: {result.verdict}"
    if reason:
        yield f"    {head}: {reason}"
    for finding in result.findings[:MAX_LISTED]:
        yield f"    {_difference(result, finding)}"
    if len(result.findings) > MAX_LISTED:
        yield f"    and {len(result.findings) - MAX_LISTED} more tensors"


def _difference(result, finding):
    """Return what is wrong with a tensor and, if there is one for every step, after which."""
    text = finding.message
    if finding.kind != "value":
        text = f"{finding.tensor}: {finding.kind}: {text}"
    is_of_step = result.subject.endswith("_steps") and finding.kind != "extra"
    return f"after step {int(finding.tensor.split('.')[2]) + 1}: {text}" if is_of_step else text


def _reason(result):
    """Return why a case fails, as far as is known, and how that is introduced."""
    if result.hint:
        return "hint", result.hint
    if result.recipe:
        return RECIPE_HEAD, result.recipe
    is_diagnosis = result.findings and result.subject != "codec"
    return "explained by" if is_diagnosis else "because", result.explanation


def _others(results, known):
    """Yield what fails besides the first case."""
    if results:
        yield from ("", f"others that fail ({len(results)}):")
    for key in dict.fromkeys(r.subject for r in results):
        rows = [r for r in results if r.subject == key]
        names = [
            r.id.split("/")[1] + ("" if r.verdict == "fail" else f" ({r.verdict})") for r in rows
        ]
        more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
        yield f"  {key}: {', '.join(names[:MAX_LISTED])}{more}"
        for head, reason in dict.fromkeys(map(_reason, rows)):
            if reason:
                yield f"    {head}: {'the same' if reason == known else reason}"


def as_json(report):
    """Return the report for scripts. A number that is not finite becomes null."""
    cases = [
        {
            "id": r.id,
            "equation": r.equation,
            "level": r.level,
            "verdict": r.verdict,
            "required": r.required,
            "first": r.findings[0].tensor if r.findings else None,
            "worst": _worst(r.findings),
            "explanation": r.explanation or None,
            "hint": r.hint or None,
            "recipe": r.recipe or None,
            "not_judged": list(r.not_judged),
        }
        for r in report.results
    ]
    value = {
        "ok": report.ok,
        "levels": report.levels(),
        "cases": cases,
        "versions": {"p4dgs_ref": __version__, "vectors": read_manifest()["version"]},
        "dtype": report.dtype,
        "strict": report.strict,
        "first_divergence": report.first.equation if report.first else None,
        "gradients": report.says.get("gradients") is not False,
        "lacking": list(dict.fromkeys(r.subject for r in report.results if r.verdict == "absent")),
    }
    return json.loads(json.dumps(value), parse_constant=lambda _: None)


def _worst(findings):
    worst = max(findings, key=lambda f: -1 if f.scaled is None else f.scaled, default=None)
    return worst._asdict() if worst else {}


def listing(manifest):
    """Return a line for every case: id, level, result class, what it tests."""
    rows = [
        *(
            (case["id"], subject["level"], case["result"], case["tests"])
            for subject in manifest["subjects"]
            for case in subject["cases"]
        ),
        *((row["id"], "L3", row["result"], row["says"]) for row in stream_rows()),
    ]
    width = max(len(row[0]) for row in rows)
    return "\n".join(
        f"{id:<{width}}  {level}  {kind:<10}  {says}" for id, level, kind, says in rows
    )
