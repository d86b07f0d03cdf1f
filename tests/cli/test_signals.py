"""Ctrl-C, SIGTERM, SIGHUP: one line, exit code 130, no half-written file, whenever they come."""

import itertools
import signal
import threading
import time

import pytest

from p4dgs_ref.signals import deferred, handled, interrupt
from tests import ROOT
from tests.processes import start
from tests.sampling import few

NUMBERS = {"INT": signal.SIGINT, "TERM": signal.SIGTERM, "HUP": getattr(signal, "SIGHUP", None)}
# Before the import of a module, say so and wait, as a slow disk would.
SLOW = """
import sys, time
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            print("ready", flush=True)
            time.sleep(0.3)
sys.meta_path.insert(0, Slow())
"""
CONSOLE_SCRIPT = "from p4dgs_ref.__main__ import main; sys.exit(main({argv!r}))"
MODULE = (
    "import runpy; sys.argv = ['x', *{argv!r}]; runpy.run_module('p4dgs_ref', None, '__main__')"
)


def stop(process, name):
    """Send the signal and return what was printed to stderr; the exit code must be 130."""
    process.send_signal(NUMBERS[name])
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    return err


WAYS = {"console script": CONSOLE_SCRIPT, "python -m": MODULE}
MODULES = ("argparse", "numpy", "scipy", "p4dgs_ref.scenes.load")


@pytest.mark.posix("sends no signals to other processes")
@pytest.mark.parametrize("name, way, module", few(itertools.product(NUMBERS, WAYS, MODULES), 1, 8))
def test_during_an_import(tmp_path, name, way, module):
    argv = ["train", "bouncing", "-o", "run", "--preset", "smoke", "--quiet"]
    code = SLOW.format(module=module) + WAYS[way].format(argv=argv)
    process = start("-c", code, cwd=tmp_path)
    assert process.stdout.readline() == "ready\n"
    assert stop(process, name).startswith("p4dgs-ref: stopped") and not list(tmp_path.iterdir())


RUN = "train bouncing -o run --downscale 4 --quiet"
KEPT = "; if the run folder has a checkpoint, the same command with --resume continues"
LOST = "; nothing is kept before the training ends"
SAID = {  # of a command that was stopped
    "train": KEPT,
    "demo": f"{LOST}; `p4dgs-ref train` keeps checkpoints, from which --resume continues",
}
# Commands, and the file that is there when they are at work.
LINES = {
    RUN: "run/checkpoint.npz",
    "render {files}/bouncing.p4dgs -o out --frames 1000 --size 64": "out/.p4dgs-part-*/t_002.png",
    "demo bouncing -o out": "out/.p4dgs-part-*",
    "evaluate {files}/bouncing.p4dgs bouncing -o out": "out/.p4dgs-part-*",
    "accuracy -o out": "out/.p4dgs-part-*",
    "effects bouncing -o out": "out/.p4dgs-part-*",
    "stability -o out": "out/.p4dgs-part-*",
    f"simulate {ROOT}/tiny_scenes/bouncing/scene.json -o out": "out/.p4dgs-part-*",
}


def at_work(line, cwd, pattern):
    """Start a command and wait until it has begun to write."""
    process = start("-m", "p4dgs_ref", *line.split(), cwd=cwd)
    while not any(cwd.glob(pattern)):
        assert process.poll() is None
        time.sleep(0.02)
    return process


@pytest.mark.slow
@pytest.mark.parametrize("line, name", [*zip(LINES, itertools.cycle(NUMBERS))])
def test_long_commands_stop_cleanly(tmp_path, files, line, name):
    """Nothing is left behind, but for the checkpoint of a training, which says how to go on."""
    process = at_work(line.format(files=files), tmp_path, LINES[line])
    time.sleep(0.1)
    err, said = stop(process, name), SAID.get(line.split()[0], "")
    assert err.endswith(f"p4dgs-ref: stopped{said}\n") and "Traceback" not in err
    left = [path.name for path in tmp_path.rglob("*")]
    assert left == (["run", "checkpoint.npz"] if line == RUN else [])


def test_handlers_are_put_back_and_others_are_left_alone():
    def own(*arguments):
        pass

    before = {number: signal.signal(number, signal.SIG_DFL) for number in (2, 15)}
    try:
        signal.signal(signal.SIGTERM, own)
        with handled(interrupt):
            assert signal.getsignal(signal.SIGINT) is interrupt
            assert signal.getsignal(signal.SIGTERM) is own
            with pytest.raises(KeyboardInterrupt), deferred() as asked:
                signal.raise_signal(signal.SIGINT)
                assert asked == [signal.SIGINT]
                with pytest.raises(KeyboardInterrupt):
                    signal.raise_signal(signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is interrupt
        assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with handled(interrupt):
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_other_threads_change_no_handler():
    seen = []

    def work():
        with handled(interrupt):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGTERM)]


class Dying:
    """An object in whose destructor a signal arrives."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.01)  # Python calls the handler here


def test_a_signal_in_a_destructor_is_not_lost():
    """Python prints and forgets what a destructor raises."""
    with pytest.raises(KeyboardInterrupt), handled(interrupt):
        Dying()
        for _ in range(1000):  # the signal is sent again by another thread, and cuts no sleep short
            time.sleep(0.01)
