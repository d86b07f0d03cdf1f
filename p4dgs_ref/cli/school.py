"""The commands of the classroom: write a copy for students, grade it."""

from .base import Line, report_folder, show


def classroom(arguments):
    """Write the equations without their bodies, and the key."""
    from ..lab.school import classroom as write

    done = write(arguments.folder, arguments.only)
    kept = f"; kept as they were: {', '.join(done['kept'])}" if done["kept"] else ""
    show(
        arguments,
        done,
        f"{done['output']}: {done['functions']} functions of {len(done['equations'])} equations "
        f"to write in student/; the key is in key/; README.md and key/README.md explain{kept}",
    )


def grade(arguments):
    """Judge what students wrote."""
    from ..lab import school

    with report_folder(arguments.output) as beside, Line(arguments) as line:
        grades = school.grade(
            *arguments.folders,
            classroom=arguments.classroom,
            seed=arguments.seed,
            timeout=arguments.timeout,
            reveal=arguments.reveal,
            progress=line,
        )
        if beside:
            school.write(grades, beside)
    show(arguments, school.as_json(grades), school.text(grades))
