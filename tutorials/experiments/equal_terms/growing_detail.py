# %% [markdown]
# # From where on prediction pays
#
# On the tiny scenes, explicit Gaussians that are coded as well as ours need about as many bytes.
# The paper's scenes have far more detail. This script makes one scene at 64, 128 and 256 pixels,
# whose patterns become finer with the size, and compares the bytes of both at equal PSNR. It is the
# record of a measurement, not a lesson with exercises.
#
#     python tutorials/growing_detail.py cost        the hours that the missing trainings take
#     python tutorials/growing_detail.py make        train what is missing
#     python tutorials/growing_detail.py make 0/4    part 0 of 4, for four processes at once
#     python tutorials/growing_detail.py collect     write tutorials/records/growing_detail.csv
#     python tutorials/growing_detail.py             count numbers, read this record, draw it
#
# Trainings lie in `report/growing_detail`, so what was stopped goes on there. What the record has
# is not made again.
#
# **Files:** [simulator](../p4dgs_ref/scenes/simulator/__init__.py) (the scenes),
# [methods.py](../p4dgs_ref/lab/tables/methods.py) (one training and its files),
# [coded.py](../p4dgs_ref/lab/baselines/coded.py) (the codec of the explicit Gaussians).

# %%
import p4dgs_ref

p4dgs_ref.prepare()  # the same numbers everywhere; before NumPy is imported

# %%
import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from p4dgs_ref import lessons
from p4dgs_ref.designs import PRESETS, trainer_class
from p4dgs_ref.lab.accuracy.diagram import place_labels
from p4dgs_ref.lab.baselines import choose, d3dgs
from p4dgs_ref.lab.clock import clocked
from p4dgs_ref.lab.tables import curve, hundredfold, methods
from p4dgs_ref.lab.tables.methods import ALIKE, CODED
from p4dgs_ref.lab.writer import (
    aligned,
    best,
    bytes_at,
    factors,
    front,
    grouped,
    means,
    read_csv,
    twice_standard_error,
)
from p4dgs_ref.model import LATTICE, declared_numbers
from p4dgs_ref.report.figures import BLUE, LIGHT_BLUE, RED, write_csv
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.simulator import place_cameras, simulate
from p4dgs_ref.scenes.simulator.description import read_description
from p4dgs_ref.scenes.simulator.trace import trace

FOLDER = Path("report/growing_detail")
RECORD = Path(__file__).parent / "records" / "growing_detail.csv"
COMMAND = "python tutorials/growing_detail.py make"  # of its rows

# %% [markdown]
# ## The scenes
# Five patterned, slightly polished balls bounce and spin on a chequered slab. A field of the slab
# and a stripe of the balls have the same width in pixels at every size, so twice the size has four
# times as many fields and twice as many stripes. The cameras of 48 training and 10 test views are
# the same at every size.

# %%
SMALLEST = 64  # pixels, at which a field of the slab is FIELD wide, in scene units
FIELD, STRIPE = 0.24, 0.18
BALLS = (  # places on the slab and colours
    ((0.0, 0.0), (0.86, 0.3, 0.25)),
    ((0.55, 0.3), (0.25, 0.5, 0.8)),
    ((-0.5, 0.4), (0.9, 0.75, 0.3)),
    ((-0.4, -0.5), (0.35, 0.7, 0.4)),
    ((0.45, -0.5), (0.7, 0.4, 0.75)),
)


def described(size):
    """The scene.json of a size, as a dictionary."""
    finer = SMALLEST / size
    field = {"kind": "checker", "color": [0.35, 0.4, 0.5], "cell": FIELD * finer, "axes": "xy"}
    slab = {
        "name": "slab",
        "shape": {"kind": "box", "half": [0.95, 0.95, 0.06]},
        "position": [0, 0, -0.55],
        "color": [0.85, 0.83, 0.78],
        "texture": field,
    }
    balls = [
        {
            "name": f"ball {i}",
            "shape": {"kind": "sphere", "radius": 0.22},
            "position": [*place, -0.27],
            "color": list(color),
            "specular": {"strength": 0.4, "exponent": 20},
            "texture": {
                "kind": "stripes",
                "color": [0.95, 0.95, 0.9],
                "period": STRIPE * finer,
                "direction": [1, 0.4 * i, 1 - 0.5 * i],
            },
            "motion": [
                {"kind": "bounce", "height": 0.3, "phase": i / len(BALLS)},
                {"kind": "spin", "axis": [0, 0.3 * i, 1], "degrees": 60},
            ],
        }
        for i, (place, color) in enumerate(BALLS)
    ]
    lens = {"fl_x": 1.34 * size, "fl_y": 1.34 * size, "cx": size / 2, "cy": size / 2}
    cameras = {"kind": "scattered", "train": 48, "test": 10, "radius": 3.6, "elevation": [10, 60]}
    moving = ["translation", "rotation", "view_color", "view_geometry"]
    drawn = ["texture", "diffuse", "specular", "occlusion", "background"]
    return {
        "title": f"five patterned balls on a slab, {size} pixels",
        "license": "CC0-1.0",
        "effects": moving + drawn,
        "resolution": [size, size],
        "lens": lens,
        "cameras": {**cameras, "target": [0, 0, -0.2]},
        "light": {"kind": "point", "position": [1.5, -1.0, 3.0], "ambient": 0.5},
        "bodies": [slab, *balls],
    }


def scene_of(size):
    """The scene of a size, simulated where it is not there yet; several processes may do so."""
    place = FOLDER / "scenes" / f"detail_{size}"
    if not place.exists():
        own = place.with_name(f"{place.name}.{os.getpid()}")
        simulate(described(size), own)
        try:
            own.rename(place)
        except OSError:  # another process was faster
            shutil.rmtree(own)
    return load_scene(place)


# %% [markdown]
# ## The trainings
# Explicit: D3DGS with a deformation network of our size, stored *coded alike* after training with
# six losses, each a point of the curve. Ours: the design with coded networks, of which each point
# is a training, because its prices are paid while it trains; four children an anchor (`tiny_coded`)
# and single children (`small_coded` with features of 8 numbers and coarse steps of offset scales,
# which their offsets make nearly redundant), over anchors and price. The deformation networks of
# both sides have two layers of 64, as in `tiny`, or of 32 where networks are a large part of a
# file. A squared error that is summed over four times as many pixels may be four times as large for
# the same PSNR, so the losses grow with the number of pixels.

# %%
ITERATIONS, STEPS = 6500, 7
LOSSES = (4e-4, 1.6e-3, 3.2e-3, 6.4e-3, 1.28e-2, 2.56e-2)  # at SMALLEST pixels
SIZES = {  # seeds; explicit Gaussians and degree; anchors and price, four and single children
    64: (
        3,
        (
            *((500, 0), (1000, 0), (1000, 1), (1400, 0), (2000, 0), (4000, 0)),
            (1000, 0, "narrow"),
        ),
        ((200, 0.0005), (400, 0.0005), (800, 0.002), (400, 0.0005, "narrow")),
        ((500, 0.0005), (1000, 0.0005), (2000, 0.0005), (1000, 0.0005, "narrow")),
    ),
    128: (
        3,
        ((1000, 0), (1400, 0), (2000, 0), (2000, 1), (2800, 0), (4000, 0)),
        ((400, 0.0005), (800, 0.0005), (1600, 0.002)),
        ((1000, 0.0005), (2000, 0.0005), (4000, 0.0005)),
    ),
    256: (
        1,
        ((2000, 0), (4000, 0), (5600, 0), (8000, 0)),
        ((800, 0.0005), (1600, 0.0005), (3200, 0.002)),
        ((2000, 0.0005), (4000, 0.0005)),
    ),
}
EXPLICIT = "d3dgs_small"
SINGLE = {**curve.SINGLE, **curve.LEAN}


def changed(names, points, base=None):
    """What points change of their preset: the fields of two names, and of a narrow network."""
    return [
        {**(base or {}), **dict(zip(names, point)), **(curve.NARROW if point[2:] else {})}
        for point in points
    ]


def plan():
    """The Tasks of all sizes, those of a seed before those of the next."""
    tasks, ours = [], ("anchors", "lambda_rate")
    for size, (seeds, explicit, four, single) in SIZES.items():
        of_methods = {
            EXPLICIT: changed(("gaussians", "sh_degree"), explicit),
            CODED: changed(ours, four) + changed(ours, single, SINGLE),
        }
        alike = [(ALIKE, loss * (size / SMALLEST) ** 2) for loss in LOSSES]
        scenes, storages = [scene_of(size)], {EXPLICIT: alike}
        tasks += methods.plan(
            of_methods, of_methods, scenes, FOLDER, seeds, ITERATIONS, storages=storages
        )
    return sorted(tasks, key=lambda task: task.seed)


def kept():
    """The rows of the record by their files, so that no machine makes them again."""
    rows = read_csv(RECORD) if RECORD.exists() else []
    return {row["file"]: row for row in rows if row["iterations"] == ITERATIONS}


def say(line):
    """Print a line at once."""
    print(line, flush=True)


def cost(tasks):
    """Print the processor hours of trainings that are not there, judging by the first STEPS."""
    missing = {
        task.trained.path: task.trained for task in tasks if not task.trained.record.exists()
    }
    for name in dict.fromkeys(task.scene.name for task in missing.values()):
        alike = methods.trainers([task for task in missing.values() if task.scene.name == name])
        hours = 0.0
        for trainer, number in alike:
            seconds = [clocked(trainer.step)[1][0] for _ in range(STEPS)]
            hours += number * np.median(seconds) * ITERATIONS / 3600
        say(f"{name}: {sum(number for _, number in alike)} trainings, about {hours:.1f} hours")


def collect(tasks):
    """Write the record with the rows that it lacks and that are there now."""
    rows = kept()
    made = methods.made([task for task in tasks if task.path.name not in rows])
    rows |= {row["file"]: {**row, "command": COMMAND} for row in made}
    write_csv(RECORD, [rows[task.path.name] for task in tasks if task.path.name in rows])


# %% [markdown]
# ## What a Gaussian costs
# Count numbers. An explicit Gaussian has a position, three scales, four numbers of a rotation, an
# opacity and three numbers of a colour: eleven numbers and a position. A colour that depends on the
# view costs 9 more with harmonics of degree 1, 24 with degree 2, 45 with degree 3. An anchor of
# `tiny` has a feature of 16 numbers, three scales, three offset scales and four offsets: 34 numbers
# and a position for four Gaussians. Their colours depend on the view by a network, without any
# further number. A child thus costs 8.5 numbers and a quarter of a position.
#
# A single child with a feature of 8 costs 17 numbers and a whole position, more than an explicit
# Gaussian of degree 0. There only the context and the rate can save bytes, not the prediction of
# several children.
#
# Networks are the other side. Ours have more weights, also those of the context, and their bytes do
# not grow with the number of Gaussians. In the paper's two files of T-Rex (its Table 4), networks
# are 55 and 31 %; in our files of a few hundred Gaussians they are about half, although they are
# coded. The more Gaussians a scene needs, the less they matter: that is the expectation that is
# measured here.


# %%
def numbers_of_anchor(preset):
    """The coded numbers of an anchor of a preset beside its position, and those of networks."""
    design = trainer_class(preset).design_of(preset, described(SMALLEST)["effects"])
    return sum(design.widths), design.k, declared_numbers(design, 0)["networks"]


def numbers_of_explicit(preset):
    """The numbers of an explicit Gaussian beside its position, and those of networks."""
    arrays = d3dgs.D3DGS.initial(preset, np.random.default_rng(0), np.zeros((2, 3)))
    networks = sum(a.size for name, a in arrays.items() if name.startswith("psi"))
    own = sum(a[0].size for name, a in arrays.items() if not name.startswith("psi")) - 3
    return own, networks


def count():
    """Print the numbers that a Gaussian costs."""
    rows = [("", "numbers", "positions", "numbers of networks")]
    for changes in ({}, SINGLE):
        fields = {"preset": "tiny_coded", **changes}
        name = fields.pop("preset")
        numbers, k, networks = numbers_of_anchor(replace(PRESETS[name], **fields))
        rows.append(
            (f"{name}, a child of {k}", f"{numbers / k:.1f}", f"{1 / k:.2f}", f"{networks:,}")
        )
    for degree in range(4):
        preset = choose(EXPLICIT, changes={"sh_degree": degree})
        own, networks = numbers_of_explicit(preset)
        rows.append((f"explicit, degree {degree}", f"{own:.1f}", "1.00", f"{networks:,}"))
    print("\n".join(aligned(rows)))


# %% [markdown]
# ### What the paper's tables imply
# The paper prints bytes, not numbers of Gaussians. These follow from its Tables 3 and 4 (T-Rex), if
# D3DGS stores float32 with harmonics of degree 3 and three unused normals (62 numbers), if anchors
# have 16 features and 10 children, and if positions have 16 bits. The three estimates agree within
# a fifth: spatial prediction kept the number of Gaussians and made each of them eleven times
# smaller. Quantisation and coding made an anchor seven times smaller again.
#
# The tables leave open how much of this explicit Gaussians may have, too. No row codes D3DGS, so
# they do not say how much of the factor 67 from 56.7 to 0.85 MB needs prediction. Nor do they say
# what D3DGS reaches with fewer Gaussians, or with harmonics of a lower degree.

# %%
MB = 1e6
T_REX = {"D3DGS": 56.7, "+ spatial prediction": 7.27}  # Table 3, MB
POSITIONS, ATTRIBUTES = 0.118, 0.191 + 0.099 + 0.188  # Table 4, high rate, MB


def implied():
    """Print the numbers of Gaussians that the paper's tables imply, and the bytes of each."""
    paper = choose("d3dgs", "paper_synthetic", {"sh_degree": 3})
    own, network = numbers_of_explicit(paper)
    per_gaussian = 4 * (own + 6)  # with the position and three normals
    explicit = (T_REX["D3DGS"] * MB - 4 * network) / per_gaussian
    numbers, k, _ = numbers_of_anchor(PRESETS["paper_synthetic"])
    per_anchor = 4 * (numbers + 3)
    anchors = (T_REX["+ spatial prediction"] * MB - 4 * network) / per_anchor
    coded = POSITIONS * MB / (3 * LATTICE.bit_length() / 8)
    each = (POSITIONS + ATTRIBUTES) * MB / coded
    rows = [
        ("T-Rex, by the paper's tables", "Gaussians", "bytes of each"),
        ("D3DGS", f"{explicit:,.0f}", f"{per_gaussian}"),
        ("anchors, float32", f"{anchors * k:,.0f}", f"{per_anchor / k:.1f}"),
        ("anchors, coded, before masks", f"{coded * k:,.0f}", f"{each / k:.1f}"),
    ]
    print("\n".join(aligned(rows)))


# %% [markdown]
# ## The record
# Ours are read as two curves. Only anchors of four children use the paper's first idea, to predict
# several neighbours from one feature; single children have its context and rate alone.
# What came out is told in [the reference](reference.md#what-these-tables-show).

# %%
FOUR, ALONE = "four children", "single children"
KINDS = {"explicit": RED, FOUR: BLUE, ALONE: LIGHT_BLUE}  # and their colours


def kind_of(row):
    """Which of the KINDS a row belongs to."""
    if row["method"] == EXPLICIT:
        return "explicit"
    return ALONE if hundredfold.SINGLE in row["label"] else FOUR


def with_kinds(rows):
    """The rows of a record with their kinds; files of explicit Gaussians only as coded alike."""
    coded = [row for row in rows if row["method"] == CODED or row["storage"] == ALIKE]
    return [{**row, "kind": kind_of(row)} for row in coded]


def curves_of(rows):
    """{kind: its points (bytes, PSNR)}, means over seeds; the best ones on held-back views."""
    points = means(rows, "label", "kind")
    of_kinds = {kind: best([row for row in points if row["kind"] == kind]) for kind in KINDS}
    return {
        kind: [(row["bytes"], row["psnr_db"]) for row in chosen]
        for kind, chosen in of_kinds.items()
    }


def at_levels(explicit, ours):
    """{PSNR: times the bytes of ours that explicit files need}.

    The PSNRs are the half dBs that both reach, and the highest one.
    """
    if not explicit or not ours:
        return {}
    fronts = [front(explicit), front(ours)]
    low, high = max(f[0, 1] for f in fronts), min(f[-1, 1] for f in fronts)
    halves = np.arange(np.ceil(2 * low), np.floor(2 * high) + 1) / 2
    levels = [*halves, high] if low <= high else []
    return {psnr: np.divide(*(bytes_at(f, psnr) for f in fronts)) for psnr in levels}


def median_by_seed(rows, kind):
    """The median factor of each seed: their mean, twice its standard error, how many they are."""
    each = [
        factors(curves[kind], curves["explicit"])
        for seed in dict.fromkeys(row["seed"] for row in rows)
        for curves in [curves_of([row for row in rows if row["seed"] == seed])]
        if curves[kind] and curves["explicit"]
    ]
    medians = [found["median"] for found in each if found]
    return np.mean(medians or np.nan), twice_standard_error(medians), len(medians)


def summaries(rows):
    """What is said about each scene and kind: bytes of a Gaussian, and factors of ours."""
    found = []
    for (scene, kind), own in grouped(rows, "scene", "kind").items():
        of_scene = [row for row in rows if row["scene"] == scene]
        curves = curves_of(of_scene)
        each = [row["gaussians_bytes"] / row["gaussians"] for row in own]
        found.append({"scene": scene, "kind": kind, "each": float(np.median(each))})
        if kind != "explicit":
            found[-1]["factors"] = at_levels(curves["explicit"], curves[kind])
            names = ("median", "error", "seeds")
            found[-1] |= dict(zip(names, median_by_seed(of_scene, kind)))
    return found


def told(row):
    """A row of `summaries` in words; where factors pass 1, the curves cross."""
    lines = [f"{row['kind']}: {row['each']:.1f} bytes a Gaussian without networks (median)"]
    if "factors" in row:
        phrases = [f"{factor:.2f} at {psnr:.4g} dB" for psnr, factor in row["factors"].items()]
        lines.append(f"  {', '.join(phrases) or 'no PSNR that both reach'}")
    if row.get("seeds", 0) > 1:
        is_clear = abs(row["median"] - 1) > row["error"]
        spread = f"{row['median']:.2f} ±{row['error']:.2f} over {row['seeds']} seeds"
        lines.append(
            f"  median {spread}{'' if is_clear else ', which cannot tell who needs fewer'}"
        )
    return "\n".join(lines)


def picture(size):
    """The first test view of the scene of a size."""
    description = read_description(described(size))
    return trace(description, *place_cameras(description, "test")[0])


def draw(curves):
    """A view of every size, and PSNR over bytes there with the names of the curves on them."""
    figure, (views, axes) = lessons.pyplot().subplots(
        2,
        len(curves),
        figsize=(4.2 * len(curves), 7),
        squeeze=False,
        layout="constrained",
        height_ratios=(2, 3),
    )
    for view, ax, (scene, points_of_kinds) in zip(views, axes, curves.items()):
        size = int(scene.partition("_")[2])
        view.imshow(picture(size))
        view.set_axis_off()
        view.set_title(f"{size} pixels")
        for kind in filter(points_of_kinds.get, KINDS):  # those that have points
            edge, color = front(points_of_kinds[kind]), KINDS[kind]
            ax.semilogx(*edge.T, "o-", color=color)
            ax.annotate(
                kind, edge[len(edge) // 2], (8, -14), textcoords="offset points", color=color
            )
        ax.margins(0.12)
        ax.set_xlabel("bytes, all coded")
        ax.xaxis.set(
            major_locator=LogLocator(subs=(1, 2, 5)),
            major_formatter=EngFormatter(sep=""),
            minor_formatter=NullFormatter(),
        )
    axes[0].set_ylabel("PSNR of the test views (dB)")
    place_labels(figure)
    lessons.show(figure, "growing_detail")


def show():
    """Count, then read the record, say where the curves cross, and draw them."""
    count()
    print()
    implied()
    if not RECORD.exists():
        return print(f"\nno {RECORD.name} yet; `make` and then `collect` write it")
    rows = with_kinds(kept().values())
    for row in summaries(rows):
        if row["kind"] == "explicit":
            print(f"\n{row['scene']}, times the bytes of ours that explicit Gaussians need")
        print(told(row))
    draw({scene: curves_of(own) for (scene,), own in grouped(rows, "scene").items()})


def main(words):
    """Do what the words of the command line ask for."""
    if not words:
        return show()
    word, part = (*words, "0/1")[:2]
    if word not in ("cost", "make", "collect") or not re.fullmatch(r"\d+/[1-9]\d*", part):
        print(f"{' '.join(words)}: expected cost, make, make I/N or collect", file=sys.stderr)
        sys.exit(2)
    tasks, there = plan(), kept()
    if word == "collect":
        return collect(tasks)
    own = methods.part_of(tasks, *map(int, part.split("/")))
    missing = [task for task in own if task.path.name not in there]
    if word == "cost":
        return cost(missing)
    methods.make_missing(missing, say)


# %%
if __name__ == "__main__":
    main(sys.argv[1:])
