"""What the commands of the classroom do: write a copy for students, grade it."""

from ..scenes.output import filled
from .base import Line, show


def classroom(arguments):
    from ..school import classroom as write

    done = write(arguments.folder, arguments.only or None, arguments.backward_only, arguments.seed)
    kept = f"; kept as they were: {', '.join(done['kept'])}" if done["kept"] else ""
    show(
        arguments,
        done,
        f"{done['output']}: {done['functions']} functions of {len(done['equations'])} equations to write in "
        f"student/, the key in key/, README.md says how{kept}",
    )


def grade(arguments):
    from ..school import as_json, text, write
    from ..school import grade as judge

    line = Line(arguments.quiet)
    try:
        report = judge(arguments.folder, arguments.seed, arguments.student, arguments.timeout, line)
    finally:
        line.close()
    if arguments.output:
        with filled(arguments.output) as beside:
            write(report, beside)
    show(arguments, as_json(report), text(report))
