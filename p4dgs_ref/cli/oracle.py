"""The commands for ports: list and export the golden vectors, check a port with them."""

from contextlib import nullcontext
from pathlib import Path

from ..oracle import published
from ..oracle.adapter import Adapter
from ..oracle.checker import check_port
from ..oracle.ports import FolderPort
from ..oracle.report import as_json, listing
from ..oracle.streams import export
from ..splatting.table import to_markdown
from . import print_result, progress, require_usage, show


def list_cases(arguments):
    """List the cases."""
    print_result(listing(published.read_manifest()))


def list_equations(arguments):
    """Print the table of equations."""
    print_result(to_markdown())


def export_vectors(arguments):
    """Copy the vectors into a folder."""
    count = export(arguments.folder)
    print_result(f"{arguments.folder}: {count} cases, copied from {published.path()}")


def port_of(arguments):
    """Yield the port that answers: a folder of answers, or a running program."""
    folder, command = arguments.folder, arguments.adapter
    require_usage(
        (folder is None) != (command is None),
        "oracle check",
        "expected either a folder with a port's answers or --adapter CMD",
    )
    if command:
        return Adapter(command, arguments.timeout or 10.0, arguments.dtype or "float64")
    require_usage(Path(folder).is_dir(), folder, "expected a folder with a port's answers")
    require_usage(
        not (arguments.dtype or arguments.timeout),
        "--dtype, --timeout",
        "expected only with --adapter; a folder's tensors have their own precision",
    )
    return nullcontext(FolderPort(folder))


def check(arguments):
    """Judge the answers of a port; exit code 1 if a required case does not pass."""
    with port_of(arguments) as port:
        report = check_port(port, arguments.level, arguments.only, progress, arguments.strict)
    show(arguments, as_json(report), report)
    return 0 if report.ok else 1
