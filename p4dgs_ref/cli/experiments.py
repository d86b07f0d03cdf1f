"""The commands that make the paper's tables and curves on tiny scenes."""

from .base import Line, UsageError, report_folder, show


def test_scene(arguments, source):
    """A scene with views to measure on."""
    from ..scenes import load_scene

    scene = load_scene(source, arguments.background, arguments.downscale)
    if not scene.test:
        raise UsageError(
            f"{scene.source}: split 'test': no views; expected at least one to measure on"
        )
    return scene


def compare(arguments):
    """Train all methods on scenes and print the paper's Tables 1 and 2 in form."""
    from ..studies import compare as study
    from ..studies.methods import known

    known(arguments.methods)
    names = arguments.scenes or study.dynamic_scenes()
    if arguments.quick:
        names = names[:1]
    scenes = [test_scene(arguments, name) for name in names]
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
