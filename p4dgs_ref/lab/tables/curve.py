"""PSNR against bytes: every method over its own size, and the paper's Table 4.

A point is a method with changes of its preset; it is drawn at its mean over scenes and seeds. The
envelope of the explicit methods, that is, of all baselines, is what the best of them needs for a
quality.
"""

from ...report.figures import (
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
from ...report.inspect import components
from .. import baselines
from ..writer import bd_rate, envelope, factors, front, means, seeds_of, text_table
from . import methods
from .compare import BASELINES
from .methods import CODED, OUR_PRESETS, OURS

# The points of each method. To add one, add a row; `preset` names another preset to start from.
# Table 4 is about the first two.
SIZES = {
    OURS: ({"lambda_rate": 0.01}, {}, {"anchors": 400}),
    CODED: (
        {"lambda_rate": 0.003},
        {},
        {"preset": "small_coded", "d": 8, "anchors": 700, "lambda_rate": 0.0005},
        {"preset": "small_coded", "d": 8, "lambda_rate": 0.00025},
        {"preset": "small_coded"},
    ),
    "d3dgs": ({"gaussians": 200, "sh_degree": 0}, {}),
    "d3dgs_small": (
        {"gaussians": 100, "sh_degree": 0},
        {"gaussians": 400, "sh_degree": 0},
        {"gaussians": 800, "sh_degree": 0},
        {"gaussians": 800, "sh_degree": 1},
        {},
    ),
    "hexplane": ({},),
    "gaussian4d": ({"gaussians": 500, "sh_degree": 0}, {}),
}
COLORS = dict(zip(SIZES, (LIGHT_BLUE, BLUE, RED, *STACK[1:])))
DRAWN = {"bytes": "bytes of the file", "anchor_bytes": "bytes of the coded anchors"}
EDGE = "the envelope"  # of the explicit methods
RIVAL, MAX_BYTES = "d3dgs_small", 30_000  # our best point of that size stands against its best
COLUMNS = {
    "point": "{label}",
    "seeds": "{seeds}",
    "estimated": "{estimated_bytes:,.0f}",
    "bytes": "{bytes:,.0f}",
    "of anchors": "{anchor_bytes:,.0f}",
    "PSNR dB": "{psnr_db:.2f} ±{psnr_db_spread:.2f}",
    "SSIM": "{ssim:.4f}",
}
AGAINST = {
    "against": "{name}",
    "dB": "{low:.2f} to {high:.2f}",
    "times our bytes, least": "{least:.2f}",
    "median": "{median:.2f}",
    "BD-rate of ours": "{bd_rate}",
}
BEST = {
    "scene": "{scene}",
    "dB": "{psnr_db:.2f}",
    "bytes": "{bytes:,.0f}",
    "its dB": "{their_psnr_db:.2f}",
    "its bytes": "{their_bytes:,.0f}",
    "ours minus its": "{psnr_gain:+.2f}",
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

    `names` are those of methods, nothing means all; our two designs are always there. Raises
    StudyError for an unknown method.
    """
    names = methods.known([*OUR_PRESETS, *(names or baselines.METHODS)])
    return methods.plan(SIZES, names, scenes, folder, seeds, iterations, "compare --curve")


def collect(tasks, folder):
    """Draw what the Tasks have made; returns the points and how ours compare with the others.

    The files are curve.csv, curve.png, and composition.csv of two files of the first scene.
    """
    rows = methods.made(tasks)
    write_csv(folder / "curve.csv", rows)
    points, curves, title = read(rows)
    edge = curves[EDGE]
    draw_curves(folder / "curve.png", points, edge, literal(title))
    parts = composition([task.path for task in tasks[:2]])
    write_csv(folder / "composition.csv", parts)
    return {
        "title": title,
        "rows": rows,
        "points": points,
        "envelope": [
            row["label"] for row in points if [row["bytes"], row["psnr_db"]] in edge.tolist()
        ],
        "against": [
            against(name, curves[CODED], curve)
            for name, curve in curves.items()
            if len(curve) and name != CODED
        ],
        "best": best(rows, points),
        "composition": {"lambda_rate": [row["lambda_rate"] for row in rows[:2]], "rows": parts},
    }


def read(rows):
    """The points of rows, the curves {name: points} with the envelope first, and a title."""
    points = means(rows, "label", "method")
    curves = {
        name: [(row["bytes"], row["psnr_db"]) for row in points if row["method"] == name]
        for name in dict.fromkeys(row["method"] for row in points)
    }
    edge = envelope([curve for name, curve in curves.items() if name not in OUR_PRESETS])
    title = f"{', '.join(dict.fromkeys(row['scene'] for row in rows))}; {seeds_of(rows)}"
    return points, {EDGE: edge, **curves}, title


def against(name, ours, others):
    """The factors of others' bytes over ours, and the BD-rate of ours or why there is none."""
    rate, reason = bd_rate(ours, others)
    return {"name": name, **factors(ours, others), "bd_rate": reason or f"{rate:+.1f} %"}


def best(rows, points):
    """Our best point of at most MAX_BYTES beside the best of RIVAL; a row for each scene.

    Both are chosen by the mean over the scenes. Without one of them there is no row.
    """
    groups = [
        [row for row in points if row["method"] == CODED and row["bytes"] <= MAX_BYTES],
        [row for row in points if row["method"] == RIVAL],
    ]
    if not all(groups):
        return []
    pair = [max(group, key=lambda row: row["psnr_db"])["label"] for group in groups]
    by_scene = [means([row for row in rows if row["label"] == one], "scene") for one in pair]
    return [
        {
            **ours,
            "their_psnr_db": other["psnr_db"],
            "their_bytes": other["bytes"],
            "psnr_gain": ours["psnr_db"] - other["psnr_db"],
            "points": " against ".join(pair),
        }
        for ours, other in zip(*by_scene)
    ]


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
def draw_curves(path, points, edge, title):
    """PSNR over the bytes of the file, and over those of the coded anchors alone."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    figure, axes = subplots(1, 2, figsize=(11, 5), sharey=True, width_ratios=(2, 1))
    axes[0].plot(*edge.T, "--", color="gray", label="envelope of the explicit methods")
    for ax, (size, label) in zip(axes, DRAWN.items()):
        ax.set(xscale="log", xlabel=label)
        ax.xaxis.set(
            major_locator=LogLocator(subs=(1, 2, 5)),
            major_formatter=EngFormatter(sep=""),
            minor_formatter=NullFormatter(),
        )
        for method in dict.fromkeys(row["method"] for row in points if size in row):
            rows = [row for row in points if row["method"] == method]
            x, y, spread = ([r[name] for r in rows] for name in (size, "psnr_db", "psnr_db_spread"))
            ax.errorbar(x, y, spread, fmt="o", color=COLORS[method], label=method)
            ax.plot(*front(zip(x, y)).T, color=COLORS[method], alpha=0.5)
    axes[0].set(ylabel="PSNR of the test views (dB)", title=title)
    axes[1].legend(
        *axes[0].get_legend_handles_labels(), loc="lower right", frameon=False, fontsize=10
    )
    save_figure(figure, path)


def to_text(result):
    """The points, ours against the others, the best small point by scene, and Table 4 in form."""
    days = sorted(row["made"] for row in result["rows"])
    lines = [
        f"{result['title']}; made {days[0]} to {days[-1]}. Every point is a mean.",
        BASELINES,
        *text_table(COLUMNS, result["points"]),
        f"The envelope of the explicit methods: {', '.join(result['envelope']) or 'none'}.",
        "",
        f"Others against {CODED}, at every PSNR that both reach:",
        *text_table(AGAINST, result["against"]),
    ]
    if result["best"]:
        lines += ["", f"At most {MAX_BYTES:,} bytes: {result['best'][0]['points']}"]
        lines += text_table(BEST, result["best"])
    low, high = result["composition"]["lambda_rate"]
    lines += [
        "",
        f"The paper's Table 4: what a file consists of at lambda_rate {low:g} and {high:g}",
    ]
    return "\n".join([*lines, *text_table(TABLE_4, result["composition"]["rows"])])
