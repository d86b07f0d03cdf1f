"""What every command needs: its errors, its output, its progress line."""

import json
import os
import shutil
import sys
from contextlib import nullcontext

LONGEST = 2000  # characters of a message


class UsageError(ValueError):
    """A mistake on the command line: one line naming the option or file and what was expected."""


def expect(condition, message):
    """Refuse what the command line asks for where the condition fails."""
    if not condition:
        raise UsageError(message)


def expect_known(option, names, known):
    """Refuse a name that is not among those that an option knows."""
    for name in names:
        expect(name in known, f"{option} {name}: expected one of {', '.join(known)}")


def visible(text, kept=""):
    """The text with every character that a terminal would obey or cannot show as its escape."""
    return "".join(c if c.isprintable() or c in kept else ascii(c)[1:-1] for c in str(text))


def progress(text=""):
    """Show a text as the last line of a terminal, in the place of the text before it.

    Without a text the line is cleared, which every other output does first. Streams other than a
    terminal get no progress.
    """
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        print(f"\r{visible(text)[:width]}\x1b[K", end="", file=sys.stderr, flush=True)


def say(message):
    """Print a message on stderr as one line; the middle of a very long one is left out."""
    line = visible(message)
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    progress()
    print(f"p4dgs-ref: {line}", file=sys.stderr)


def tell(text):
    """Print a result; a reader that stops early, such as `head`, does not change the exit code."""
    progress()
    try:
        print(visible(text, "\n"), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def show(arguments, value, text):
    """Print the value as JSON with --json, otherwise the text."""
    tell(json.dumps(value, indent=1) if arguments.json else text)


def report_folder(path):
    """A context with a fresh folder whose files move to `path` at the end; None without a path."""
    from ..scenes.output import filled  # loads NumPy, which `p4dgs-ref --help` can do without

    return filled(path) if path else nullcontext()
