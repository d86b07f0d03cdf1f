"""`python -m p4dgs_ref` and `p4dgs-ref`: settings that precede NumPy, then the command line."""

import io
import os
import sys
import time

from .arithmetic import prepare


def open_streams():
    """Lead the standard streams that a shell has closed (`2>&-`) to the null device.

    Otherwise a file would get the number of such a stream, and the messages of other code.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            stream = open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8")
            os.set_inheritable(stream.fileno(), True)  # for workers
            setattr(sys, name, stream)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code; SIGTERM and SIGHUP are treated as Ctrl-C."""
    start = time.perf_counter()
    open_streams()
    os.environ["MPLBACKEND"] = "Agg"  # that of a notebook may not be installed here
    try:
        from .signals import deferred, handled, interrupt

        with handled(interrupt):
            with deferred():  # not in the middle of an import
                prepare()
                from .cli.parser import run

                if isinstance(sys.stdout, io.TextIOWrapper):  # escape what it cannot show
                    sys.stdout.reconfigure(errors="backslashreplace")
            return run(sys.argv[1:] if argv is None else argv, start)
    except KeyboardInterrupt:  # before or after what `run` takes care of
        print("p4dgs-ref: stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
