"""The commands that make the paper's tables and curves on tiny scenes."""

from .base import Line, report_folder, show


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
