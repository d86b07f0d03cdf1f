"""What the commands of the three studies do: accuracy against time, hard cases, effects."""

from contextlib import nullcontext
from pathlib import Path

from ..scenes.output import filled
from .base import Line, UsageError, show


def accuracy(arguments):
    from ..studies.accuracy.report import STUDIES, describe, run, summary

    if arguments.summary:
        if arguments.only or arguments.quick:
            raise UsageError("--summary: expected without --only and --quick, it has its own size")
        rows, lines = summary()
        return show(arguments, {"settings": rows}, lines)
    if unknown := [name for name in arguments.only if name not in STUDIES]:
        raise UsageError(f"--only {unknown[0]}: expected one of {', '.join(STUDIES)}")
    line = Line(arguments.quiet)
    try:
        with filled(arguments.output) as beside:
            result = run(arguments.only or None, beside, arguments.quick, line)
    finally:
        line.close()
    show(arguments, result, describe(result, arguments.output))


def stability(arguments):
    """Exit code 1 if a hard case is beyond its bound."""
    from ..studies.hard_cases.map import draw_map
    from ..studies.hard_cases.table import describe, rows

    line = Line(arguments.quiet)
    try:
        with filled(arguments.output) as beside:
            found = rows(arguments.only, lambda row: line(f"{row['id']} {row['dtype']}"))
            if not found:
                raise UsageError(
                    f"--only {arguments.only}: expected a case's id or its beginning up to a dot, "
                    "like H-R1"
                )
            line("drawing the map")
            draw_map(beside / "stability.png")
    finally:
        line.close()
    text = describe(found) + f"\nmap: {Path(arguments.output) / 'stability.png'}"
    show(arguments, {"cases": found}, text)
    return int(any(row["verdict"] == "fails" for row in found))


def effects(arguments):
    from ..studies.effect_ledger import describe, draw_ledger, ledger
    from ..studies.suggest import suggest
    from .job import read_scene, read_test_scene

    if arguments.suggest:
        if arguments.output or arguments.quick or arguments.full:
            raise UsageError(
                "--suggest: expected without -o, --quick and --full, it trains nothing"
            )
        rows = suggest(read_scene(arguments))
        text = "\n".join(
            f"{row['effect']:<14} {'yes' if row['called_for'] else 'no':<4} {row['evidence']}"
            for row in rows
        )
        return show(arguments, {"effects": rows}, text)
    scene, line = read_test_scene(arguments), Line(arguments.quiet)
    preset, share = ("smoke", 1) if arguments.quick else ("tiny", 1 if arguments.full else 0.5)
    try:
        with filled(arguments.output) if arguments.output else nullcontext() as beside:
            rows = ledger(scene, preset, arguments.seed, share, line)
            if beside:
                draw_ledger(beside / "effects.png", rows)
    finally:
        line.close()
    hasty = (
        "\n\nforty-five steps of the preset smoke: what PSNR says here is chance"
        if arguments.quick
        else ""
    )
    show(arguments, {"effects": rows}, describe(rows) + hasty)
