"""Rate-distortion over lambda_rate, and the paper's Table 4: what the files consist of.

A sweep is a folder. Its points are files in a folder that is named after the checksum of the scene
and the length of the trainings. A point that is there is not made again, so values, seeds and
methods can be added to a sweep.
"""

from pathlib import Path

from ...report.figures import (
    BLUE,
    LIGHT_BLUE,
    RED,
    STACK,
    pyplot,
    save_figure,
    write_csv,
)
from ...report.inspect import components
from ...training.fit import fingerprint
from ..writer import bd_rate, means, table
from . import methods
from .methods import OURS, StudyError, Task

LAMBDAS = (1e-4, 1e-3, 3e-3, 1e-2, 3e-2)
COLORS = (*STACK[1:], RED, LIGHT_BLUE)
COLUMNS = {
    "lambda_rate": "{lambda_rate:g}",
    "seeds": "{seeds}",
    "estimated": "{estimated_bytes:,.0f}",
    "bytes": "{bytes:,.0f}",
    "of anchors": "{anchor_bytes:,.0f}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "SSIM": "{ssim:.4f}",
}
# Table 4: its rows, the sections of a file that they are, and the percent of the paper's two files
# of T-Rex, at a low and at a high rate.
PARTS = {
    "anchor position": (("positions",), (23.9, 13.2)),
    "anchor feature": (("features",), (4.2, 21.4)),
    "anchor scale": (("scales", "offset_scales"), (11.4, 11.1)),
    "Gaussian offsets": (("offsets",), (4.7, 21.1)),
    "masks": (("masks",), None),
    "hash grid": (("hash_grid",), (0.7, 2.0)),
    "deformation MLP": (("deformation_mlp",), (47.6, 26.9)),
    "other MLPs": (("anchor_mlps", "context_mlps"), (7.5, 4.2)),
    "header": (("header",), None),
}


def plan(scene, folder, lambdas=LAMBDAS, seeds=3, iterations=None, names=()):
    """All points of a sweep, as Tasks.

    `names` are baselines, which are drawn as points; our coded design among them has a curve of
    its own.
    """
    names = [name for name in methods.known(names) if name != OURS] if names else []
    length = "" if iterations is None else f"_{iterations}"
    points = Path(folder) / f"points_{fingerprint(scene):08x}{length}"
    rated = [{"lambda_rate": value} for value in lambdas]
    return [
        Task(scene, name, seed, points, iterations, changes)
        for name in (OURS, *names)
        for changes in (rated if name in methods.OWN else [{}])
        for seed in range(seeds)
    ]


def collect(tasks, folder):
    """Draw what has arrived; returns what the files in the folder hold.

    These are sweep.csv, sweep.png, and composition.csv of the first files with the highest and the
    lowest lambda_rate.
    """
    rows = methods.made(tasks)
    ours = sorted((row for row in rows if row["method"] == OURS), key=rate_of)
    if not ours:
        place = tasks[0].folder if tasks else folder
        raise StudyError(f"{place}: an empty sweep; expected at least one point with lambda_rate")
    write_csv(folder / "sweep.csv", rows)
    curves = {
        name: means([row for row in rows if row["method"] == name], "lambda_rate")
        for name in dict.fromkeys(row["method"] for row in rows)
    }
    curve = sorted(curves.pop(OURS), key=rate_of)
    draw(folder / "sweep.png", ours, curve, curves)
    ends = [max(ours, key=rate_of), ours[0]]
    parts = composition([tasks[0].folder / row["file"] for row in ends])
    write_csv(folder / "composition.csv", parts)
    return {
        "scene": ours[0]["scene"],
        "points": len(rows),
        "missing": len(tasks) - len(rows),
        "curve": curve,
        "baselines": curves,
        "bd_rate": {name: bd_rate(*map(points_of, (curve, own))) for name, own in curves.items()},
        "composition": {"lambda_rate": [*map(rate_of, ends)], "rows": parts},
    }


def rate_of(row):
    """The lambda_rate of a row."""
    return row["lambda_rate"]


def points_of(rows):
    """Bytes and PSNR of some rows."""
    return [(row["bytes"], row["psnr_db"]) for row in rows]


def composition(files):
    """The PARTS of two files, of a low and of a high rate: their bytes and percent."""
    low, high = (components(file.read_bytes()) for file in files)
    rows = []
    for name, (sections, _) in PARTS.items():
        sizes = [sum(size.get(section, 0) for section in sections) for size in (low, high)]
        row = {"component": name, "bytes_low": sizes[0], "bytes_high": sizes[1]}
        row["percent_low"] = 100 * sizes[0] / sum(low.values())
        row["percent_high"] = 100 * sizes[1] / sum(high.values())
        rows.append(row)
    return rows


def draw(path, rows, curve, others):
    """PSNR over bytes: ours as estimated and as written, every seed a dot; the baselines."""
    estimated = [{**point, "bytes": point["estimated_bytes"]} for point in curve]
    hollow = {"marker": "s", "linestyle": "--", "markerfacecolor": "white"}
    curves = {
        "p4dgs, bytes of the file": (curve, {"color": BLUE, "marker": "o"}),
        "p4dgs, estimated": (estimated, {"color": BLUE, **hollow}),
        "p4dgs, each seed": (rows, {"color": BLUE, "linestyle": "", "marker": ".", "alpha": 0.35}),
    }
    for color, (name, found) in zip(COLORS, others.items()):
        curves[name] = found, {"color": color, "marker": "D"}
    figure, ax = pyplot().subplots(figsize=(8.5, 5.5), layout="constrained")
    for label, (found, style) in curves.items():
        ax.plot(*zip(*sorted(points_of(found))), label=label, **style)
    for point, at in zip(curve, points_of(curve)):
        ax.annotate(f" {rate_of(point):g}", at, fontsize=9, va="top")
    title = f"{rows[0]['scene']}: lambda_rate beside the points"
    ax.set(xscale="log", xlabel="bytes", ylabel="PSNR of the test views (dB)", title=title)
    ax.legend(frameon=False)
    save_figure(figure, path)


def describe(result):
    """The curve, how far it spans, the BD-rate or why there is none, and Table 4 in form."""
    coded = [point["anchor_bytes"] for point in result["curve"]]
    lines = [
        f"{result['scene']}: {result['points']} points, {result['missing']} missing",
        *table(COLUMNS, result["curve"]),
        f"The coded bytes of the anchors span a factor of {max(coded) / max(min(coded), 1):.2f}.",
    ]
    for name, found in result["baselines"].items():
        rate, reason = result["bd_rate"][name]
        places = ", ".join(f"{size:,.0f} bytes at {psnr:.2f} dB" for size, psnr in points_of(found))
        against = f"no BD-rate: {reason}" if rate is None else f"BD-rate of ours {rate:+.1f} %"
        lines.append(f"{name}: {places}; {against}.")
    low, high = result["composition"]["lambda_rate"]
    columns = {
        "component": "{component}",
        f"low rate ({low:g})": "{bytes_low:,}",
        "%": "{percent_low:.1f}",
        f"high rate ({high:g})": "{bytes_high:,}",
        "% ": "{percent_high:.1f}",
        "the paper's % low": "{paper[0]:.1f}",
        "high": "{paper[1]:.1f}",
    }
    rows = [{**row, "paper": PARTS[row["component"]][1]} for row in result["composition"]["rows"]]
    names = [name for name in rows[0] if name.startswith(("bytes", "percent"))]
    total = {"component": "file", **{name: sum(row[name] for row in rows) for name in names}}
    title = "The paper's Table 4: what a file consists of at the lowest and at the highest rate"
    return "\n".join([*lines, "", title, *table(columns, [*rows, total])])
