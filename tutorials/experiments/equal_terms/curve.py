"""PSNR against bytes: every method over its own size, in two storages, and the paper's Table 4.

A point is a method with changes of its preset and a storage: as the authors of the method store it,
or coded alike (`baselines.coded`). It is drawn at its mean over scenes and seeds. A method's curve
goes through its best points: those with a higher PSNR on held-back views than all smaller files of
this method and storage. So the sizes, steps and lengths of trainings are chosen without the test
views, whose PSNR is drawn. The envelope goes through the best points of all explicit methods, that
is, of all baselines. Points that lack seeds of their method are on no curve.
"""

import numpy as np

from p4dgs_ref.report.figures import (
    BLUE,
    LIGHT_BLUE,
    RED,
    STACK,
    literal,
    save_figure,
    styled,
    subplots,
    write_csv,
)
from p4dgs_ref.report.inspect import components
from .. import StudyError, baselines
from p4dgs_ref.writer import (
    bd_rate,
    best,
    factors,
    grouped,
    of_every_seed,
    points_of,
    seeds_of,
    text_table,
)
from . import hundredfold, methods
from .compare import BASELINES
from .methods import ALIKE, AS_STORED, CODED, HALF, OUR_PRESETS, OURS

GRID = (
    *({"gaussians": n, "sh_degree": d} for n in (200, 400, 800, 1600) for d in (0, 1)),
    {"gaussians": 800, "sh_degree": 3},
)
# Deformation networks half as wide as those of the presets, in our designs and in D3DGS.
NARROW = {"deformation": (32, 32)}
SINGLE = {"preset": "small_coded", "d": 8}  # single children
# They need less than their preset has: the deformation network of `tiny`, and coarse offset scales,
# which their own offsets make nearly redundant (found on held-back views).
LEAN = {"deformation": (64, 64), "Q_l": 0.1}
# The points of each method. To add one, add a row; `preset` names another preset to start from.
# Table 4 is about the first two.
SIZES = {
    OURS: (
        {"lambda_rate": 0.01},
        {},
        {"anchors": 400},
        {"anchors": 400, "lambda_rate": 0.003},
        {"anchors": 800},
        NARROW,
        {"anchors": 400, **NARROW},
        {"anchors": 800, **NARROW},
    ),
    CODED: (
        {"lambda_rate": 0.003},
        {},
        {"anchors": 400},
        {"anchors": 400, "lambda_rate": 0.002},
        {**SINGLE, "anchors": 700, "lambda_rate": 0.0005},
        {**SINGLE, "lambda_rate": 0.00025},
        {"preset": "small_coded"},
        {"lambda_rate": 0.003, **NARROW},
        NARROW,
        *(
            {**SINGLE, "anchors": anchors, "lambda_rate": price, **LEAN, **width}
            for anchors, price in ((400, 0.001), (700, 0.0005), (1000, 0.00025))
            for width in ({}, NARROW)
        ),
    ),
    **dict.fromkeys(baselines.METHODS, GRID),
    "d3dgs_small": (
        *GRID,
        *(
            {"gaussians": n, "sh_degree": d, **NARROW}
            for n, d in ((400, 0), (400, 1), (800, 0), (800, 1), (1600, 0))
        ),
    ),
}
LENGTHS = 6500, 3800  # iterations; the shorter ones with one seed
ONE_SEED = ("d3dgs", "hexplane", "gaussian4d")  # far from every envelope; in full length alone
LOSSES = (5e-4, 2e-3, 8e-3)  # of what is coded alike: the price of the error against bits
STORAGES = {method: [(ALIKE, loss) for loss in LOSSES] for method in (OURS, *baselines.METHODS)}
STORAGES["d3dgs_small"].append((HALF, None))
DEPTH = 2  # dB below our lowest point, where the picture ends
ENVELOPE = "envelope"  # of the explicit methods
NAMES = {
    OURS: "P-4DGS, the paper's design",
    CODED: "ours: networks coded, too",
    "d3dgs": "D3DGS, its authors' network",
    "d3dgs_small": "D3DGS, network of our size",
    "hexplane": "4DHexPlane",
    "gaussian4d": "4DGS",
    ENVELOPE: "envelope of the explicit methods",
}
COLORS = dict(zip(SIZES, (LIGHT_BLUE, BLUE, RED, *STACK[1:])))
MEAN = "mean"  # over the scenes
COLUMNS = {
    "point": "{label}",
    "seeds": "{seeds}",
    "iterations": "{iterations:,}",
    "bytes": "{bytes:,.0f}",
    "by zlib": "{zlib_bytes:,.0f}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "held back": "{held_back_db:.2f}",
    "SSIM": "{ssim:.4f}",
    "training s": "{train_seconds:.0f}",
}
AGAINST = {
    "scene": "{scene}",
    "against": "{against}",
    "others": "{name}",
    "storage": "{storage}",
    "dB": "{low:.2f} to {high:.2f}",
    "times the bytes, least": "{least:.2f}",
    "median": "{median:.2f}",
    "±": "{median_spread:.2f}",
    "BD-rate %": "{bd_rate:+.0f}",
}
SHORTER = {
    "fewer iterations": "{name}",
    "storage": "{storage}",
    "files": "{files}",
    "held back, mean dB": "{mean:+.2f}",
    "best dB": "{best:+.2f}",
    "times the bytes": "{bytes:.2f}",
}
# Table 4: its rows, the sections of a file that they are, and the percent of the paper's two files
# of T-Rex, at a low and at a high rate.
PARTS = {
    "anchor position": (("positions",), 23.9, 13.2),
    "anchor feature": (("features",), 4.2, 21.4),
    "anchor scale": (("scales", "offset_scales"), 11.4, 11.1),
    "Gaussian offsets": (("offsets",), 4.7, 21.1),
    "masks": (("masks",), None, None),
    "hash grid": (("hash_grid",), 0.7, 2.0),
    "deformation MLP": (("deformation_mlp",), 47.6, 26.9),
    "other MLPs": (("anchor_mlps", "context_mlps"), 7.5, 4.2),
    "header": (("header",), None, None),
}
TABLE_4 = {
    "component": "{component}",
    "low rate": "{bytes_low:,}",
    "%": "{percent_low:.1f}",
    "high rate": "{bytes_high:,}",
    "% ": "{percent_high:.1f}",
    "the paper's % low": "{paper_low:.1f}",
    "high": "{paper_high:.1f}",
}


def plan(scenes, folder, names=(), seeds=3, iterations=None):
    """The Tasks of all points.

    `names` are those of methods, nothing means all; our two designs are always there. Without
    `iterations` the trainings have both LENGTHS, those of ONE_SEED the first. Raises StudyError for
    an unknown method.
    """
    names = methods.known([*OUR_PRESETS, *(names or baselines.METHODS)])
    lengths = [iterations] if iterations else LENGTHS
    tasks = [
        task
        for length in lengths
        for task in methods.plan(
            SIZES, names, scenes, folder, seeds, length, "compare --curve", STORAGES
        )
        # A training differs in one of these at most: a far method, a shorter length, another seed.
        if (task.method in ONE_SEED) + (length != lengths[0]) + (task.seed > 0) < 2
    ]
    return sorted(tasks, key=lambda task: task.seed)


def collect(tasks, folder):
    """Draw what the Tasks have made; returns the points and how ours compare with the others.

    The files are curve.csv, curve.png, composition.csv of two files of the first scene, and
    hundredfold.csv and .png where the Tasks have its scenes.
    """
    rows = methods.made(tasks)
    ours = [task for task in tasks if task.method == OURS and task.storage == AS_STORED][:2]
    if len(methods.made(ours)) < 2:
        expected = " and ".join(task.label for task in ours)
        raise StudyError(f"{ours[0].folder}: expected the rows of {expected}, from --curve")
    write_csv(folder / "curve.csv", rows)
    draw_curves(folder / "curve.png", rows)
    curves = curves_of(points_of(of_every_seed(rows)))
    parts = composition([task.path for task in ours])
    write_csv(folder / "composition.csv", parts)
    steps = hundredfold.steps(rows)
    if steps:
        write_csv(folder / "hundredfold.csv", steps)
        hundredfold.draw_steps(folder / "hundredfold.png", steps)
    return {
        "title": title_of(rows),
        "rows": rows,
        "points": points_of(rows),
        "envelopes": {
            storage: [point["label"] for point in curves[ENVELOPE, storage]]
            for storage in (AS_STORED, ALIKE)
        },
        "against": comparisons(rows),
        "shorter": shorter(rows),
        "hundredfold": steps,
        "composition": {
            "lambda_rate": [methods.preset_of(task).lambda_rate for task in ours],
            "rows": parts,
        },
    }


def title_of(rows):
    """The scenes and the seeds of rows."""
    return f"{', '.join(dict.fromkeys(row['scene'] for row in rows))}; {seeds_of(rows)}"


def curves_of(points):
    """The best points of each method and storage, and of all explicit methods.

    {(method, storage): points}; our coded design, which is stored in one way, is in both storages.
    """
    curves = {}
    for storage in (AS_STORED, ALIKE):
        for method in (*SIZES, ENVELOPE):
            named = baselines.METHODS if method == ENVELOPE else [method]
            stored = AS_STORED if method == CODED else storage
            curves[method, storage] = best(
                p for p in points if p["method"] in named and p["storage"] == stored
            )
    return curves


def pairs_of(points):
    """The curve (bytes, PSNR) of some points."""
    return [(point["bytes"], point["psnr_db"]) for point in points]


def comparisons(rows):
    """How many times the bytes of ours the others need, in the mean and on each scene.

    Against our coded design and against the paper's, which is stored as the others are. Half the
    range of the median over the seeds that all have is `median_spread`.
    """
    rows = of_every_seed(rows)
    scenes, seeds = ([*dict.fromkeys(row[name] for row in rows)] for name in ("scene", "seed"))
    found = []
    for scene in [MEAN, *(scenes if len(scenes) > 1 else ())]:
        own = [row for row in rows if scene in (MEAN, row["scene"])]
        curves = curves_of(points_of(own))
        each = [curves_of(points_of([r for r in own if r["seed"] == seed])) for seed in seeds]
        for ours in (CODED, OURS):
            for (method, storage), points in curves.items():
                if method not in OUR_PRESETS or (method, ours) == (OURS, CODED):
                    pairs = [(one[ours, storage], one[method, storage]) for one in (curves, *each)]
                    row = against(*pairs[0])
                    medians = [against(*pair).get("median") for pair in pairs[1:] if all(pair)]
                    if row and len(medians) > 1 and None not in medians:
                        row["median_spread"] = float(np.ptp(medians) / 2)
                    if row:
                        names = dict(scene=scene, against=ours, name=method, storage=storage)
                        found.append({**names, **row})
    return found


def against(ours, others):
    """The factors of others' bytes over ours, and the BD-rate of ours in percent or None.

    On both sides, points that are not better on the test views than all smaller ones are left out.
    """
    if not ours or not others:
        return {}
    curves = pairs_of(ours), pairs_of(others)
    found = factors(*curves)
    return found and {**found, "bd_rate": bd_rate(*curves)[0]}


def shorter(rows):
    """What fewer iterations change, file by file: PSNR of held-back views, and bytes."""
    found, which = [], lambda row: tuple(row[name] for name in ("scene", "label", "seed"))
    for (method, storage), group in grouped(rows, "method", "storage").items():
        length = max(row["iterations"] for row in group)
        longest = {which(row): row for row in group if row["iterations"] == length}
        pairs = [
            (row["held_back_db"] - other["held_back_db"], row["bytes"] / other["bytes"])
            for row in group
            for other in [longest.get(which(row))]
            if other and row is not other
        ]
        if pairs:
            gains, sizes = zip(*pairs)
            found.append(
                {
                    "name": method,
                    "storage": storage,
                    "files": len(pairs),
                    "mean": float(np.mean(gains)),
                    "best": max(gains),
                    "bytes": float(np.mean(sizes)),
                }
            )
    return found


def composition(files):
    """The PARTS of two files, of a low and of a high rate, and the whole: bytes and percent."""
    sizes = [components(file.read_bytes()) for file in files]
    low, high = (sum(size.values()) for size in sizes)
    return [
        {
            "component": name,
            "bytes_low": bytes_low,
            "bytes_high": bytes_high,
            "percent_low": 100 * bytes_low / low,
            "percent_high": 100 * bytes_high / high,
            "paper_low": paper_low,
            "paper_high": paper_high,
        }
        for name, (sections, paper_low, paper_high) in {
            **PARTS,
            "file": (tuple(sizes[0]), None, None),
        }.items()
        for bytes_low, bytes_high in [
            [sum(size.get(section, 0) for section in sections) for size in sizes]
        ]
    ]


@styled()
def draw_curves(path, rows):
    """PSNR over the bytes of the file: as stored by the authors to the left, coded alike right."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    curves = curves_of(points_of(of_every_seed(rows)))
    figure, axes = subplots(1, 2, figsize=(13, 6), sharey=True, width_ratios=(1.25, 1))
    titles = {AS_STORED: "files as the authors store them", ALIKE: "all files coded alike"}
    for ax, (storage, title) in zip(axes, titles.items()):
        ax.set(xscale="log", xlabel="bytes of the file", title=title)
        ax.xaxis.set(
            major_locator=LogLocator(subs=(1, 2, 5)),
            major_formatter=EngFormatter(sep=""),
            minor_formatter=NullFormatter(),
        )
        for (method, stored), chosen in curves.items():
            if stored == storage and chosen:
                draw_curve(ax, method, chosen)
    ours = [p["psnr_db"] for method in OUR_PRESETS for p in curves[method, AS_STORED]]
    axes[0].set(ylabel="PSNR of the test views (dB)", ylim=(min(ours, default=DEPTH) - DEPTH, None))
    handles = {text: handle for ax in axes for handle, text in zip(*ax.get_legend_handles_labels())}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(literal(title_of(rows)), fontsize=13)
    save_figure(figure, path)


def draw_curve(ax, method, chosen):
    """One curve; the bars are the spread over seeds."""
    x, y, spread = ([p[name] for p in chosen] for name in ("bytes", "psnr_db", "psnr_db_spread"))
    if method == ENVELOPE:
        ax.plot(x, y, color="gray", linewidth=6, alpha=0.3, label=NAMES[method], zorder=0)
    else:
        form = dict(fmt="o-", color=COLORS[method], markersize=5, label=NAMES[method])
        ax.errorbar(x, y, spread, **form)


def to_text(result):
    """The points, ours against the others, and Table 4 in form."""
    days = sorted(row["made"] for row in result["rows"])
    low, high = result["composition"]["lambda_rate"]
    edges = [
        f"The envelope of the explicit methods, {storage}: {', '.join(labels) or 'none'}."
        for storage, labels in result["envelopes"].items()
    ]
    return "\n".join(
        [
            f"{result['title']}; made {days[0]} to {days[-1]}. Every point is a mean. The column "
            "of zlib has the same integers as the coded file, compressed at level 9.",
            BASELINES,
            *text_table(COLUMNS, result["points"]),
            *edges,
            "",
            f"Bytes of others at equal PSNR against {CODED} and {OURS}, in the same storage, at "
            "every PSNR that both reach. The BD-rate is that of ours, where both curves have three "
            "points and overlap:",
            *text_table(AGAINST, result["against"]),
            "",
            *(text_table(SHORTER, result["shorter"]) + [""] if result["shorter"] else []),
            *hundredfold.to_lines(result["hundredfold"]),
            f"The paper's Table 4: what a file consists of at lambda_rate {low:g} and {high:g}",
            *text_table(TABLE_4, result["composition"]["rows"]),
        ]
    )
