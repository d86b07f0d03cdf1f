"""Independent trainings in several processes. Studies never take times in them."""

import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager


@contextmanager
def processes(jobs):
    """A pool of processes, which end with this context, also where it is left early."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        jobs,
        multiprocessing.get_context("spawn"),
        # Ctrl-C reaches all processes of a terminal; this one stops the others.
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    )
    try:
        yield pool
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)


def in_processes(function, tasks, jobs):
    """Yield function(task) for every task, in their order, computed in `jobs` processes.

    With one job everything runs in this process. A task and its result must be picklable. The
    processes end with this generator, also where it is stopped early.
    """
    tasks = list(tasks)
    if min(jobs, len(tasks)) <= 1:
        yield from map(function, tasks)
        return
    with processes(min(jobs, len(tasks))) as pool:
        yield from pool.map(function, tasks)
