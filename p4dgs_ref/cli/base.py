"""What every command needs: its errors, its output, its progress line.

Commands import what they run inside their functions, so that `p4dgs-ref --help` is quick and a
mistake in an option is reported at once.
"""

import json
import os
import shutil
import sys
import time
from contextlib import AbstractContextManager, nullcontext

LONGEST = 2000  # characters of a message


class UsageError(ValueError):
    """A mistake on the command line: one line naming the option or file and what was expected."""


def require_known(option, names, known):
    """Refuse a name that is not among those that an option knows."""
    for name in names:
        if name not in known:
            raise UsageError(f"{option} {name}: expected one of {', '.join(known)}")


def visible(text, kept=""):
    """The text with every character that a terminal would obey or cannot show as its escape."""
    return "".join(c if c.isprintable() or c in kept else ascii(c)[1:-1] for c in str(text))


def say(message):
    """Print a message on stderr as one line; the middle of a very long one is left out."""
    line = visible(message)
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    print(f"p4dgs-ref: {line}", file=sys.stderr)


def show(arguments, value, text):
    """Print the value as JSON with --json, otherwise the text.

    A reader that stops early, such as `head`, does not change the exit code.
    """
    try:
        print(json.dumps(value, indent=1) if arguments.json else visible(text, "\n"))
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def report_folder(path):
    """A context with a fresh folder whose files move to `path` at the end; None without a path."""
    from ..scenes.output import filled

    return filled(path) if path else nullcontext()


def log(arguments):
    """The stream for progress: stderr, or None with --quiet."""
    return None if arguments.quiet else sys.stderr


class Line(AbstractContextManager):
    """A progress line on stderr for the duration of a `with`; called with the text to show.

    A terminal shows one line that changes and disappears at the end. Other streams get a line every
    few seconds. With --quiet there is none.
    """

    EVERY = 2.0  # seconds between two lines

    def __init__(self, arguments):
        self.stream, self.live = log(arguments), sys.stderr.isatty()
        self.last = time.monotonic()
        self.open = False  # whether the terminal shows a line

    def __call__(self, text):
        now = time.monotonic()
        if self.stream and (self.live or now - self.last > self.EVERY):
            width, text = shutil.get_terminal_size().columns - 1, visible(text)
            line = f"\r{text[:width]}\x1b[K" if self.live else text + "\n"
            print(line, end="", file=self.stream, flush=True)
            self.last, self.open = now, self.live

    def __exit__(self, *error):
        if self.open:
            print("\r\x1b[K", end="", file=self.stream, flush=True)
