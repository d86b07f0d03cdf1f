"""The command line: what every command needs for its errors, its output and its progress line.

`parser.py` is the table of all commands and options; `job.py`, `lab.py` and `oracle.py` have a thin
function for each command, and `text.py` says what those of the main job print.
"""

import json
import os
import shutil
import sys
from contextlib import suppress

from ..messages import shorten


class UsageError(ValueError):
    """A mistake on the command line: one line naming the option or file and what was expected."""


def require_usage(condition, where, expected):
    """Raise a UsageError unless the condition holds."""
    if not condition:
        raise UsageError(f"{where}: {expected}")


def visible(text, kept=""):
    """Return the text with an escape for each character that a terminal obeys or cannot show."""
    return "".join(c if c.isprintable() or c in kept else ascii(c)[1:-1] for c in str(text))


def write_stderr(text):
    """Print on stderr; if that fails (full disk, closed terminal), the command continues."""
    with suppress(OSError):
        print(text, end="", file=sys.stderr, flush=True)


def progress(text=""):
    """Show a text as the last line of a terminal, replacing the previous one.

    Without a text the line is cleared, as it is before all other output. Only a terminal shows
    progress.
    """
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        write_stderr(f"\r{visible(text)[:width]}\x1b[K")


def print_message(message):
    """Print a message on stderr as one line, whatever it quotes."""
    progress()
    write_stderr(f"p4dgs-ref: {visible(shorten(str(message)))}\n")


def print_warning(warning):
    """Print a warning, if there is one, on stderr as one line."""
    if warning:
        print_message(f"warning: {warning}")


def print_result(text):
    """Print a result; a reader that stops early, such as `head`, does not change the exit code."""
    progress()
    try:
        print(visible(text, "\n"), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def show(arguments, value, text):
    """Print the value as JSON with --json, otherwise the text."""
    print_result(json.dumps(value, indent=1) if arguments.json else text)


def ask(arguments, what, seconds, free=0):
    """Print how long trainings take, and continue only if the user or --yes agrees.

    Trainings of less than `free` seconds start without a question; their estimate is printed if it
    is more than a minute.
    """
    for unit, length in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= length:
            break
    estimate = f"about {max(seconds / length, 0.1):.1f} {unit} ({what})"
    is_seen = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
    wanted = arguments.yes or seconds < free
    require_usage(wanted or is_seen, estimate, "pass --yes to start")
    if seconds > 60 or not wanted:
        print_message(estimate)
    if not wanted:
        write_stderr("continue? [y/N] ")
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise KeyboardInterrupt
