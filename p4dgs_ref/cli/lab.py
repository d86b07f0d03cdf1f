"""The commands of the laboratory: accuracy, hard cases, effects, and the classroom.

Each imports the part of the laboratory that it needs.
"""

import os
from contextlib import nullcontext
from glob import glob

from ..oracle import published
from ..output import new_file, staged_folder
from ..report.figures import write_csv
from ..scenes.load import packaged_folder
from . import ask, print_result, progress, require_usage, show
from .job import load, read_file

JOBS = os.cpu_count() or 1  # processes of the short trainings of --suggest


def accuracy(arguments):
    """Time the forms of four functions, and draw their losses against their times."""
    from ..lab import accuracy as study
    from ..lab.accuracy import picture

    _, model, _ = read_file(arguments.file or published.path() / "model.p4dgs")
    with staged_folder(arguments.output) as staging:
        rows = study.measure(model, load(arguments), progress)
        write_csv(staging / "accuracy.csv", rows)
        picture.draw(staging / "accuracy.png", rows)
    print_result(f"{study.to_text(rows)}\n{written(arguments, 'accuracy')}")


def written(arguments, name):
    """Return a line that names the picture of a command and its numbers."""
    return f"picture: {arguments.output}/{name}.png, its numbers beside it: {name}.csv"


def hard_cases(arguments):
    """Print the hard cases and draw the map; exit code 1 if a hard case is beyond its bound."""
    from ..lab.stability import draw_map, rows, to_text

    with staged_folder(arguments.output) as staging:
        cases = rows(arguments.only)
        write_csv(staging / "stability.csv", cases)
        draw_map(staging / "stability.png")
    table = to_text(cases, arguments.all or arguments.only)
    show(arguments, {"cases": cases}, f"{table}\n{written(arguments, 'stability')}")
    return int(any(row["verdict"] == "fails" for row in cases))


def effects(arguments):
    """Count what the effects of a scene cost, or suggest which ones its pictures call for."""
    from ..lab import effect_ledger

    require_usage(
        arguments.suggest or not arguments.apply, "--apply", "expected only together with --suggest"
    )
    if arguments.suggest:
        return suggest_effects(arguments)
    scene = load(arguments)
    with staged_folder(arguments.output) as staging:
        ledger = effect_ledger.of_scene(scene)
        write_csv(staging / "effects.csv", ledger["effects"])
        effect_ledger.draw_ledger(staging / "effects.png", ledger)
    show(arguments, ledger, f"{effect_ledger.to_text(ledger)}\n{written(arguments, 'effects')}")


def suggest_effects(arguments):
    """Say which effects the pictures call for; with --apply write the list to scene.json."""
    from ..lab.suggest import list_effects, seconds_of, suggest

    scene = load(arguments)
    folder = scene.source
    if arguments.apply:
        require_usage(
            packaged_folder() not in folder.resolve().parents,
            "--apply",
            f"{folder} is a packaged scene; expected a folder of your own",
        )
        with new_file(folder / "scene.json"):  # before the work, whose answer would be lost
            pass
    ask(arguments, "short trainings", seconds_of(scene, JOBS))
    rows = suggest(scene, progress, JOBS)
    lines = [f"{row['effect']:<14} {row['verdict']:<12} {row['evidence']}" for row in rows]
    if arguments.apply:
        called = [row["effect"] for row in rows if row["called_for"]]
        lines.append(f"written to {list_effects(folder, called)}: {', '.join(called)}")
    show(arguments, {"effects": rows}, "\n".join(lines))


def classroom(arguments):
    """Write the equations without the bodies of their functions, and the key."""
    from ..lab.classroom import hand_out

    done = hand_out(arguments.folder, arguments.only)
    print_result(
        f"{done['output']}: {done['functions']} functions of {len(done['equations'])} equations to "
        f"write; hand out student/ and keep key/; README.md explains how"
    )


def grade(arguments):
    """Grade what students wrote."""
    from ..lab import classroom as room

    # Shells of Windows leave hand_in/* as it is.
    folders = [found for name in arguments.folders for found in sorted(glob(name)) or [name]]
    with staged_folder(arguments.output) if arguments.output else nullcontext() as staging:
        grades = room.grade(
            *folders,
            classroom=arguments.classroom,
            seed=arguments.seed,
            progress=progress,
        )
        text = room.to_text(grades)
        if staging:
            (staging / "grades.txt").write_text(f"{text}\n", encoding="utf-8")
            write_csv(staging / "grades.csv", room.rows_of(grades))
    show(arguments, grades, text)
