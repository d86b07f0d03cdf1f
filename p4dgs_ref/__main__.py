"""`python -m p4dgs_ref` and `p4dgs-ref`: settings that precede NumPy, then the command line."""

import io
import os
import sys
import time

from .arithmetic import prepare


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code; SIGTERM is treated as Ctrl-C."""
    start = time.perf_counter()
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
