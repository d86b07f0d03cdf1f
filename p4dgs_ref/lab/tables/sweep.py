"""Rate-distortion over lambda_rate: PSNR against the bytes that are estimated and written.

A sweep is a folder. Every point is a job of its own that leaves a file and a JSON in `points/`.
A point that is there is not made again, so a killed sweep goes on, and the jobs of a cluster can
fill one folder. `sweep.json` says what the folder is a sweep of.
"""

import json
from pathlib import Path

import numpy as np

from ...report.evaluate import evaluate, json_safe
from ...report.figures import BLUE, LIGHT_BLUE, RED, STACK, pyplot, save_figure, write_csv
from ...report.inspect import ledger
from ...report.jobs import in_processes
from ...scenes.files import read_json
from ...scenes.output import write_atomically
from . import methods
from .methods import CODED, OURS, StudyError, Task, spread
from .rate_distortion import bd_rate

VERSION = 1
COLUMNS = ("lambda_rate", "seed", "estimated_bytes", "bytes", "psnr_db", "ssim")
LAMBDAS = (1e-4, 1e-3, 3e-3, 1e-2, 3e-2)
CODED_OF_ANCHORS = ("features", "scales", "offset_scales", "offsets")  # sections of a file


def plan(scene, folder, lambdas=LAMBDAS, seeds=3, iterations=None, names=(), caps=()):
    """All points of a sweep, as Tasks, and the values for its sweep.json.

    `names` are baselines, which are drawn as points, each also with every number of Gaussians in
    `caps`; our coded design among them has a curve of its own. A folder that holds another sweep,
    or one of another version, raises StudyError.
    """
    if not lambdas:
        raise StudyError("lambda_rate: an empty sweep; expected at least one value")
    methods.require_test_views(scene)
    names = [name for name in methods.known(names) if name != OURS] if names else []
    values = {
        "version": VERSION,
        "scene": scene.name,
        "size": list(scene.train[0].image.shape[:2]),
        "lambda_rates": list(lambdas),
        "seeds": seeds,
        "iterations": iterations,
        "baselines": names,
        "caps": list(caps),
    }
    file, points = Path(folder) / "sweep.json", Path(folder) / "points"
    if file.exists():
        found = read_json(file)
        for key, value in values.items():
            if found.get(key) != value:
                raise StudyError(
                    f"{file}: {key!r}: expected {value!r} as in this sweep, found "
                    f"{found.get(key)!r}; another -o starts anew"
                )
    base = [Task(scene, OURS, seed, points, iterations) for seed in range(seeds)]
    tasks = [task._replace(changes={"lambda_rate": v}) for v in lambdas for task in base]
    if CODED in names:
        tasks += [task._replace(method=CODED) for task in tasks]
    tasks += [
        task._replace(method=name, most=most)
        for name in names
        if name != CODED
        for most in (None, *caps)
        for task in base
    ]
    return tasks, values


def record(task):
    """The JSON of a point."""
    return task.path.with_suffix(".json")


def make(task):
    """Make one point: train, write the file, read it back, measure it, and write its JSON."""
    row = {**methods.train(task), **task.changes}
    metrics, _, _ = evaluate(methods.load(task), task.scene)
    row.update({name: metrics[name] for name in ("psnr_db", "ssim", "anchors", "gaussians")})
    if task.own:
        sections = ledger(task.path.read_bytes())
        row["estimated_bytes"] = round(sum(part["estimate_bytes"] for part in sections))
        coded = [part["bytes"] for part in sections if part["name"] in CODED_OF_ANCHORS]
        row["anchor_bytes"] = sum(coded)
    text = json.dumps(json_safe(row), indent=1) + "\n"
    write_atomically(record(task), lambda file: file.write(text.encode()))
    return row


def make_missing(tasks, values, progress=lambda line: None, jobs=1):
    """Make all points that are not there; `values` are those of `plan`."""
    points = tasks[0].folder
    points.mkdir(parents=True, exist_ok=True)
    text = json.dumps(values, indent=1) + "\n"
    write_atomically(points.parent / "sweep.json", lambda file: file.write(text.encode()))
    missing = [task for task in tasks if not record(task).exists()]
    for done, _ in enumerate(in_processes(make, missing, jobs), 1):
        progress(f"{done} of {len(missing)} points")


def collect(tasks, folder):
    """Draw what has arrived: sweep.csv, baselines.csv and sweep.png; returns what they hold."""
    rows = [read_json(record(task)) for task in tasks if record(task).exists()]
    ours = [row for row in rows if row["method"] == OURS]
    if not ours:
        raise StudyError(f"{folder}: an empty sweep; expected at least one point with lambda_rate")
    others = [row for row in rows if row["method"] != OURS]
    curve = [mean_point(ours, "lambda_rate", at) for at in sorted({r["lambda_rate"] for r in ours})]
    points = {}
    for name in dict.fromkeys(row["method"] for row in others):
        own = [row for row in others if row["method"] == name]
        knob = "lambda_rate" if name == CODED else "most"
        points[name] = [mean_point(own, knob, at) for at in dict.fromkeys(r[knob] for r in own)]
    write_csv(folder / "sweep.csv", [[row[name] for name in COLUMNS] for row in ours], COLUMNS)
    if others:
        columns = list(dict.fromkeys(key for row in others for key in row))
        table = [[row.get(column) for column in columns] for row in others]
        write_csv(folder / "baselines.csv", table, columns)
    draw(folder / "sweep.png", ours, curve, points)
    return {
        "scene": ours[0]["scene"],
        "points": len(rows),
        "missing": len(tasks) - len(rows),
        "curve": curve,
        "baselines": points,
        "bd_rate": {name: bd_rate(pairs(curve), pairs(found)) for name, found in points.items()},
    }


def mean_point(rows, knob, value):
    """The means over seeds of the rows with one value of a knob, and half the range of PSNR."""
    own = [row for row in rows if row[knob] == value]
    sizes = [name for name in ("bytes", "estimated_bytes", "anchor_bytes") if name in own[0]]
    means = {name: float(np.mean([row[name] for row in own])) for name in (*sizes, "ssim")}
    psnr, half = spread([row["psnr_db"] for row in own])
    return {knob: value, "seeds": len(own), **means, "psnr_db": psnr, "psnr_db_spread": half}


def pairs(points):
    """Bytes and PSNR of some points."""
    return [(point["bytes"], point["psnr_db"]) for point in points]


def draw(path, rows, curve, points):
    """PSNR over bytes: ours as estimated and as written, every seed a dot; the baselines."""
    figure, ax = pyplot().subplots(figsize=(8.5, 5.5), layout="constrained")
    psnr = [point["psnr_db"] for point in curve]
    for key, style, label in (
        ("bytes", "o-", "p4dgs, bytes of the file"),
        ("estimated_bytes", "s--", "p4dgs, estimated"),
    ):
        fill = BLUE if key == "bytes" else "white"
        sizes = [point[key] for point in curve]
        ax.plot(sizes, psnr, style, color=BLUE, markerfacecolor=fill, label=label)
    ax.plot(*zip(*pairs(rows)), ".", color=BLUE, alpha=0.35, label="p4dgs, each seed")
    for point in curve:
        at = point["bytes"], point["psnr_db"]
        ax.annotate(f" {point['lambda_rate']:g}", at, fontsize=9, va="top")
    for color, (name, found) in zip((*STACK[1:], RED, LIGHT_BLUE), points.items()):
        ax.plot(*zip(*sorted(pairs(found))), "D-", color=color, label=name)
    ax.set(
        xscale="log",
        xlabel="bytes",
        ylabel="PSNR of the test views (dB)",
        title=f"{rows[0]['scene']}: lambda_rate beside the points",
    )
    ax.legend(frameon=False)
    save_figure(figure, path)


def describe(result):
    """The curve as a table, how far it spans, and the BD-rate or why there is none."""
    table = ["lambda_rate|seeds|estimated|bytes|of anchors|PSNR dB|SSIM".split("|")]
    for point in result["curve"]:
        sizes = [f"{point[k]:,.0f}" for k in ("estimated_bytes", "bytes", "anchor_bytes")]
        quality = f"{point['psnr_db']:.2f} ±{point['psnr_db_spread']:.2f}"
        start = [f"{point['lambda_rate']:g}", str(point["seeds"])]
        table.append([*start, *sizes, quality, f"{point['ssim']:.4f}"])
    coded = [point["anchor_bytes"] for point in result["curve"]]
    lines = [
        f"{result['scene']}: {result['points']} points, {result['missing']} missing",
        *methods.aligned(table),
        f"The coded bytes of the anchors span a factor of {max(coded) / max(min(coded), 1):.2f}.",
    ]
    for name, found in result["baselines"].items():
        rate, reason = result["bd_rate"][name]
        places = ", ".join(f"{size:,.0f} bytes at {psnr:.2f} dB" for size, psnr in pairs(found))
        against = f"no BD-rate: {reason}" if rate is None else f"BD-rate of ours {rate:+.1f} %"
        lines.append(f"{name}: {places}; {against}.")
    return "\n".join(lines)
