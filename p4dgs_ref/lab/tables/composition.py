"""The paper's Table 4 on a tiny scene: what a file consists of at a low and at a high rate."""

from pathlib import Path

from ...report.figures import write_csv
from ...report.inspect import components
from ...report.jobs import in_processes
from . import methods
from .methods import OURS, Task

# The rows, the sections of the file that they are, and the percent of the paper's two files.
ROWS = {
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


def composition(
    scene,
    folder,
    low=1e-2,
    high=1e-4,
    iterations=None,
    seed=0,
    progress=lambda line: None,
    jobs=1,
):
    """Train at two values of lambda_rate, the larger one for the low rate; files go to a folder.

    Returns {"scene", "lambda_rate", "bytes", "rows"}, each row with bytes and percent of both.
    """
    methods.require_test_views(scene)
    base = Task(scene, OURS, seed, Path(folder), iterations)
    tasks = [base._replace(changes={"lambda_rate": value}) for value in (low, high)]
    for done, _ in enumerate(in_processes(methods.train, tasks, jobs), 1):
        progress(f"{done} of 2 trainings")
    files = [task.path.read_bytes() for task in tasks]
    sizes = [components(data) for data in files]
    rows = []
    for name, (sections, paper) in ROWS.items():
        both = [sum(size.get(section, 0) for section in sections) for size in sizes]
        percent = [100 * n / len(data) for n, data in zip(both, files)]
        rows.append({"component": name, "bytes": both, "percent": percent, "paper_percent": paper})
    cells = [[row["component"], *row["bytes"], *row["percent"]] for row in rows]
    columns = ("component", "bytes_low", "bytes_high", "percent_low", "percent_high")
    write_csv(folder / "composition.csv", cells, columns)
    return {
        "scene": scene.name,
        "lambda_rate": [low, high],
        "bytes": [len(data) for data in files],
        "rows": rows,
    }


def describe(result):
    """The table, which sums to the two files."""
    low, high = (f"{value:g}" for value in result["lambda_rate"])
    heading = f"component|low rate ({low})|%|high rate ({high})|%|the paper's % low|high"
    table = [heading.split("|")]
    for row in result["rows"]:
        cells = [f(n) for pair in zip(row["bytes"], row["percent"]) for f, n in zip(FORMS, pair)]
        paper = [f"{n:.1f}" for n in row["paper_percent"]] if row["paper_percent"] else ["-", "-"]
        table.append([row["component"], *cells, *paper])
    totals = [cell for n in result["bytes"] for cell in (f"{n:,}", "")]
    table.append(["file", *totals, "", ""])
    return "\n".join([f"{result['scene']}: bytes by lambda_rate", *methods.aligned(table)])


FORMS = ("{:,}".format, "{:.1f}".format)
