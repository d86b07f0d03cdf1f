"""The paper's Tables 1 and 2 on tiny scenes: all methods by the same loop, renderer and measures.

Every baseline has a second row, without spherical harmonics. Rendering is timed in one process, all
methods in turn.
"""

import json

import numpy as np

from p4dgs_ref.effects import moves
from p4dgs_ref.report.figures import draw_pictures, error_of, write_csv
from p4dgs_ref.scenes import load_scene, packaged_scenes
from .. import baselines
from p4dgs_ref.clock import alternate, disturbance, stretch_of
from p4dgs_ref.writer import means, seeds_of, text_table
from . import methods
from .methods import OUR_PRESETS, OURS

TURNS = 5  # of the pictures that are timed
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
KINDS = ("network", "gaussians")  # of bytes
# Changes of the presets: every baseline also with colors that are the same from all sides.
SIZES = {
    **dict.fromkeys(OUR_PRESETS, [{}]),
    **dict.fromkeys(baselines.METHODS, [{}, {"sh_degree": 0}]),
}
BASELINES = (
    "The baselines ignore a scene's list of effects, but for occlusion, and have spherical "
    "harmonics of degree 3 where the row does not say another one (sh_degree)."
)
COLUMNS = {
    "iterations": "{iterations:,.0f}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "SSIM": "{ssim:.4f} ±{ssim_spread:.4f}",
    "bytes": "{bytes:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "frames/s": "{render_fps:.0f}",
}
OF_THE_PAPER = {f"the paper's {name}": f"{{paper[{name}]}}" for name in PAPER}


def dynamic_scenes():
    """The names of the packaged scenes in which something moves."""
    return [name for name in packaged_scenes() if moves(load_scene(name).effects)]


def plan(scenes, folder, names=(), seeds=3, iterations=None):
    """The Tasks of all scenes, seeds and methods.

    `names` are those of methods, nothing means all; ours is always one of them. Seeds are 0 to
    seeds - 1, and all methods take the same iterations. Raises StudyError for an unknown method.
    """
    names = methods.known([OURS, *names] if names else [])
    return methods.plan(SIZES, names, scenes, folder, seeds, iterations)


def collect(tasks, folder):
    """Time what the Tasks have made, and write compare.json, .csv and .png into a folder.

    Returns what compare.json holds.
    """
    rows, shown, labels = [], {}, [*dict.fromkeys(task.label for task in tasks)]
    for start in range(0, len(tasks), len(labels)):
        group = tasks[start : start + len(labels)]  # of one scene and seed
        scene = group[0].scene
        models = {task.label: methods.load(task.path) for task in group}
        speeds = rendering(scene.test, models)
        rows += [{**row, **speeds[row["label"]]} for row in methods.made(group)]
        shown.setdefault(scene.name, (scene.test, models))
    result = {
        "methods": rows,
        "summary": [
            {**row, "paper": {name: cells.get(row["label"], "-") for name, cells in PAPER.items()}}
            for row in means(rows, "label")
        ],
        "against": [against(rows, name) for name in labels[1:]],
        "stretch": stretch_of(rows),
    }
    (folder / "compare.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    write_csv(folder / "compare.csv", rows)
    draw_grid(folder / "compare.png", shown)
    return result


def rendering(views, models):
    """{name: {render_fps, stretch}} of models that render some views in turn."""
    functions = {
        name: lambda model=model: [model.render(view.camera, view.time) for view in views]
        for name, model in models.items()
    }
    return {
        name: {"render_fps": 1e3 * len(views) / times.median, "stretch": times.stretch}
        for name, times in alternate(functions, TURNS).items()
    }


def against(rows, label):
    """A baseline against the paper's design: ratios of bytes and frames/s, and PSNR minus its.

    The ratio of the bytes is the sum of the shares of its network, Gaussians and text.
    """
    mean = {row["label"]: row for row in means(rows, "label")}
    ours, theirs = mean[OURS], mean[label]
    psnr = {(row["label"], row["seed"]): row["psnr_db"] for row in means(rows, "label", "seed")}
    gains = [psnr[OURS, seed] - value for (name, seed), value in psnr.items() if name == label]
    return {
        "label": label,
        "ratio": theirs["bytes"] / ours["bytes"],
        **{f"{kind}_share": theirs[f"{kind}_bytes"] / ours["bytes"] for kind in KINDS},
        **{f"{kind}_ratio": theirs[f"{kind}_bytes"] / ours[f"{kind}_bytes"] for kind in KINDS},
        "psnr_gain": float(np.mean(gains)),
        "psnr_gain_range": [min(gains), max(gains)],
        "fps_ratio": ours["render_fps"] / theirs["render_fps"],
    }


def to_text(result):
    """Tables 1 and 2 in form, a table for each scene, and what the ratios mean."""
    rows = result["methods"]
    scenes = dict.fromkeys(row["scene"] for row in rows)
    lines = [
        f"Mean over {', '.join(scenes)}; {seeds_of(rows)}; bytes of the file, of which network "
        "(also planes and hash grid) and Gaussians. Files are as their authors store them: "
        f"{OURS} entropy coded with float16 networks, the baselines float32. The paper's columns: "
        "dB, SSIM, MB, frames/s, on its scenes and graphics card.",
        BASELINES,
        *text_table({"method": "{label}", **COLUMNS, **OF_THE_PAPER}, result["summary"]),
    ]
    for scene in scenes if len(scenes) > 1 else ():
        of_scene = means([row for row in rows if row["scene"] == scene], "label")
        lines += ["", *text_table({scene: "{label}", **COLUMNS}, of_scene)]
    lines += ["", *map(sentence, result["against"]), disturbance(result["stretch"])]
    return "\n".join(lines).rstrip()


def sentence(other):
    """A baseline's file and quality against those of the paper's design, and if this is fair."""
    low, high = other["psnr_gain_range"]
    unfair = f" Note: {OURS} is below it in PSNR, so the ratio is not one at equal quality."
    return (
        f"{other['label']}: its file is {other['ratio']:.1f} times that of {OURS}: "
        f"{other['network_share']:.1f} are its network and {other['gaussians_share']:.1f} its "
        f"Gaussians. Its network is {other['network_ratio']:.1f} times the networks of {OURS}, its "
        f"Gaussians {other['gaussians_ratio']:.1f} times the anchors. PSNR of {OURS} minus its: "
        f"{other['psnr_gain']:+.2f} dB ({low:+.2f} to {high:+.2f}). "
        f"{OURS} renders {other['fps_ratio']:.2f} times as many frames/s."
        f"{unfair if other['psnr_gain'] < 0 else ''}"
    )


def draw_grid(path, shown):
    """For every scene one test view: truth, all methods, and below them their errors."""
    rows = []
    for name, (views, models) in shown.items():
        view = sorted(views, key=lambda view: view.time)[len(views) // 2]
        drawn = [model.render(view.camera, view.time) for model in models.values()]
        images = [view.image, *np.clip(drawn, 0, 1)]
        rows.append((f"{name}, t = {view.time:.2f}", [*zip(images, ("truth", *models))]))
        rows.append(("absolute error", [error_of(image, view.image) for image in images]))
    draw_pictures(path, "one test view of each scene, not used in training", rows)
