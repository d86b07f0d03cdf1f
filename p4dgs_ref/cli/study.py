"""The commands of the studies: accuracy against time, hard cases, effects."""

from pathlib import Path

from .base import Line, UsageError, report_folder, require_known, show


def accuracy(arguments):
    """Turn the knobs that trade accuracy for time or bytes, and write a page about them."""
    from ..lab.accuracy.knobs import NAMES
    from ..lab.accuracy.report import describe, run

    require_known("--only", arguments.only, NAMES)
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        result = run(arguments.only or None, beside, arguments.quick, line, arguments.jobs)
    show(arguments, result, describe(result, arguments.output))


def stability(arguments):
    """Print the hard cases and draw the map; exit code 1 if a hard case is beyond its bound."""
    from ..lab.stability.map import draw_map
    from ..lab.stability.table import describe, rows

    with Line(arguments) as line, report_folder(arguments.output) as beside:
        found = rows(arguments.only, lambda row: line(f"{row['id']} {row['dtype']}"))
        if not found:
            raise UsageError(
                f"--only {arguments.only}: expected the id of a case, or its beginning up to a "
                "dot, like H-R1"
            )
        line("drawing the map")
        draw_map(beside / "stability.png")
    text = describe(found) + f"\nmap: {Path(arguments.output) / 'stability.png'}"
    show(arguments, {"cases": found}, text)
    return int(any(row["verdict"] == "fails" for row in found))


def effects(arguments):
    """Train with and without each effect, or say which effects the pictures call for."""
    from ..lab.effects.ledger import describe, draw_ledger, ledger
    from .job import read_test_scene

    if arguments.full and arguments.quick:
        raise UsageError("--quick: not allowed with --full; choose one")
    if arguments.apply and not arguments.suggest:
        raise UsageError("--apply: expected together with --suggest")
    if arguments.suggest:
        return suggest_effects(arguments)
    scene = read_test_scene(arguments)
    preset, share = ("smoke", 1) if arguments.quick else ("tiny", 1 if arguments.full else 0.5)
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        rows = ledger(scene, preset, arguments.seed, share, line, arguments.jobs)
        if beside:
            draw_ledger(beside / "effects.png", rows)
    text = describe(rows)
    if arguments.quick:
        text += "\n\n45 steps of the preset smoke: too few for the PSNR to mean anything"
    show(arguments, {"effects": rows}, text)


def suggest_effects(arguments):
    """Say which effects the pictures call for; with --apply write the list to scene.json."""
    from ..lab.effects.suggest import suggest
    from ..scenes.load import list_effects, packaged_folder
    from .job import read_scene

    if arguments.output or arguments.quick or arguments.full:
        raise UsageError("--suggest: expected without -o, --quick and --full")
    scene = read_scene(arguments)
    if arguments.apply and packaged_folder() in scene.source.resolve().parents:
        raise UsageError(f"--apply: {scene.source} is a packaged scene; expected a folder of yours")
    with Line(arguments) as line:
        rows = suggest(scene, progress=line, jobs=arguments.jobs)
    called = [row["effect"] for row in rows if row["called_for"]]
    lines = [f"{row['effect']:<14} {row['verdict']:<12} {row['evidence']}" for row in rows]
    if arguments.apply:
        lines.append(f"written to {list_effects(scene.source, called)}: {', '.join(called)}")
    show(arguments, {"effects": rows}, "\n".join(lines))
