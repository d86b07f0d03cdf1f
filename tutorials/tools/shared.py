"""What the makers of pages share: where tutorials are, how one runs, how a file is written."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2, vq

from p4dgs_ref.output import write_atomically

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"


def run(name, arguments, out):
    """Run Python without a display in `out`, where figures go. Exits with one line if it fails."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    environment = {
        **os.environ,
        "MPLBACKEND": "Agg",
        "OPENBLAS_NUM_THREADS": "1",
        "P4DGS_TUTORIALS_OUT": str(out),
        "PYTHONPATH": path,
        "PYTHONUTF8": "1",
    }
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=environment,
        cwd=out,
        capture_output=True,
        encoding="utf-8",
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        sys.exit(f"{name}, {lines[-1]}")


def write_text(path, text):
    """Write a text file in one step."""
    write_atomically(path, lambda file: file.write(text.encode()))


def in_few_colors(pixels, every=1):
    """The pixels [..., 3] in 8 bits, in at most 256 colours, chosen by one in `every` pixels.

    The two most frequent ones are among them; the others stand for rare colours as well.
    """
    flat = pixels.reshape(-1, 3)
    colors, counts = np.unique(flat[::every], axis=0, return_counts=True)
    frequent = colors[np.argsort(-counts, kind="stable")[:2]]
    others = kmeans2(colors.astype(float), min(254, len(colors)), minit="++", seed=0)[0]
    chosen = np.concatenate([frequent, np.rint(others)])
    return chosen[vq(flat.astype(float), chosen)[0]].astype(np.uint8).reshape(pixels.shape)


def markdown_table(heads, rows):
    """Return a table as Markdown."""
    lines = [f"| {' | '.join(row)} |" for row in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def file_of(equation):
    """The path in the checkout of the file that holds an equation of the table."""
    return f"{equation.forward.__module__.replace('.', '/')}.py"
