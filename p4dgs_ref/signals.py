"""Ctrl-C, SIGTERM and SIGHUP: each asks the program to stop where nothing is lost."""

import signal
import threading
from contextlib import contextmanager

# SIGHUP comes when a terminal is closed; Windows does not have it.
SIGNALS = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
RESEND_SECONDS = 0.02  # after which a signal that came too early is sent again


def interrupt(number, frame):
    """Raise KeyboardInterrupt; the handler of the command line.

    Inside an import or a `__del__` the exception could be swallowed, or turned into an ImportError.
    A signal that comes there is sent again until they are over.
    """
    while frame:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or code.co_name == "__del__":
            threading.Timer(RESEND_SECONDS, signal.raise_signal, [number]).start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


ENDING = (signal.SIG_DFL, signal.default_int_handler, interrupt)


@contextmanager
def handled(handler):
    """Within this context, `handler` receives the signals that would otherwise end the program.

    Nothing is changed in other threads, or if a signal is ignored or has a handler already.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in SIGNALS if in_main_thread}
    taken = {number: old for number, old in before.items() if old in ENDING}
    for number in taken:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in taken.items():
            signal.signal(number, old)


@contextmanager
def deferred(said=""):
    """Within this context the first signal only fills the yielded list; a second one raises.

    After a signal, KeyboardInterrupt with the message `said` is raised at the end.
    """
    asked = []

    def ask(number, frame):
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    with handled(ask):
        yield asked
    if asked:
        raise KeyboardInterrupt(said)
