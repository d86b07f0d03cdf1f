"""PSNR against bytes: every method over its own size, as its authors store it and coded alike.

    python -m tutorials.experiments.equal_terms curve

makes the rows that `records/curve.csv` lacks, prints how the methods compare, and draws them. Files
are stored as the authors of a method store them, in float16, or coded alike (`coded`). A method's
curve goes through its best points: those with a higher PSNR on held-back views than all smaller
files of this method and storage. So sizes and steps are chosen without the test views, whose PSNR
is drawn, and no point is left out for its test views. The paper's design is coded alike with narrow
networks alone, which 23 of the 31 points of its curves as stored have.
"""

from functools import cache, partial

import numpy as np

from p4dgs_ref.lab.writer import fill_form, read_csv
from p4dgs_ref.scenes import load_scene

from .. import RECORDS
from ..tables.methods import PAPERS, columns, task_of
from ..tables.rows import TEXTS, keyed
from ..tables.validation import held_back
from ..tables.writer import best, factors, means
from . import coded, coded_anchors, half

SCENES = ("bouncing", "figure", "glossy")
ITERATIONS, SHORTER = 6500, 3800  # what all curves show, and what loses half a decibel
COMMAND = "python -m tutorials.experiments.equal_terms curve"
STORED, HALF, ALIKE = "as stored", "float16", "coded alike"  # the storage of a file
LOSSES = (5e-4, 2e-3, 8e-3)  # of what is coded alike: the price of the error against bits
NARROW = {"deformation": (32, 32)}  # a network half as wide
GRID = (
    *({"gaussians": n, "sh_degree": d} for n in (200, 400, 800, 1600) for d in (0, 1)),
    {"gaussians": 800, "sh_degree": 3},
)
FAR = ("d3dgs", "hexplane", "gaussian4d")  # far from all others: one seed
# The points of each method.
SIZES = {
    PAPERS: (
        {"lambda_rate": 0.01},
        {},
        {"anchors": 400},
        {"anchors": 400, "lambda_rate": 0.003},
        {"anchors": 800},
        NARROW,
        {"anchors": 400, **NARROW},
        {"anchors": 800, **NARROW},
    ),
    **dict.fromkeys(FAR, GRID),
    "d3dgs_small": (
        *GRID,
        *(
            {"gaussians": n, "sh_degree": d, **NARROW}
            for n, d in ((400, 0), (400, 1), (800, 0), (800, 1), (1600, 0))
        ),
    ),
}
MEAN = "mean"  # over the scenes
COLUMNS = {
    "D3DGS / the paper's design": "{scene}",
    "storage": "{storage}",
    "times": "{median:.2f}",
    "": "{verdict}",
    "first seed": "{cells[0]}",
    "second": "{cells[1]}",
    "third": "{cells[2]}",
}
OF_SEED = "{median:.2f} ({low:.2f} to {high:.2f} dB, {points} points)"


# --- the rows -------------------------------------------------------------------------------------
def plan():
    """The Tasks of all points, those of the first seed before the others."""
    tasks = []
    for seed in range(3):
        for scene in map(load_scene, SCENES):
            for method, sizes in SIZES.items():
                for changes in sizes if seed == 0 or method not in FAR else ():
                    stored = task_of(scene, method, seed, ITERATIONS, COMMAND, changes)
                    shorter = stored._replace(iterations=SHORTER)
                    if method == "d3dgs_small":
                        tasks += [*files_of(stored), half_of(stored)]
                        tasks += [*files_of(shorter), half_of(shorter)] if seed == 0 else []
                    elif method == PAPERS:
                        narrow = NARROW.items() <= changes.items()
                        tasks += files_of(stored, LOSSES if narrow else ())
                        tasks += [shorter] * (seed == 0)
                    else:
                        tasks += files_of(stored)
    return tasks


def files_of(stored, losses=LOSSES):
    """A training's Tasks: its file as stored, and those coded alike."""
    return [stored, *(alike_of(stored, loss) for loss in losses)]


def half_of(stored):
    """The Task of a float16 file."""
    again = dict(make=write_half, load=half.decode, ending="half", source=stored)
    return stored._replace(name=f"{stored.label} {HALF}", **again)


def alike_of(stored, loss):
    """The Task of a file coded alike."""
    is_papers = stored.method == PAPERS
    return stored._replace(
        make=partial(write_alike, loss=loss),
        load=coded_anchors.decode if is_papers else coded.decode,
        ending="anchors" if is_papers else "coded",
        name=f"{stored.label} loss={loss:g}",
        source=stored,
    )


def write_alike(task, path, source, loss):
    """Write the file of a trained model by the simple codec; returns columns of its row."""
    is_papers = task.method == PAPERS
    model = coded_anchors.OfAnchors(source) if is_papers else source
    H = coded.sensitivity(model, held_back(task.scene), np.random.default_rng(0))
    encode = coded_anchors.encode if is_papers else coded.encode
    data, sizes = encode(source, H, loss)
    path.write_bytes(data)
    return columns(**sizes) | seconds_of(task)


def write_half(task, path, source):
    """Write the float16 file of a trained model."""
    data, sizes = half.encode(source)
    path.write_bytes(data)
    return columns(**sizes) | seconds_of(task)


def seconds_of(task):
    """How long the training took, as the record has it."""
    row = recorded().get(task.training)
    return {"train_seconds": row["train_seconds"]} if row else {}


@cache
def recorded():
    """The rows of the record by their keys."""
    return keyed(read_csv(RECORDS / "curve.csv", TEXTS))


# --- the curves -----------------------------------------------------------------------------------
def shown(rows):
    """The rows that curves show, with their storage."""
    of_length = (row for row in rows if row["iterations"] == ITERATIONS)
    return [{**row, "storage": storage_of(row["label"])} for row in of_length]


def storage_of(label):
    """The storage of the file of a row, which its label says."""
    return ALIKE if " loss=" in label else HALF if label.endswith(HALF) else STORED


def chosen(rows, **wanted):
    """The rows with these entries."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def curve_of(rows):
    """The best points (bytes, PSNR) of one method and storage, means over scenes and seeds."""
    points = means(rows, "label", "iterations", "method", "storage")
    return [(point["bytes"], point["psnr_db"]) for point in best(points)]


def compare(rows, storage):
    """How many times the bytes of the paper's design D3DGS needs at equal PSNR, by scene.

    Both have networks of one size. Every seed has its curves, its range of PSNRs that both reach,
    and its median factor over the points in this range; `median` is the median of these. A
    difference whose seeds lie on both sides of 1 is none.
    """
    found = []
    for scene in (MEAN, *SCENES):
        own = rows if scene == MEAN else chosen(rows, scene=scene)
        ours = chosen(own, method=PAPERS, storage=storage)
        theirs = chosen(own, method="d3dgs_small", storage=storage)
        seeds = sorted({row["seed"] for row in ours} & {row["seed"] for row in theirs})
        pairs = [(chosen(ours, seed=seed), chosen(theirs, seed=seed)) for seed in seeds]
        each = [factors(*map(curve_of, pair)) for pair in pairs]
        if each and all(each):
            medians = [one["median"] for one in each]
            first, last = min(medians), max(medians)
            row = dict(scene=scene, storage=storage, each=each)
            row["median"] = np.median(medians)
            row["verdict"] = "none" if first <= 1 <= last else "fewer" if last < 1 else "more"
            row["cells"] = [OF_SEED.format(**one) for one in each]
            found.append(row)
    return found


def tell(rows):
    """Print how D3DGS with a small network compares with the paper's design."""
    found = [row for storage in (STORED, ALIKE) for row in compare(rows, storage)]
    print(f"\nbytes of D3DGS divided by those of {PAPERS} at equal PSNR, {ITERATIONS} iterations")
    print(markdown(COLUMNS, found))


def markdown(columns, rows):
    """A table as the page has it: `columns` are {heading: form}."""
    lines = [columns, ["---"] * len(columns)]
    lines += [[fill_form(form, row) for form in columns.values()] for row in rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
