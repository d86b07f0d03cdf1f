"""How long to train: the paper's design after a half and a quarter of the iterations.

The stages, dates and windows of density control are shortened with the iterations.
"""

import numpy as np

from p4dgs_ref.lab.writer import group_rows, text_table
from p4dgs_ref.training.presets import TINY

from .methods import PAPERS, task_of
from .writer import with_error

ITERATIONS = TINY.iterations
LEAST_WINDOW = 20  # iterations from one growing of anchors to the next
COLUMNS = {
    "iterations": "{iterations:,}",
    "seconds": "{seconds:.0f}",
    "PSNR dB": "{psnr_db:.2f}",
    "dB less": "{less}",
    "bytes": "{bytes:,.0f}",
}


def plan(scene, seeds, iterations):
    """The Tasks of all lengths and seeds, the longest first."""
    command = f"python -m tutorials.experiments.tables training {scene.name}"
    command += f" --seeds {seeds} --iterations {iterations}"
    tasks = []
    for n in (iterations, iterations // 2, iterations // 4):
        window = max(LEAST_WINDOW, round(n / TINY.iterations * TINY.grow_every))
        for seed in range(seeds):
            task = task_of(scene, PAPERS, seed, n, command, {"grow_every": window})
            tasks.append(task._replace(name=PAPERS))
    return tasks


def summaries(found):
    """A row for each length: medians and means over seeds, and the dB lost to the longest."""
    of = {n: rows for (n,), rows in group_rows(found, "iterations").items()}
    longest = [row["psnr_db"] for row in of[max(of)]]
    for n, rows in of.items():
        reached = [row["psnr_db"] for row in rows]
        lost = np.subtract(longest, reached)
        yield {
            "iterations": n,
            "seconds": np.median([row["train_seconds"] for row in rows]),
            "psnr_db": np.mean(reached),
            "bytes": np.mean([row["bytes"] for row in rows]),
            "less": "-" if n == max(of) else with_error(lost),
        }


def show(scene, tasks, found):
    """Print what a shorter training saves and loses."""
    print(f"{scene.name}; medians of processor seconds, means of the rest over the seeds")
    print(*text_table(COLUMNS, summaries(found)), sep="\n")
