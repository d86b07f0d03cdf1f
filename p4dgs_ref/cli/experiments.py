"""The commands that make the paper's tables and curves on tiny scenes."""

from pathlib import Path

from .base import Line, UsageError, report_folder, show


def report(arguments, study, result):
    """Print what a study says about its result."""
    show(arguments, result, f"{study.describe(result)}\nfiles and tables: {arguments.output}")


def compare(arguments):
    """Train all methods on scenes and print the paper's Tables 1 and 2 in form."""
    from ..lab.tables import compare as study
    from ..lab.tables.methods import known
    from ..scenes import load_scene

    known(arguments.methods)
    names, seeds = arguments.scenes or study.dynamic_scenes(), arguments.seeds
    if arguments.quick:
        names, seeds = names[:1], 1
    scenes = [load_scene(name) for name in names]
    options = arguments.methods, seeds, arguments.iterations
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        result = study.compare(scenes, beside, *options, line, arguments.jobs)
    report(arguments, study, result)


def sweep(arguments):
    """Make the points of a rate-distortion curve, or one of them, and draw what is there."""
    from ..lab.tables import sweep as study
    from ..scenes import load_scene
    from ..scenes.output import made

    scene, point = load_scene(arguments.scene), arguments.point
    options = arguments.lambda_rate, arguments.seeds, arguments.iterations, arguments.methods
    with made(arguments.output), Line(arguments) as line:
        tasks, values = study.plan(scene, arguments.output, *options)
        if point:
            return make_point(arguments, tasks, values)
        if not arguments.collect:
            study.make_missing(tasks, values, line, arguments.jobs)
        result = study.collect(tasks, Path(arguments.output))
    report(arguments, study, result)


def make_point(arguments, tasks, values):
    """Make one point of a sweep, counted from 1."""
    from ..lab.tables.sweep import make_missing

    i, count = arguments.point
    if count != len(tasks) or not 1 <= i <= count:
        raise UsageError(
            f"--point {i}/{count}: expected I/{len(tasks)} with I from 1 to {len(tasks)}, the "
            "number of points of this sweep"
        )
    make_missing([tasks[i - 1]], values)
    path = str(tasks[i - 1].record)
    show(arguments, {"point": i, "of": count, "output": path}, f"point {i} of {count}: {path}")


def ablate(arguments):
    """Print the paper's Table 3 in form, and the method with one part left out at a time."""
    from ..lab.tables import ablate as study
    from ..scenes import load_scene

    scene, options = load_scene(arguments.scene), (arguments.seeds, arguments.iterations)
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        result = study.ablate(scene, beside, *options, line, arguments.jobs)
    report(arguments, study, result)
