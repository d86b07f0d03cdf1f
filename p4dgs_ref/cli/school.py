"""The commands of the classroom: write a copy for students, grade it."""

from ..lab import school
from .base import progress, report_folder, show, tell


def classroom(arguments):
    """Write the equations without their bodies, and the key."""
    done = school.classroom(arguments.folder, arguments.only)
    kept = f"; kept as they were: {', '.join(done['kept'])}" if done["kept"] else ""
    tell(
        f"{done['output']}: {done['functions']} functions of {len(done['equations'])} equations "
        f"to write in student/; the key is in key/; README.md and key/README.md explain{kept}"
    )


def grade(arguments):
    """Judge what students wrote."""
    with report_folder(arguments.output) as beside:
        grades = school.grade(
            *arguments.folders,
            classroom=arguments.classroom,
            seed=arguments.seed,
            timeout=arguments.timeout,
            reveal=arguments.reveal,
            progress=progress,
        )
        if beside:
            school.write(grades, beside)
    show(arguments, school.as_json(grades), school.text(grades))
