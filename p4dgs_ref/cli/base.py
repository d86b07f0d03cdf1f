"""What every command needs: its mistakes, its output, its progress line."""

import json
import os
import shutil
import sys
import time


class UsageError(ValueError):
    """A mistake in what the command line was given: one line naming the option or file and what was expected."""


def show(arguments, value, lines):
    """Print a value as JSON or, without --json, as text.  A reader that has enough (`| head`) does not change the exit code."""
    try:
        print(json.dumps(value, indent=1) if arguments.json else lines)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def log(arguments):
    """Where progress goes: stderr, or nowhere with --quiet."""
    return None if arguments.quiet else sys.stderr


class Line:
    """A progress line on stderr: redrawn on a terminal, printed every few seconds elsewhere, absent with --quiet."""

    EVERY = 2.0  # seconds between two lines of a log

    def __init__(self, quiet=False):
        self.stream, self.live, self.open = (
            None if quiet else sys.stderr,
            sys.stderr.isatty(),
            False,
        )
        self.last = time.monotonic()

    def __call__(self, text):
        now = time.monotonic()
        if self.stream and (self.live or now - self.last > self.EVERY):
            self.last, width = now, shutil.get_terminal_size().columns - 1
            self.stream.write(f"\r{text[:width]}\x1b[K" if self.live else text + "\n")
            self.stream.flush()
            self.open = self.live

    def close(self):
        """Clear the line, so that what follows stands on its own."""
        if self.open:
            self.stream.write("\r\x1b[K")
            self.stream.flush()
            self.open = False
