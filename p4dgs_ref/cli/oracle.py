"""The commands of the golden oracle: list, export and find the vectors, check a port with them."""

from contextlib import closing
from pathlib import Path

from .base import Line, UsageError, show


def oracle_list(arguments):
    """List the cases."""
    from ..oracle.published import read_manifest
    from ..oracle.report import listing

    manifest = read_manifest(version=arguments.vectors)
    show(arguments, {name: manifest[name] for name in ("subjects", "streams")}, listing(manifest))


def oracle_path(arguments):
    """Print where the vectors are installed."""
    from ..oracle.published import path

    show(arguments, {"path": str(path())}, path())


def oracle_export(arguments):
    """Write the vectors into a folder."""
    from ..oracle.export import export

    done = export(arguments.folder, arguments.vectors)
    show(
        arguments,
        done,
        f"{done['output']}: {done['files']} files, {done['bytes']:,} bytes, {done['cases']} cases",
    )


def oracle_check(arguments):
    """Judge the answers of a port; exit code 1 if a required case does not pass."""
    from ..oracle.adapter import Adapter
    from ..oracle.checker import check_port
    from ..oracle.ports import FolderPort, require_known
    from ..oracle.published import names
    from ..oracle.report import as_json

    folder, command = arguments.folder, arguments.adapter
    if (folder is None) == (command is None):
        raise UsageError(
            "oracle check: expected either a folder of a port's answers or --adapter CMD"
        )
    if folder and not Path(folder).is_dir():
        raise UsageError(f"{folder}: expected a folder of a port's answers")
    if folder and (arguments.dtype or arguments.timeout):
        raise UsageError(
            "--dtype, --timeout: these apply to --adapter only; "
            "the precision of a folder is that of its tensors"
        )
    for name in arguments.only:
        require_known(name, names(), "--only")
    port = (
        FolderPort(folder)
        if folder
        else Adapter(command, arguments.timeout or 10.0, arguments.dtype or "float64")
    )
    with Line(arguments) as line, closing(port):
        report = check_port(
            port,
            arguments.level,
            arguments.only,
            progress=line,
            version=arguments.vectors,
            strict=arguments.strict,
        )
    if not report.results:
        asked = f"--level {' '.join(arguments.level)} --only {' '.join(arguments.only)}"
        raise UsageError(f"{asked}: no such case; `p4dgs-ref oracle list` lists them")
    show(arguments, as_json(report), report)
    return 0 if report.ok else 1
