"""From where on prediction pays: one scene in finer and finer detail, both sides coded alike.

    python -m tutorials.experiments.equal_terms growing_detail [--part I/N] [--estimate]

Five patterned, slightly polished balls bounce and spin on a chequered slab. A field of the slab and
a stripe of the balls have the same width in pixels at every size, so twice the size has four times
as many fields and twice as many stripes. The cameras are the same at every size. A squared error
that is summed over four times as many pixels may be four times as large for the same PSNR, so the
losses grow with the number of pixels.
"""

import os
import shutil
from pathlib import Path

from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.simulator import simulate

from ..tables.methods import PAPERS, task_of
from .curve import ALIKE, COLUMNS, ITERATIONS, NARROW, compare, files_of, markdown

COMMAND = "python -m tutorials.experiments.equal_terms growing_detail"
SCENES = Path("report/equal_terms/scenes")
LOSSES = (4e-4, 1.6e-3, 3.2e-3, 6.4e-3, 1.28e-2, 2.56e-2)  # at 64 pixels
SIZES = {  # seeds; explicit Gaussians and degree; anchors; a third entry is a narrow network
    64: (
        3,
        ((500, 0), (1000, 0), (1000, 1), (1400, 0), (2000, 0), (4000, 0), (1000, 0, NARROW)),
        ((200,), (400,), (800,), (400, NARROW)),
    ),
    128: (
        3,
        ((1000, 0), (1400, 0), (2000, 0), (2000, 1), (2800, 0), (4000, 0)),
        ((400,), (800,), (1600,)),
    ),
    256: (1, ((2000, 0), (4000, 0), (5600, 0), (8000, 0)), ((800,), (1600,))),
}
FIELD, STRIPE = 0.24, 0.18  # widths at 64 pixels, in scene units
BALLS = (  # places on the slab and colours
    ((0.0, 0.0), (0.86, 0.3, 0.25)),
    ((0.55, 0.3), (0.25, 0.5, 0.8)),
    ((-0.5, 0.4), (0.9, 0.75, 0.3)),
    ((-0.4, -0.5), (0.35, 0.7, 0.4)),
    ((0.45, -0.5), (0.7, 0.4, 0.75)),
)


def described(size):
    """The scene.json of a size, as a dictionary."""
    finer = 64 / size
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
    place = SCENES / f"detail_{size}"
    if not place.exists():
        own = place.with_name(f"{place.name}.{os.getpid()}")
        simulate(described(size), own)
        try:
            own.rename(place)
        except OSError:  # another process was faster
            shutil.rmtree(own)
    return load_scene(place)


def plan():
    """The Tasks of all sizes, those of a seed before those of the next."""
    tasks = []
    for size, (seeds, explicit, anchors) in SIZES.items():
        scene, losses = scene_of(size), [loss * (size / 64) ** 2 for loss in LOSSES]
        points = [("d3dgs_small", ("gaussians", "sh_degree"), *point) for point in explicit]
        points += [(PAPERS, ("anchors",), *point) for point in anchors]
        for method, names, *values in points:
            changes = dict(zip(names, values)) | dict(*values[len(names) :])
            for seed in range(seeds):
                task = task_of(scene, method, seed, ITERATIONS, COMMAND, changes)
                tasks += files_of(task, losses)
    return sorted(tasks, key=lambda task: task.seed)


def tell(rows):
    """Print how many times the bytes of the paper's design the explicit files need."""
    found = compare(rows, ALIKE, scenes=[f"detail_{size}" for size in SIZES])
    print(markdown(COLUMNS, found))
