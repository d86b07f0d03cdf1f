"""The paper's Tables 1 and 2 on tiny scenes: all methods by one loop, one renderer, one measure.

Rendering is timed in one process, all methods in turn.
"""

import numpy as np

from p4dgs_ref.lab.clock import alternate, disturbance, stretch_of
from p4dgs_ref.lab.writer import means, seeds_of, text_table
from p4dgs_ref.report.figures import draw_pictures, error_of

from .methods import METHODS, PAPERS, task_of
from .rows import model_of, rows

TURNS = 5  # of the pictures that are timed
ITERATIONS, QUICK = 3800, 100
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
    "frames/s": "{render_fps:.0f}",
    **{f"the paper's {name}": f"{{paper[{name}]}}" for name in PAPER},
}


def plan(scenes, seeds, iterations):
    """The Tasks of all scenes, methods and seeds."""
    names = [name for name in METHODS if name in PAPER["D-NeRF"]]
    of_scenes = " ".join(scene.name for scene in scenes)
    command = f"python -m tutorials.experiments.tables compare {of_scenes} --seeds {seeds}"
    return [
        task_of(scene, name, seed, iterations, f"{command} --iterations {iterations}")
        for seed in range(seeds)
        for scene in scenes
        for name in names
    ]


def show(scenes, tasks, folder, jobs):
    """Make the missing rows, print the tables and draw a picture."""
    found, speeds, pictures = rows(tasks, "compare", folder, jobs=jobs), [], []
    for scene in scenes:
        first = [task for task in tasks if (task.scene, task.seed) == (scene, 0)]
        models = {task.label: model_of(task, folder) for task in first}
        speeds += rendering(scene.test, models)
        pictures += rows_of_pictures(scene, models)
    speed = {row["label"]: row["render_fps"] for row in means(speeds, "label")}
    summary = {row["label"]: row for row in means(found, "label")}
    for label, row in summary.items():
        row["times"] = row["bytes"] / summary[PAPERS]["bytes"]
        row["render_fps"] = speed[label]
        row["paper"] = {name: cells.get(label, "-") for name, cells in PAPER.items()}
    draw_pictures(folder / "compare.png", "one test view, not used in training", pictures)
    print(f"{', '.join(scene.name for scene in scenes)}; {found[0]['iterations']:,} iterations; ")
    print(f"{seeds_of(found)}. Files are as their authors store them: {PAPERS} entropy coded with")
    print("float16 networks, the others float32. The paper's columns: PSNR, SSIM, MB, frames/s.")
    print(*text_table(COLUMNS, summary.values()), sep="\n")
    print(disturbance(stretch_of(speeds)))


def rendering(views, models):
    """Rows {label, seed, render_fps, stretch} of models that render some views in turn."""
    functions = {
        name: lambda model=model: [model.render(view.camera, view.time) for view in views]
        for name, model in models.items()
    }
    return [
        {
            "label": name,
            "seed": 0,
            "render_fps": 1e3 * len(views) / times.median,
            "stretch": times.stretch,
        }
        for name, times in alternate(functions, TURNS).items()
    ]


def rows_of_pictures(scene, models):
    """One test view of a scene, the truth and all methods, and below them their errors."""
    view = sorted(scene.test, key=lambda view: view.time)[len(scene.test) // 2]
    drawn = [model.render(view.camera, view.time) for model in models.values()]
    images = [view.image, *np.clip(drawn, 0, 1)]
    return [
        (f"{scene.name}, t = {view.time:.2f}", [*zip(images, ("truth", *models))]),
        ("absolute error", [error_of(image, view.image) for image in images]),
    ]
