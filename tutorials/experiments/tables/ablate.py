"""The paper's Table 3 on a tiny scene, and what is lost without one part of the method.

Every step is trained, written to a file, read back and measured:

    D3DGS                         explicit Gaussians and their authors' network; float32
    + spatial prediction          anchors, not Gaussians, moved by the same network; float32
    + compact deformation MLP     psi_d of two layers of 64, in float16
    + quantisation and entropy coding        the paper's whole method and its file

Up to the third step there is no noise, rate or masking in training, and no context. One part at a
time is left out of the paper's whole method.
"""

from ast import literal_eval
from dataclasses import replace
from functools import partial
from io import BytesIO

import numpy as np

from p4dgs_ref.effects import MOTION
from p4dgs_ref.lab.writer import group_rows, text_table
from p4dgs_ref.model import CONTEXT_NETWORKS, Anchors, Design, Model, bounding_box
from p4dgs_ref.training.parameters import Parameters
from p4dgs_ref.training.presets import TINY
from p4dgs_ref.training.trainer import Trainer

from ..baselines import d3dgs
from ..baselines.explicit import of_network
from . import spatial
from .methods import PAPERS, columns, preset_of, save, task_of
from .writer import means, with_error

ITERATIONS = 6500
SPATIAL, PLAIN = "+ spatial prediction", "D3DGS without harmonics"
NETWORK, WHOLE = "+ compact deformation MLP", "+ quantisation and entropy coding"
# The paper's Table 3, on T-Rex: MB, PSNR, and what a step changes of it in dB.
PAPER = {
    "D3DGS": "56.70 38.04",
    SPATIAL: "7.27 38.36 +0.32",
    NETWORK: "5.39 38.34 -0.02",
    WHOLE: "0.85 38.24 -0.10",
}
AFTER_LAST = TINY.iterations  # later than every iteration
WITHOUT_RATE = {  # stage 3 goes on to the end, and the noise is too small to change anything
    "stage_ends": (*TINY.stage_ends[:2], AFTER_LAST, AFTER_LAST),
    "mask_from": AFTER_LAST,
    **dict.fromkeys(("Q_f", "Q_s", "Q_l", "Q_O"), 2.0**-40),
}
AUTHORS = d3dgs.Preset()
# What each step changes of the preset of the paper's whole method; the last four leave out a part.
STEPS = {
    "D3DGS": {},
    SPATIAL: {
        **WITHOUT_RATE,
        "deformation": AUTHORS.deformation,
        "lr_d": AUTHORS.lr_d,
    },
    NETWORK: WITHOUT_RATE,
    WHOLE: {},
    "fixed step": {"lr_q": (0.0, 0.0)},  # and psi_q is 0, so that every step is its base step
    "global prior": {"grid_3d": (1,), "grid_2d": ()},  # one node: the same for all anchors
    "no masking": {"mask_from": AFTER_LAST},
    "no deformation": {},
}
COLUMNS = {
    "step": "{label}",
    "bytes": "{bytes:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "drawn": "{gaussians:,.0f}",
    "PSNR dB": "{psnr_db:.2f}",
    "change dB": "{gain}",
    "the paper's MB, PSNR, change dB (T-Rex)": "{paper}",
}


def plan(scene, seeds, iterations, anchors=None):
    """The Tasks of all steps and seeds, or of SPATIAL with so many anchors beside D3DGS."""
    command = f"python -m tutorials.experiments.tables ablate {scene.name}"
    command += f" --seeds {seeds} --iterations {iterations}"
    steps = STEPS
    if anchors:
        command += f" --anchors {anchors}"
        changes = {**STEPS[SPATIAL], "anchors": anchors}
        steps = {"D3DGS": {}, PLAIN: {"sh_degree": 0}, f"{SPATIAL}, {anchors} anchors": changes}
    at_rest = replace(scene, effects=[name for name in scene.effects if name not in MOTION])
    tasks = []
    for seed in range(seeds):
        for name, changes in steps.items():
            method = "d3dgs" if name in ("D3DGS", PLAIN) else PAPERS
            task = task_of(scene, method, seed, iterations, command, changes)._replace(name=name)
            if "stage_ends" in changes:
                task = task._replace(make=make_plain, load=load_plain, ending="npy")
            if name.startswith(SPATIAL):
                make = partial(make_plain, trainer=spatial.Trainer)
                task = task._replace(make=make, load=load_spatial)
            if name == "fixed step":
                task = task._replace(make=make_without_psi_q)
            if name == "no deformation":
                task = task._replace(scene=at_rest)
            tasks.append(task)
    return tasks


def make_without_psi_q(task, path, source=None):
    """Train the paper's design with steps that stay, and write its file."""
    trainer = Trainer(task.scene, preset_of(task), task.seed)
    last = len(trainer.preset.context)
    for name in (f"psi_q.W{last}", f"psi_q.b{last}"):
        trainer.parameters[name][...] = 0
    return save(trainer, path)


def show(scene, tasks, found):
    """Print Table 3 in form with the paper's numbers beside it, then the parts left out."""
    print(f"{scene.name}; {tasks[0].iterations:,} iterations. Changes are against the step before,")
    print("those of parts left out against the paper's whole method. A change is none where it is")
    print("smaller than twice its standard error over the seeds. psi_q stays in the file of `fixed")
    print("step`; `global prior` has one node of the grid.")
    print(*text_table(COLUMNS, summaries(found)), sep="\n")


def summaries(found):
    """Means over seeds, with what a step changes in dB."""
    of_steps = {label: rows for (label,), rows in group_rows(found, "label").items()}
    names = [*PAPER]
    before = dict(zip(names[1:], names))
    before |= {label: names[0] for label in of_steps if label not in STEPS}
    for row in means(found, "label"):
        name = row["label"]
        row["paper"] = PAPER.get(name, "-")
        if name != names[0]:
            pairs = zip(of_steps[name], of_steps[before.get(name, WHOLE)])
            row["gain"] = with_error([a["psnr_db"] - b["psnr_db"] for a, b in pairs])
        yield row


# --- plain files ----------------------------------------------------------------------------------
# A model of anchors without quantisation and entropy coding: one record of NumPy, whose fields are
# the arrays, in float32, or float16 for a compact psi_d. Every child of an anchor is stored, as in
# Scaffold-GS; the networks and the grid of the entropy coder are not.
def make_plain(task, path, source=None, trainer=Trainer):
    """Train and write such a file; returns its bytes by kind."""
    model = trainer(task.scene, preset_of(task), task.seed).run()
    gaussians = {name: a for name, a in model.anchors._asdict().items() if name != "mask"}
    network = {}
    for name, layers in model.networks.items():
        if name not in CONTEXT_NETWORKS:
            network |= of_network(name, *layers)
    values = {**gaussians, **network, "background": model.background}
    half = "psi_d." if task.label == NETWORK else "none"
    types = [(n, "f2" if n.startswith(half) else "f4", a.shape) for n, a in values.items()]
    design = str(vars(model.design))
    record = np.array((*values.values(), design), [*types, ("design", f"S{len(design)}")])
    with open(path, "wb") as file:
        np.save(file, record)
    anchors, weights = (sum(record[n].nbytes for n in part) for part in (gaussians, network))
    size = path.stat().st_size
    return columns(gaussians=anchors, network=weights, other=size - anchors - weights)


def load_plain(data):
    """The model in such a file, ready to be rendered."""
    record = np.load(BytesIO(data))
    *names, _ = record.dtype.names
    p = Parameters({name: record[name] for name in names}, float)
    design = Design(**literal_eval(record["design"].item().decode()))
    attributes = [p[name] for name in Anchors._fields[:-1]]
    anchors = Anchors(*attributes, mask=np.ones(p["O_a"].shape[:2], bool))
    stored = dict.fromkeys(name.split(".")[0] for name in names if name.startswith("psi_"))
    networks = {name: p.network(name) for name in stored}
    return Model(design, anchors, networks, [], bounding_box(anchors.x_a), p["background"])


def load_spatial(data):
    """The same of anchors that the authors' network moves."""
    return spatial.MovedAnchors(**vars(load_plain(data)))
