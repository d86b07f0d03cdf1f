"""Python in processes of its own, with the package that the tests themselves import."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import p4dgs_ref
from tests import ROOT

# PYTHONPATH of every process: the package first, which the checkout has, too.
PATHS = os.pathsep.join(map(str, (Path(p4dgs_ref.__file__).resolve().parents[1], ROOT)))
# A folder where `python -c` and `python -m`, which look into it first, find no package.
ASIDE = ROOT / "tests"
CAPTURED = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8")


def run(*options, env=None):
    """Run Python with options to its end."""
    return subprocess.run([sys.executable, *options], cwd=ASIDE, env=env, **CAPTURED)


def start(*options, cwd=ASIDE):
    """Start Python with options; Ctrl-C reaches it, also where the tests themselves ignore it."""
    return subprocess.Popen(
        [sys.executable, *options],
        cwd=cwd,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **CAPTURED,
    )
