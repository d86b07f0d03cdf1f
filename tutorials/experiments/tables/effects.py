"""What each effect of a scene gains: trainings with the scene's list and with one effect switched.

All have the same seeds. A training whose pictures are those of an empty scene draws nothing: what
it lacks decides whether anything is drawn, and a difference to its PSNR is no gain.
"""

import numpy as np

from p4dgs_ref.lab.effect_ledger import toggle_effect
from p4dgs_ref.lab.writer import group_rows, text_table
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.training.presets import TINY

from .methods import PAPERS, task_of
from .writer import with_error

ITERATIONS = TINY.iterations
AS_LISTED = "as listed"
COLUMNS = {"training": "{label}", "PSNR dB": "{low:.2f} to {high:.2f}", "dB": "{gain}"}


def plan(scene, seeds, iterations):
    """The Tasks of all lists and seeds; one seed of all comes before the next."""
    command = f"python -m tutorials.experiments.tables effects {scene.name}"
    command += f" --seeds {seeds} --iterations {iterations}"
    builds = {AS_LISTED: scene}
    for effect in MODEL_EFFECTS:
        how = "without" if effect in scene.effects else "with"
        builds[f"{how} {effect}"] = toggle_effect(scene, effect)
    return [
        task_of(build, PAPERS, seed, iterations, command)._replace(name=label)
        for seed in range(seeds)
        for label, build in builds.items()
    ]


def summaries(found, empty):
    """A row for each list: the PSNR of its seeds, and what it changes against the scene's list.

    `empty` is the PSNR of an empty scene. A training within 0.01 dB of it draws nothing.
    """
    of = {
        label: [row["psnr_db"] for row in rows]
        for (label,), rows in group_rows(found, "label").items()
    }
    for label, reached in of.items():
        nothing = sum(abs(psnr - empty) < 0.01 for psnr in reached)
        gain = with_error(np.subtract(reached, of[AS_LISTED]))
        if nothing:
            gain = f"draws nothing ({nothing} of {len(reached)})"
        gain = "-" if label == AS_LISTED else gain
        yield {"label": label, "low": min(reached), "high": max(reached), "gain": gain}


def psnr_of_nothing(scene):
    """The mean PSNR of the test views in dB where only the background is drawn."""
    errors = [np.mean((view.image - scene.background) ** 2) for view in scene.test]
    return np.mean(-10 * np.log10(errors))


def show(scene, tasks, found):
    """Print what the scene's list gains over lists with one effect more or less."""
    print(f"{scene.name}; dB against the list of the scene, ± twice the standard error over seeds")
    print(*text_table(COLUMNS, summaries(found, psnr_of_nothing(scene))), sep="\n")
