"""The paper's Tables 1 and 2 on a tiny scene: all methods by one loop, one renderer, one measure.

Rendering is timed in one process, all methods in turn.
"""

import numpy as np

from p4dgs_ref.lab.clock import alternate, disturbance
from p4dgs_ref.lab.writer import text_table
from p4dgs_ref.report.figures import draw_pictures, error_of

from .methods import PAPERS, task_of
from .rows import model_of
from .writer import means, seeds_of

TURNS = 5  # of the pictures that are timed
ITERATIONS = 3800
# PSNR in dB, SSIM, MB and frames/s of the paper's Tables 1 and 2.
PAPER = {
    "D-NeRF": {
        "p4dgs": "38.10 0.985 1.039 262",
        "d3dgs": "38.28 0.985 39.45 149",
        "hexplane": "34.02 0.984 23.45 132",
        "gaussian4d": "32.47 0.976 375.34 147",
    },
    "NeRF-DS": {
        "p4dgs": "24.18 0.855 0.704 274",
        "d3dgs": "23.75 0.847 59.38 58",
        "hexplane": "21.08 0.729 66.37 83",
        "gaussian4d": "23.00 0.814 235.95 208",
    },
}
COLUMNS = {
    "method": "{label}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "SSIM": "{ssim:.4f}",
    "bytes": "{bytes:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "times": "{times:.1f}",
    "frames/s": "{fps:.0f}",
    **{f"the paper's {name}": f"{{paper[{name}]}}" for name in PAPER},
}


def plan(scene, seeds, iterations):
    """The Tasks of all methods and seeds."""
    command = f"python -m tutorials.experiments.tables compare {scene.name}"
    command += f" --seeds {seeds} --iterations {iterations}"
    return [
        task_of(scene, name, seed, iterations, command)
        for seed in range(seeds)
        for name in PAPER["D-NeRF"]
    ]


def show(scene, tasks, found, folder):
    """Print the table and draw a picture; times and pictures are those of the first seed."""
    models = {task.label: model_of(task, folder) for task in tasks if task.seed == 0}
    times = rendering(scene.test, models)
    draw(folder / "compare.png", scene, models)
    summary = {row["label"]: row for row in means(found, "label")}
    for name, row in summary.items():
        row["times"] = row["bytes"] / summary[PAPERS]["bytes"]
        row["fps"] = 1e3 * len(scene.test) / times[name].ms
        row["paper"] = {data: cells[name] for data, cells in PAPER.items()}
    print(
        f"{scene.name}; {tasks[0].iterations:,} iterations; {seeds_of(found)}. Bytes of the file,"
    )
    print("of which network (also planes and hash grid) and Gaussians, and times the first one's.")
    print(f"Files are as their authors store them: {PAPERS} entropy coded with float16 networks,")
    print("the others float32. The paper's columns: PSNR, SSIM, MB, frames/s.")
    print(*text_table(COLUMNS, summary.values()), sep="\n")
    print(disturbance(float(np.median([each.stretch for each in times.values()]))))


def rendering(views, models):
    """The Times of models that render some views in turn."""
    functions = {
        name: lambda model=model: [model.render(view.camera, view.time) for view in views]
        for name, model in models.items()
    }
    return alternate(functions, TURNS)


def draw(path, scene, models):
    """One test view: the truth and all methods, and below them their errors."""
    view = sorted(scene.test, key=lambda view: view.time)[len(scene.test) // 2]
    drawn = [model.render(view.camera, view.time) for model in models.values()]
    images = [view.image, *np.clip(drawn, 0, 1)]
    pictures = [*zip(images, ("truth", *models))]
    errors = [error_of(image, view.image) for image in images]
    title = f"{scene.name}, a test view, t = {view.time:.2f}"
    draw_pictures(path, title, [("", pictures), ("absolute error", errors)])
