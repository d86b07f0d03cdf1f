"""The commands of the laboratory: what choices cost, the paper's tables, the classroom.

Each imports the part of the laboratory that it needs.
"""

from contextlib import nullcontext
from functools import partial

from ..output import staged_folder
from ..scenes.load import find_scene, list_effects, load_scene, packaged_folder
from . import progress, require, say, show, tell
from .job import estimate


def turn_knobs(arguments):
    """Turn the knobs that trade accuracy for time or bytes, and write a page about them."""
    from ..lab.accuracy import report as accuracies

    with staged_folder(arguments.output) as staging:
        result = accuracies.run(
            arguments.only or None,
            staging,
            arguments.output,
            arguments.quick,
            progress,
            arguments.jobs,
        )
    show(arguments, result, accuracies.to_text(result, arguments.output))


def hard_cases(arguments):
    """Print the hard cases and draw the map; exit code 1 if a hard case is beyond its bound."""
    from ..lab.stability import draw_map, rows, to_text

    with staged_folder(arguments.output) as staging:
        cases = rows(arguments.only)
        draw_map(staging / "stability.png")
    show(arguments, {"cases": cases}, f"{to_text(cases)}\nmap: {arguments.output}/stability.png")
    return int(any(row["verdict"] == "fails" for row in cases))


def effects(arguments):
    """Train with and without each effect, or say which effects the pictures call for."""
    from ..lab import effect_ledger

    require(arguments.suggest or not arguments.apply, "--apply", "expected together with --suggest")
    require(
        not (arguments.suggest and arguments.output),
        f"-o {arguments.output}",
        "expected without --suggest, which writes no files",
    )
    if arguments.suggest:
        return suggest_effects(arguments)
    folder = arguments.output or "report/effects"
    with staged_folder(folder) as staging:
        tasks = effect_ledger.plan(load_scene(arguments.scene), folder)
        make_rows(arguments, tasks)
        rows = effect_ledger.collect(tasks, staging)
    show(arguments, {"effects": rows}, effect_ledger.to_text(rows))


def suggest_effects(arguments):
    """Say which effects the pictures call for; with --apply write the list to scene.json."""
    from ..lab.suggest import seconds_of, suggest

    scene, folder = load_scene(arguments.scene), find_scene(arguments.scene)
    require(
        not arguments.apply or packaged_folder() not in folder.resolve().parents,
        "--apply",
        f"{folder} is a packaged scene; expected a folder of yours",
    )
    say(f"--suggest: about {seconds_of(scene, jobs=arguments.jobs):.0f} s of short trainings")
    rows = suggest(scene, progress=progress, jobs=arguments.jobs)
    lines = [f"{row['effect']:<14} {row['verdict']:<12} {row['evidence']}" for row in rows]
    if arguments.apply:
        called = [row["effect"] for row in rows if row["called_for"]]
        lines.append(f"written to {list_effects(folder, called)}: {', '.join(called)}")
    show(arguments, {"effects": rows}, "\n".join(lines))


def make_rows(arguments, tasks):
    """Make the rows that are missing, after an estimate of the time."""
    from ..lab.tables import methods

    methods.make_missing(tasks, progress, arguments.jobs, partial(estimate, arguments))


def classroom(arguments):
    """Write the equations without their bodies, and the key."""
    from ..lab.classroom import hand_out

    done = hand_out(arguments.folder, arguments.only)
    kept = f"; kept as they were: {', '.join(done['kept'])}" if done["kept"] else ""
    tell(
        f"{done['output']}: {done['functions']} functions of {len(done['equations'])} equations to "
        f"write; hand out student/, keep key/; README.md explains what to do{kept}"
    )


def grade(arguments):
    """Judge what students wrote."""
    from ..lab import classroom as room

    with staged_folder(arguments.output) if arguments.output else nullcontext() as staging:
        grades = room.grade(
            *arguments.folders,
            classroom=arguments.classroom,
            seed=arguments.seed,
            progress=progress,
        )
        if staging:
            room.write(grades, staging)
    show(arguments, grades, room.to_text(grades))
