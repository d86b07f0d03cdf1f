"""Independent calls in several processes, which end with their parent; not for timing."""

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from ..arithmetic import keep_pages
from ..signals import SIGNALS, deferred


def begin():
    """Set up a worker, which has inherited the kernels and the number of BLAS threads."""
    keep_pages()
    # Ignore the signals that reach all processes of a terminal: the parent sends SIGTERM instead.
    for number in SIGNALS - {signal.SIGTERM}:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent():
    """Wait in a worker until its parent has ended for whatever reason, then end the worker."""
    multiprocessing.parent_process().join()
    os._exit(1)


def in_processes(function, tasks, jobs):
    """Yield function(task) for every task of a list, in their order, from `jobs` processes.

    With one job everything runs in this process. A task and its result must be picklable. The
    processes end with this generator, also if it is stopped early. Raises ChildProcessError
    if one of them ends before its work is done.
    """
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        yield from map(function, tasks)
        return
    others = set(multiprocessing.active_children())
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, spawn, initializer=begin)
    try:
        # A process whose parent is interrupted before it has read its task ends with a traceback.
        with deferred():
            futures = [pool.submit(function, task) for task in tasks]
        for future in futures:
            yield future.result()
    except BrokenProcessPool:
        raise ChildProcessError(
            "a worker process ended before its work was done: memory ran out, or a script starts "
            'workers outside of `if __name__ == "__main__":`'
        ) from None
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)
