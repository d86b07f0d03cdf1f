"""The commands of the classroom: write a copy for students, grade it."""

from .base import Line, report_folder, show


def classroom(arguments):
    """Write the equations without their bodies, and the key."""
    from ..school import classroom as write

    done = write(arguments.folder, arguments.only or None, arguments.backward_only, arguments.seed)
    kept = f"; kept as they were: {', '.join(done['kept'])}" if done["kept"] else ""
    show(
        arguments,
        done,
        f"{done['output']}: {done['functions']} functions of {len(done['equations'])} equations "
        f"to write in student/; the key is in key/, README.md explains{kept}",
    )


def grade(arguments):
    """Judge what students wrote."""
    from ..school import as_json, text, write
    from ..school import grade as judge

    with Line(arguments) as line:
        report = judge(arguments.folder, arguments.seed, arguments.student, arguments.timeout, line)
    with report_folder(arguments.output) as beside:
        if beside:
            write(report, beside)
    show(arguments, as_json(report), text(report))
