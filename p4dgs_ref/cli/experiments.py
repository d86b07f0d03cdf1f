"""The commands that make the paper's tables and curves on tiny scenes."""

from .base import Line, UsageError, report_folder, show


def compare(arguments):
    """Train all methods on scenes and print the paper's Tables 1 and 2 in form."""
    from ..scenes import load_scene
    from ..studies import compare as study
    from ..studies.methods import known

    known(arguments.methods)
    names = arguments.scenes or study.dynamic_scenes()
    names = names[:1] if arguments.quick else names
    scenes = [load_scene(name, arguments.background, arguments.downscale) for name in names]
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        result = study.compare(
            scenes,
            beside,
            arguments.methods,
            1 if arguments.quick else arguments.seeds,
            arguments.iterations,
            arguments.equal == "time",
            () if arguments.quick else arguments.caps,
            line,
            arguments.jobs,
        )
    show(arguments, result, f"{study.describe(result)}\n\nfiles and tables: {arguments.output}")


def sweep(arguments):
    """Make the points of a rate-distortion curve, or one of them, and draw what is there."""
    from pathlib import Path

    from ..scenes import load_scene
    from ..scenes.output import made
    from ..studies import sweep as study

    scene = load_scene(arguments.scene, arguments.background, arguments.downscale)
    with made(arguments.output), Line(arguments) as line:
        tasks, values = study.plan(
            scene,
            arguments.output,
            arguments.lambda_rate,
            arguments.seeds,
            arguments.iterations,
            arguments.methods,
            arguments.caps,
        )
        if arguments.point:
            return make_point(arguments, tasks, values)
        if not arguments.collect:
            study.make_missing(tasks, values, line, arguments.jobs)
        result = study.collect(tasks, Path(arguments.output))
    show(arguments, result, f"{study.describe(result)}\n{arguments.output}: sweep.csv, sweep.png")


def make_point(arguments, tasks, values):
    """Make one point of a sweep, counted from 1."""
    from ..studies.sweep import make_missing, record

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
    import json

    from ..scenes import load_scene
    from ..studies import ablate as study
    from ..studies.report import write_csv

    scene = load_scene(arguments.scene, arguments.background, arguments.downscale)
    with Line(arguments) as line, report_folder(arguments.output) as beside:
        options = arguments.seeds, arguments.iterations, line, arguments.jobs
        result = study.ablate(scene, beside, *options)
        (beside / "ablate.json").write_text(json.dumps(result, indent=1) + "\n")
        write_csv(beside / "ablate.csv", result["rows"])
    show(arguments, result, study.describe(result))


def composition(arguments):
    """Print the paper's Table 4 in form."""
    import json

    from ..scenes import load_scene
    from ..studies import composition as study

    scene = load_scene(arguments.scene, arguments.background, arguments.downscale)
    with report_folder(arguments.output) as beside:
        rates = arguments.low, arguments.high
        options = arguments.iterations, arguments.seed, arguments.jobs
        result = study.composition(scene, beside, *rates, *options)
        (beside / "composition.json").write_text(json.dumps(result, indent=1) + "\n")
    show(arguments, result, study.describe(result))
