"""`python -m p4dgs_ref` and `p4dgs-ref`: settings that precede NumPy, then the command line."""

import io
import os
import sys
import time

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # the names of glibc in malloc.h


def prepare() -> None:
    """Set the number of BLAS threads and tune the allocator, before NumPy is imported.

    The matrix products here are thin: a second BLAS thread gains nothing and costs waiting. glibc
    returns every large temporary array to the system and pays its page faults again in the next
    step, unless it is told to keep them.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    try:
        import ctypes

        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 1 << 30)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    except (ImportError, OSError, AttributeError):
        pass  # another C library: the page faults cost time, nothing else changes


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code; SIGTERM is treated as Ctrl-C."""
    start = time.perf_counter()
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
