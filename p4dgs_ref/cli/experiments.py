"""The commands that make the paper's tables and curves on tiny scenes."""

from pathlib import Path

from .base import Line, UsageError, report_folder, show


def scene_of(arguments, source):
    """A scene as the command line wants it."""
    from ..scenes import load_scene

    return load_scene(source, arguments.background, arguments.downscale)


def run(arguments, study, job):
    """Show the result of `job(folder, progress)`, whose files move to the output at the end."""
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        result = job(beside, line)
    show(arguments, result, f"{study.describe(result)}\nfiles and tables: {arguments.output}")


def compare(arguments):
    """Train all methods on scenes and print the paper's Tables 1 and 2 in form."""
    from ..lab.tables import compare as study
    from ..lab.tables.methods import known

    known(arguments.methods)
    names, seeds, caps = arguments.scenes, arguments.seeds, arguments.caps
    names = names or study.dynamic_scenes()
    if arguments.quick:
        names, seeds, caps = names[:1], 1, ()
    scenes = [scene_of(arguments, name) for name in names]
    equal_time = arguments.equal == "time"
    options = arguments.methods, seeds, arguments.iterations, equal_time, caps
    run(
        arguments,
        study,
        lambda folder, line: study.compare(scenes, folder, *options, line, arguments.jobs),
    )


def sweep(arguments):
    """Make the points of a rate-distortion curve, or one of them, and draw what is there."""
    from ..lab.tables import sweep as study
    from ..scenes.output import made

    scene = scene_of(arguments, arguments.scene)
    seeds, length = arguments.seeds, arguments.iterations
    options = arguments.lambda_rate, seeds, length, arguments.methods, arguments.caps
    with made(arguments.output), Line(arguments) as line:
        tasks, values = study.plan(scene, arguments.output, *options)
        if arguments.point:
            return make_point(arguments, tasks, values)
        if not arguments.collect:
            study.make_missing(tasks, values, line, arguments.jobs)
        result = study.collect(tasks, Path(arguments.output))
    show(arguments, result, f"{study.describe(result)}\nfiles and tables: {arguments.output}")


def make_point(arguments, tasks, values):
    """Make one point of a sweep, counted from 1."""
    from ..lab.tables.sweep import make_missing, record

    i, count = arguments.point
    if count != len(tasks) or not 1 <= i <= count:
        raise UsageError(
            f"--point {i}/{count}: expected I/{len(tasks)} with I from 1 to {len(tasks)}, the "
            "number of points of this sweep"
        )
    make_missing([tasks[i - 1]], values)
    path = str(record(tasks[i - 1]))
    show(arguments, {"point": i, "of": count, "output": path}, f"point {i} of {count}: {path}")


def ablate(arguments):
    """Print the paper's Table 3 in form, and the method with one part left out at a time."""
    from ..lab.tables import ablate as study

    scene = scene_of(arguments, arguments.scene)
    options = arguments.seeds, arguments.iterations
    run(
        arguments,
        study,
        lambda folder, line: study.ablate(scene, folder, *options, line, arguments.jobs),
    )


def composition(arguments):
    """Print the paper's Table 4 in form."""
    from ..lab.tables import composition as study

    scene = scene_of(arguments, arguments.scene)
    options = arguments.low, arguments.high, arguments.iterations, arguments.seed
    run(
        arguments,
        study,
        lambda folder, line: study.composition(scene, folder, *options, line, arguments.jobs),
    )
