"""`python -m p4dgs_ref` and `p4dgs-ref`: one BLAS thread and a tuned allocator first, then the command line."""

import ctypes
import os
import sys
import time

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # glibc's names in malloc.h


def prepare():
    """Settle what must be settled before NumPy is imported.

    Products here are thin: a second BLAS thread gains nothing and waits for the first.  By default glibc returns
    every large temporary to the system and pays its page faults again at the next step; keep them instead.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    try:
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, 1 << 30)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    except (OSError, AttributeError):
        pass  # another C library: slower by page faults, nothing else


def main(argv=None):
    """Run the command line; returns the exit code."""
    start = time.perf_counter()
    prepare()
    from .cli.parser import run

    return run(sys.argv[1:] if argv is None else argv, start)


if __name__ == "__main__":
    sys.exit(main())
