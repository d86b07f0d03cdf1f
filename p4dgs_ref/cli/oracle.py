"""The commands for ports: list, export and find the golden vectors, check a port with them."""

from contextlib import nullcontext
from pathlib import Path

from ..lab.baselines import ALL_EQUATIONS
from ..oracle import published
from ..oracle.adapter import Adapter
from ..oracle.checker import check_port
from ..oracle.ports import FolderPort
from ..oracle.published import meant
from ..oracle.report import as_json, listing
from ..oracle.streams import export
from ..table import table
from . import expect, progress, show, tell


def list_cases(arguments):
    """List the cases."""
    tell(listing(published.read_manifest(version=arguments.vectors)))


def list_equations(arguments):
    """Print the table of equations, also the baselines' and those beyond the paper."""
    tell(table(ALL_EQUATIONS))


def path(arguments):
    """Print where the vectors are installed."""
    tell(published.path())


def export_vectors(arguments):
    """Write the vectors into a folder."""
    tell(f"{arguments.folder}: {export(arguments.folder, arguments.vectors)} cases")


def port_of(arguments):
    """A context with the port that answers: a folder of answers, or a running program."""
    folder, command = arguments.folder, arguments.adapter
    expect(
        (folder is None) != (command is None),
        "oracle check: expected either a folder of a port's answers or --adapter CMD",
    )
    if command:
        return Adapter(command, arguments.timeout or 10.0, arguments.dtype or "float64")
    expect(Path(folder).is_dir(), f"{folder}: expected a folder of a port's answers")
    expect(
        not (arguments.dtype or arguments.timeout),
        "--dtype, --timeout: these apply to --adapter only; "
        "the precision of a folder is that of its tensors",
    )
    return nullcontext(FolderPort(folder))


def check(arguments):
    """Judge the answers of a port; exit code 1 if a required case does not pass."""
    level, only = arguments.level, arguments.only
    for name in only:
        expect(name in published.names(), f"--only {name}: {meant(name, published.names())}")
    with port_of(arguments) as port:
        report = check_port(
            port,
            level,
            only,
            progress=progress,
            version=arguments.vectors,
            strict=arguments.strict,
        )
    expect(
        report.results,
        f"--level {' '.join(level)} --only {' '.join(only)}: no such case; "
        "`p4dgs-ref oracle list` lists them",
    )
    show(arguments, as_json(report), report)
    return 0 if report.ok else 1
