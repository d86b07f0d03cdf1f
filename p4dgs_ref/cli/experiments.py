"""The commands that make the paper's tables and curves on tiny scenes."""

from pathlib import Path

from ..lab.tables import ablate as ablation
from ..lab.tables import compare as comparison
from ..lab.tables import sweep as curve
from ..lab.tables.methods import known
from ..scenes import load_scene
from ..scenes.output import filled, made
from .base import expect, progress, show


def report(arguments, study, result):
    """Show the result of a study and where its files are."""
    show(arguments, result, f"{study.describe(result)}\nfiles and tables: {arguments.output}")


def compare(arguments):
    """Train all methods on scenes and print the paper's Tables 1 and 2 in form."""
    known(arguments.methods)
    names, seeds = arguments.scenes or comparison.dynamic_scenes(), arguments.seeds
    if arguments.quick:
        names, seeds = names[:1], 1
    scenes = [load_scene(name) for name in names]
    options = {"progress": progress, "jobs": arguments.jobs}
    with filled(arguments.output) as beside:
        result = comparison.compare(
            scenes, beside, arguments.methods, seeds, arguments.iterations, **options
        )
    report(arguments, comparison, result)


def sweep(arguments):
    """Make the points of a rate-distortion curve, or one of them, and draw what is there."""
    scene, point = load_scene(arguments.scene), arguments.point
    options = arguments.lambda_rate, arguments.seeds, arguments.iterations, arguments.methods
    with made(arguments.output) as folder:
        tasks, values = curve.plan(scene, folder, *options)
        if point:
            return make_point(arguments, tasks, values, *point)
        if not arguments.collect:
            curve.make_missing(tasks, values, progress, arguments.jobs)
        result = curve.collect(tasks, Path(folder))
    report(arguments, curve, result)


def make_point(arguments, tasks, values, i, count):
    """Make one point of a sweep, counted from 1."""
    expect(
        count == len(tasks) and 1 <= i <= count,
        f"--point {i}/{count}: expected I/{len(tasks)} with I from 1 to {len(tasks)}, the "
        "number of points of this sweep",
    )
    curve.make_missing([tasks[i - 1]], values)
    path = str(tasks[i - 1].record)
    show(arguments, {"point": i, "of": count, "output": path}, f"point {i} of {count}: {path}")


def ablate(arguments):
    """Print the paper's Table 3 in form, and the method with one part left out at a time."""
    scene, options = load_scene(arguments.scene), (arguments.seeds, arguments.iterations)
    with filled(arguments.output) as beside:
        result = ablation.ablate(scene, beside, *options, progress, arguments.jobs)
    report(arguments, ablation, result)
