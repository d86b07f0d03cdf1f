"""Commands in processes of their own, to which Ctrl-C can be sent."""

import os
import signal
import subprocess
import sys
from pathlib import Path


def start(*options, cwd=None):
    """Start Python with options; Ctrl-C reaches it, also where the tests themselves ignore it."""
    return subprocess.Popen(
        [sys.executable, *options],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
