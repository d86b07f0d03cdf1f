"""What the commands of the golden oracle do: list, export and find the vectors, check a port against them."""

from pathlib import Path

from .base import Line, UsageError, show


def oracle_list(arguments):
    from ..oracle.report import listing
    from ..oracle.vectors import read_manifest

    manifest = read_manifest()
    show(arguments, {name: manifest[name] for name in ("subjects", "streams")}, listing(manifest))


def oracle_path(arguments):
    from ..oracle.vectors import path

    show(arguments, {"path": str(path())}, path())


def oracle_export(arguments):
    from ..oracle.vectors import export

    line = Line(arguments.quiet)
    try:
        done = export(arguments.folder, arguments.regenerate, line)
    finally:
        line.close()
    show(
        arguments,
        done,
        f"{done['output']}: {done['files']} files, {done['bytes']:,} bytes, {done['cases']} cases",
    )


def oracle_check(arguments):
    """Exit code 0 only if every required case passes, 1 if one does not."""
    from ..oracle.adapter import Adapter
    from ..oracle.checker import check_port
    from ..oracle.ports import FolderPort
    from ..oracle.report import as_json
    from ..oracle.vectors import names

    if (arguments.folder is None) == (arguments.adapter is None):
        raise UsageError(
            "oracle check: expected either a folder of a port's answers or --adapter CMD"
        )
    if arguments.folder and not Path(arguments.folder).is_dir():
        raise UsageError(f"{arguments.folder}: expected a folder of a port's answers")
    if arguments.folder and (arguments.dtype or arguments.timeout):
        raise UsageError(
            "--dtype, --timeout: of the adapter; a folder's precision is that of its tensors"
        )
    if unknown := [name for name in arguments.only if name not in names()]:
        raise UsageError(f"--only {unknown[0]}: expected one of {', '.join(names())}")
    port = (
        FolderPort(arguments.folder)
        if arguments.folder
        else Adapter(arguments.adapter, arguments.timeout or 10.0, arguments.dtype or "float64")
    )
    line = Line(arguments.quiet)
    try:
        report = check_port(port, arguments.level, arguments.only, progress=line)
    finally:
        port.close()
        line.close()
    if not report.results:
        raise UsageError(
            f"--level {' '.join(arguments.level)} --only {' '.join(arguments.only)}: no such case"
        )
    note = (
        "\nthis folder holds the vectors themselves, not a port's answers"
        if arguments.folder and (Path(arguments.folder) / "manifest.json").is_file()
        else ""
    )
    show(arguments, as_json(report), str(report) + note)
    return 0 if report.ok else 1
