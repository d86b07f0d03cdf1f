"""The commands of the studies: accuracy against time, hard cases, effects, times of the parts."""

from pathlib import Path

from ..lab import bench as times
from ..lab.accuracy import knobs, report
from ..lab.effects import ledger
from ..lab.effects.suggest import foretold, suggest
from ..lab.stability import table
from ..lab.stability.map import draw_map
from ..scenes.load import find_scene, list_effects, packaged_folder
from ..scenes.output import filled
from .base import expect, expect_known, progress, report_folder, say, show
from .job import read_scene


def accuracy(arguments):
    """Turn the knobs that trade accuracy for time or bytes, and write a page about them."""
    only = arguments.only
    expect_known("--only", only, knobs.NAMES)
    with filled(arguments.output) as beside:
        result = report.run(only or None, beside, arguments.quick, progress, arguments.jobs)
    show(arguments, result, report.describe(result, arguments.output))


def stability(arguments):
    """Print the hard cases and draw the map; exit code 1 if a hard case is beyond its bound."""
    with filled(arguments.output) as beside:
        rows = table.rows(arguments.only, lambda row: progress(f"{row['id']} {row['dtype']}"))
        expect(
            rows,
            f"--only {arguments.only}: expected the id of a case, or its beginning up to a dot, "
            "like H-R1",
        )
        progress("drawing the map")
        draw_map(beside / "stability.png")
    text = f"{table.describe(rows)}\nmap: {Path(arguments.output) / 'stability.png'}"
    show(arguments, {"cases": rows}, text)
    return int(any(row["verdict"] == "fails" for row in rows))


def effects(arguments):
    """Train with and without each effect, or say which effects the pictures call for."""
    if arguments.suggest:
        return suggest_effects(arguments)
    expect(not arguments.apply, "--apply: expected together with --suggest")
    scene = read_scene(arguments, "test", "measure on")
    preset, share = ("smoke", 1) if arguments.quick else ("tiny", 0.5)
    with report_folder(arguments.output) as beside:
        rows = ledger.ledger(scene, preset, arguments.seed, share, progress, arguments.jobs)
        if beside:
            ledger.draw_ledger(beside / "effects.png", rows)
    text = ledger.describe(rows)
    if arguments.quick:
        text += "\n\n45 steps of the preset smoke: too few for the PSNR to mean anything"
    show(arguments, {"effects": rows}, text)


def suggest_effects(arguments):
    """Say which effects the pictures call for; with --apply write the list to scene.json."""
    expect(not (arguments.output or arguments.quick), "--suggest: expected without -o and --quick")
    scene, folder = read_scene(arguments), find_scene(arguments.scene)
    expect(
        not arguments.apply or packaged_folder() not in folder.resolve().parents,
        f"--apply: {folder} is a packaged scene; expected a folder of yours",
    )
    say(f"--suggest: about {foretold(scene, jobs=arguments.jobs):.0f} s of short trainings")
    rows = suggest(scene, progress=progress, jobs=arguments.jobs)
    called = [row["effect"] for row in rows if row["called_for"]]
    lines = [f"{row['effect']:<14} {row['verdict']:<12} {row['evidence']}" for row in rows]
    if arguments.apply:
        lines.append(f"written to {list_effects(folder, called)}: {', '.join(called)}")
    show(arguments, {"effects": rows}, "\n".join(lines))


def bench(arguments):
    """Time the renderer, a training step and the coder."""
    result = times.bench(arguments.quick)
    show(arguments, result, times.describe(result))
