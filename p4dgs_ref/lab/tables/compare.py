"""The paper's Tables 1 and 2 on tiny scenes: all methods by the same loop, renderer and measures.

The file of every method is written and read back before it is measured. Rendering is timed in one
process, all methods in turn; training seconds are processor time.
"""

import json

import numpy as np

from ...effects import moves
from ...report.evaluate import json_safe
from ...report.figures import LARGEST_ERROR, pyplot, save_figure, write_csv
from ...report.jobs import in_processes
from ...scenes import load_scene, packaged_scenes
from ..clock import disturbance, stretch_of
from . import methods
from .methods import OURS, Task, spread
from .rate_distortion import bytes_at

VERSION = 1
# PSNR in dB, SSIM, MB and frames/s of the paper's Tables 1 and 2.
PAPER = {
    "D-NeRF": {
        "p4dgs": (38.10, 0.985, 1.039, 262),
        "d3dgs": (38.28, 0.985, 39.45, 149),
        "hexplane": (34.02, 0.984, 23.45, 132),
        "gaussian4d": (32.47, 0.976, 375.34, 147),
    },
    "NeRF-DS": {
        "p4dgs": (24.18, 0.855, 0.704, 274),
        "d3dgs": (23.75, 0.847, 59.38, 58),
        "hexplane": (21.08, 0.729, 66.37, 83),
        "gaussian4d": (23.00, 0.814, 235.95, 208),
    },
}
COUNTS = ("bytes", "network_bytes", "gaussians_bytes")
MEASURES = ("psnr_db", "ssim", *COUNTS, "render_fps", "train_seconds")


def dynamic_scenes():
    """The names of the packaged scenes in which something moves."""
    return [name for name in packaged_scenes() if moves(load_scene(name).effects)]


def compare(
    scenes,
    folder,
    names=(),
    seeds=3,
    iterations=None,
    equal_time=False,
    caps=(),
    progress=lambda line: None,
    jobs=1,
):
    """Train methods on scenes and write files, compare.json, .csv and .png into a folder.

    `names` are those of methods, nothing means all; ours is always one of them. Seeds are 0 to
    seeds - 1. All take the iterations of our preset, or with `equal_time` the processor time that
    these take. `caps` are further numbers of Gaussians, with which every baseline is trained, too.
    Returns what compare.json holds. Raises StudyError for an unknown method, and ValueError for a
    scene without test views.
    """
    chosen = methods.known([OURS, *names] if names else [])
    groups = []
    for scene in scenes:
        methods.require_test_views(scene)
        length = iterations or methods.preset_of(Task(scene, OURS, 0, folder)).iterations
        tasks = [Task(scene, name, 0, folder, length) for name in chosen]
        tasks += [task._replace(most=cap) for task in tasks if not task.own for cap in caps]
        if equal_time:
            progress(f"{scene.name}: times of short trainings")
            tasks = methods.equal_times(tasks)
        groups += [[task._replace(seed=seed) for task in tasks] for seed in range(seeds)]
    total, trained = sum(map(len, groups)), []
    for row in in_processes(methods.train, [task for tasks in groups for task in tasks], jobs):
        trained.append(row)
        progress(f"{len(trained)} of {total} trainings")
    rows, shown = [], {}
    for tasks in groups:
        progress(f"{tasks[0].scene.name}: measuring")
        measured, pictures = methods.measure(tasks)
        rows += [{**trained[len(rows) + i], **row} for i, row in enumerate(measured)]
        if tasks[0].seed == 0:
            shown[tasks[0].scene.name] = tasks[0].scene, pictures[: len(chosen)]
    return written(folder, rows, shown, chosen, equal_time)


def written(folder, rows, shown, chosen, equal_time):
    """Write the results into the folder and return what compare.json holds."""
    full = [row for row in rows if row["most"] is None]
    fewer = [row for row in rows if row["most"] is not None]
    result = {
        "version": VERSION,
        "equal": "processor time" if equal_time else "iterations",
        "methods": [json_safe(row) for row in full],
        "fewer": [json_safe(row) for row in fewer],
        "summary": [summary(full, name) for name in chosen],
        "against": [against(full, fewer, name) for name in chosen[1:]],
        "stretch": stretch_of(rows),
    }
    (folder / "compare.json").write_text(json.dumps(result, indent=1) + "\n")
    write_csv(folder / "compare.csv", rows)
    draw_grid(folder / "compare.png", shown, chosen)
    return result


def select(rows, method):
    """The rows of a method."""
    return [row for row in rows if row["method"] == method]


def by_seed(rows, key):
    """The means over the scenes of each seed."""
    return [np.mean([row[key] for row in rows if row["seed"] == s]) for s in seeds_of(rows)]


def seeds_of(rows):
    """The seeds of some rows."""
    return sorted({row["seed"] for row in rows})


def summary(rows, method):
    """The means of a method over scenes and seeds; PSNR and SSIM with half the range of seeds."""
    own = select(rows, method)
    found = {key: spread(by_seed(own, key)) for key in MEASURES}
    spreads = {f"{key}_spread": found[key][1] for key in MEASURES[:2]}
    paper = {name: table.get(method) for name, table in PAPER.items()}
    return {"method": method, **{k: v[0] for k, v in found.items()}, **spreads, "paper": paper}


def against(rows, fewer, method):
    """A baseline against ours: ratio of the bytes and of frames/s, and the pairs' PSNR.

    The ratio of the bytes is the sum of the shares of its network, Gaussians and text. Where files
    with fewer Gaussians were made, `bytes_at_our_psnr` is read off the curve through all of them.
    """
    ours, theirs = summary(rows, OURS), summary(rows, method)
    pairs = zip(by_seed(select(rows, OURS), "psnr_db"), by_seed(select(rows, method), "psnr_db"))
    gains = [a - b for a, b in pairs]
    curve = [(theirs["bytes"], theirs["psnr_db"])]
    for cap in sorted({row["most"] for row in fewer}):
        point = summary([row for row in fewer if row["most"] == cap], method)
        curve.append((point["bytes"], point["psnr_db"]))
    size, reason = bytes_at(curve, ours["psnr_db"])
    return {
        "method": method,
        "ratio": theirs["bytes"] / ours["bytes"],
        "network_share": theirs["network_bytes"] / ours["bytes"],
        "gaussians_share": theirs["gaussians_bytes"] / ours["bytes"],
        "network_ratio": theirs["network_bytes"] / ours["network_bytes"],
        "gaussians_ratio": theirs["gaussians_bytes"] / ours["gaussians_bytes"],
        "psnr_gain": spread(gains)[0],
        "psnr_gain_range": [float(min(gains)), float(max(gains))],
        "fps_ratio": ours["render_fps"] / theirs["render_fps"],
        "curve": curve,
        "bytes_at_our_psnr": size,
        "reason": reason,
    }


# --- text ----------------------------------------------------------------------------------------
HEADING = "PSNR dB|SSIM|bytes|network|Gaussians|frames/s|train s".split("|")


def describe(result):
    """Tables 1 and 2 in form, a table for each scene, and what the ratios mean."""
    rows = result["methods"]
    scenes, seeds = list(dict.fromkeys(row["scene"] for row in rows)), len(seeds_of(rows))
    table = [["method", *HEADING, *(f"the paper's {name}" for name in PAPER)]]
    for own in result["summary"]:
        table.append([*cells(own), *map(printed, own["paper"].values())])
    lines = [
        f"Mean over {', '.join(scenes)}; {seeds} seed{'s' * (seeds > 1)}, ± half their range; "
        f"equal {result['equal']}; bytes of the file, of which network (also planes and hash "
        "grid) and Gaussians; training in processor seconds. The paper's columns: dB, SSIM, MB, "
        "frames/s, on its scenes and graphics card.",
        *methods.aligned(table),
        "",
    ]
    for scene in scenes if len(scenes) > 1 else ():
        own = [row for row in rows if row["scene"] == scene]
        found = [cells(summary(own, method["method"])) for method in result["summary"]]
        lines += [*methods.aligned([[scene, *HEADING], *found]), ""]
    lines += [*(sentence(other) for other in result["against"]), disturbance(result["stretch"])]
    return "\n".join(lines).rstrip()


def cells(own):
    """One line of a table from a summary: the method and what HEADING says."""
    return [
        own["method"],
        f"{own['psnr_db']:.2f} ±{own['psnr_db_spread']:.2f}",
        f"{own['ssim']:.4f} ±{own['ssim_spread']:.4f}",
        *(f"{own[key]:,.0f}" for key in COUNTS),
        f"{own['render_fps']:.0f}",
        f"{own['train_seconds']:.0f}",
    ]


def printed(numbers):
    """The paper's numbers of a method, or a dash."""
    return "-" if numbers is None else "{:.2f} {:.3f} {:g} {}".format(*numbers)


def sentence(other):
    """What a baseline's file and quality are against ours, and how far the ratio is fair."""
    low, high = other["psnr_gain_range"]
    lines = (
        f"{other['method']}: its file is {other['ratio']:.1f} times ours: "
        f"{other['network_share']:.1f} are its network and {other['gaussians_share']:.1f} its "
        f"Gaussians. Its network is {other['network_ratio']:.1f} times our networks, its Gaussians "
        f"{other['gaussians_ratio']:.1f} times ours. Our PSNR minus its: "
        f"{other['psnr_gain']:+.2f} dB ({low:+.2f} to {high:+.2f}). "
        f"We render {other['fps_ratio']:.2f} times as many frames/s."
    )
    if other["bytes_at_our_psnr"]:
        size = other["bytes_at_our_psnr"]
        fair = size * other["ratio"] / other["curve"][0][0]
        lines += f" At our PSNR it needs about {size:,.0f} bytes, {fair:.1f} times ours."
    elif other["psnr_gain"] < 0:
        lines += (
            " Note: ours is below it in PSNR, so the ratio is not one at equal quality "
            f"(its files: {other['reason']}; --caps makes smaller ones)."
        )
    return lines


# --- pictures ------------------------------------------------------------------------------------
def draw_grid(path, shown, chosen):
    """For every scene one test view: truth, all methods, and below them their errors."""
    columns = ["truth", *chosen]
    figure, axes = pyplot().subplots(
        2 * len(shown),
        len(columns),
        figsize=(2.3 * len(columns), 4.9 * len(shown) + 0.9),
        squeeze=False,
        layout="constrained",
    )
    for place, (name, (scene, pictures)) in enumerate(shown.items()):
        i = int(np.argsort([view.time for view in scene.test])[len(scene.test) // 2])
        truth = scene.test[i].image
        images = [truth, *(np.clip(views[i], 0, 1) for views in pictures)]
        for top, below, title, image in zip(axes[2 * place], axes[2 * place + 1], columns, images):
            top.imshow(image)
            top.set_title(title if place == 0 else "")
            error = np.abs(image - truth).mean(axis=2)
            heat = below.imshow(error, cmap="magma", vmin=0, vmax=LARGEST_ERROR)
            below.set_title("" if image is truth else f"mean {error.mean():.3f}")
        axes[2 * place, 0].set_ylabel(f"{name}, t = {scene.test[i].time:.2f}")
        axes[2 * place + 1, 0].set_ylabel("absolute error")
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    label = "absolute error, mean of R, G, B (of 1)"
    figure.colorbar(
        heat, ax=axes, location="bottom", extend="max", aspect=50, shrink=0.6, label=label
    )
    save_figure(figure, path)
