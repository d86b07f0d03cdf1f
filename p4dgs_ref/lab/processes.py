"""Independent calls in several processes, which end with their parent. Never for times."""

import multiprocessing
import os
import signal
import threading
import warnings
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from ..arithmetic import keep_pages
from ..signals import SIGNALS, deferred

UNGUARDED = 70  # exit code of a worker that the script would let start workers


def begin():
    """What a worker does first. It has inherited the kernels and the number of BLAS threads."""
    keep_pages()
    # Those that reach all processes of a terminal; the parent stops its workers by SIGTERM.
    for number in SIGNALS - {signal.SIGTERM}:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent():
    """Wait in a worker until its parent has ended, however it did, then end the worker."""
    multiprocessing.parent_process().join()
    os._exit(1)


def recorded(function, *arguments):
    """The result of a call in a worker, and the warnings that it gave."""
    with warnings.catch_warnings(record=True) as given:
        result = function(*arguments)
    return result, [one.message for one in given]


def received(result, given):
    """The result of a call in a worker; its warnings are given again, by this process."""
    for warning in given:
        warnings.warn(warning, stacklevel=3)
    return result


@contextmanager
def processes(jobs):
    """Yield `start(function, *arguments)`, which calls a function in one of `jobs` processes.

    `start` returns at once; what it returns waits for the result when it is called. The processes
    end with this context, also where it is left early. Raises ChildProcessError where one of them
    ends before its work is done.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(UNGUARDED)  # a worker that imports the script may start none
    others, workers = set(multiprocessing.active_children()), set()
    pool = ProcessPoolExecutor(
        jobs,
        multiprocessing.get_context("spawn"),
        initializer=begin,
    )

    def start(function, *arguments):
        # A process that has not read what it is to do when its parent is interrupted ends with a
        # traceback.
        with deferred():
            future = pool.submit(recorded, function, *arguments)
            workers.update(multiprocessing.active_children())
        return lambda: received(*future.result())

    try:
        yield start
    except BrokenProcessPool:
        pool.shutdown()  # the exit codes of all are known then
        is_unguarded = UNGUARDED in {process.exitcode for process in workers - others}
        raise ChildProcessError(
            "a worker process ran the script, which starts workers itself; expected its calls "
            'below `if __name__ == "__main__":`, or jobs=1'
            if is_unguarded
            else "a worker process was killed, probably because memory ran out; --jobs 1 (jobs=1) "
            "needs the least"
        ) from None
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)


def in_processes(function, tasks, jobs):
    """Yield function(task) for every task of a list, in their order, from `jobs` processes.

    With one job everything runs in this process. A task and its result must be picklable. The
    processes end with this generator, also where it is stopped early.
    """
    if min(jobs, len(tasks)) <= 1:
        yield from map(function, tasks)
    else:
        with processes(min(jobs, len(tasks))) as start:
            for result in [start(function, task) for task in tasks]:
                yield result()
