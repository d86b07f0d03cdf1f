"""Vectors of level L4 for a port of the training: steps to replay, compared array by array.

A case is a state, the views and noise of some steps, and the state after them. `python -m
tests.golden.vectors` computes new cases, and `replay` is the package's own Trainer, so that a
change of the training shows here. A network is one vector, as in a file: layer by layer, W row by
row, then b. The levels of the grid follow each other in one vector too.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np

from p4dgs_ref.model import bounding_box
from p4dgs_ref.scenes.scene import MODEL_EFFECTS, View
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.density import Statistics
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.parameters import Adam, Parameters
from p4dgs_ref.training.presets import Preset, rows_of
from p4dgs_ref.training.trainer import Trainer
from tests.golden.cases import Case
from tests.golden.flat import CAMERA_SHAPES, camera_of
from tests.golden.kernel import single
from tests.golden.pipeline import (
    ARRAYS,
    LOSSES,
    OF_ANCHORS,
    STATE_SHAPES,
    by_step,
    draw,
    each_step,
    joined,
)
from tests.golden.pipeline import views_of as views_of_model
from tests.golden.printed import with_printed_ssim
from tests.golden.subjects import Subject, no_pullback

ROLES = {"": "parameters", "m_": "first", "v_": "second"}
SUMS = ("visits", "opacity", "gradient", "seen")
GIVEN = ("W", "T", "focal", "center", "size", "times", "truth", "background")  # the views
# Every field of the preset that the steps read, all of them explicit.
PRESET = Preset(
    name="replay",
    anchors=7,
    voxel=0.05,
    d=4,
    k=2,
    hidden=(6, 6),
    deformation=(7, 7),
    L_x=2,
    L_t=1,
    context=(5, 5),
    grid_3d=(3,),
    grid_2d=(4,),
    table_3d=19,
    table_2d=13,
    F=1,
    tau_alpha=0.0,
    Q_f=0.25,
    Q_s=0.01,
    Q_l=0.01,
    Q_O=0.1,
    lambda_rate=0.01,
    stage_ends=(0, 0, 6, 10),
    lambda_ssim=0.2,
    decay_from=2,
    lr_x=(0.002, 0.0005),
    lr_f=(0.01, 0.002),
    lr_s=(0.01, 0.004),
    lr_l=(0.01, 0.004),
    lr_O=(0.02, 0.001),
    lr_alpha=(0.002, 0.0005),
    lr_c=(0.008, 0.001),
    lr_r=(0.004, 0.004),
    lr_psi_s=(0.004, 0.004),
    lr_d=(0.002, 0.0001),
    lr_grid=(0.02, 0.01),
    lr_p=(0.005, 0.001),
    lr_q=(0.005, 0.001),
    grow="scaffold",
    grow_from=0,
    grow_every=4,
    grow_until=5,
    collect_from=0,
    gradient_threshold=0.002,
    grow_init=16,
    grow_hierarchy=4,
    grow_depth=3,
    success=0.8,
    min_opacity=0.03,
    mask_from=8,
)
# Fields that only the start of a training concerns.
UNUSED = ("anchors", "extent", "feature_std", "opacity_bias", "upright", "deformation_gain")
# What the vectors switch off and no preset can switch on, at its place among the settings.
OFF_AFTER = {"deformation": {"time_net": (), "skip": False}, "lambda_ssim": {"lambda_volume": 0.0}}
SETTINGS = {}
for field in rows_of(PRESET):
    if field not in UNUSED:
        SETTINGS |= {field: getattr(PRESET, field), **OFF_AFTER.get(field, {})}


class GivenNumbers:
    """Stands for the Generator of a Trainer: noise of the steps, then the draws of growing."""

    def __init__(self, noise, draws):
        self.noise, self.draws = list(noise), list(draws)

    def random(self, shape, *_):
        """Return the next numbers in [0, 1)."""
        return self.noise.pop(0) + 0.5 if isinstance(shape, tuple) else self.draws.pop(0)


class Replayed(Trainer):
    """A Trainer that computes with the float32 corners of the box in its own precision."""

    def freeze_positions(self):
        corners = self.box or bounding_box(self.parameters["x_a"])
        self.box = tuple(corner.astype(self.parameters.vector.dtype) for corner in corners)
        super().freeze_positions()


def parted(arrays, design):
    """Undo `joined`: the Parameters of {array: values}."""
    parts_by_name = {}
    for stem, values in arrays.items():
        if stem == "grid":
            shapes = {f"grid.{i}": shape for i, shape in enumerate(design.levels())}
        elif stem in design.layers():
            shapes = {}
            for i, (rows, columns) in enumerate(design.layers()[stem]):
                shapes |= {f"{stem}.W{i}": (rows, columns), f"{stem}.b{i}": (columns,)}
        else:
            parts_by_name[stem] = values
            continue
        ends = np.cumsum([np.prod(shape) for shape in shapes.values()])
        parts = np.split(values, ends[:-1])
        parts_by_name |= {name: a.reshape(shape) for (name, shape), a in zip(shapes.items(), parts)}
    return Parameters(parts_by_name, arrays["x_a"].dtype)


def views_of(W, T, focal, center, size, times, truth):
    """Return the training views."""
    cameras = [camera_of(*pose, size) for pose in zip(W, T, focal, center)]
    named = zip(truth, cameras, np.asarray(times).tolist())
    return tuple(View("", image, None, camera, time) for image, camera, time in named)


def trainer_of(state, views, background, iteration, effects, settings):
    """Return a Trainer in a given state: arrays, moments, steps, mask, sums and box."""
    preset = replace(PRESET, **{n: v for n, v in settings.items() if n in rows_of(PRESET)})
    scene = SimpleNamespace(train=views, effects=effects, background=background, points=None)
    trainer = Replayed(scene, preset, settings=EXACT)
    p, m, v = (
        parted({name: state[tag + name] for name in ARRAYS}, trainer.design) for tag in ROLES
    )
    trainer.adopt(p)
    trainer.adam = Adam(p)
    trainer.adam.first, trainer.adam.second = m, v
    steps = dict(zip(ARRAYS, state["steps"].tolist()))
    trainer.adam.steps = {name: steps[name.split(".")[0]] for name in p.arrays}
    trainer.mask = state["mask"].copy()
    trainer.statistics = Statistics(*(np.array(state[name], float) for name in SUMS))
    trainer.iteration = iteration
    if len(state["box"]):
        trainer.box = tuple(state["box"])
        trainer.freeze_positions()
    return trainer


def state_of(trainer):
    """Return the state of a Trainer by the names of the vectors."""
    adam, dtype = trainer.adam, trainer.parameters.vector.dtype
    held = {"": trainer.parameters, "m_": adam.first, "v_": adam.second}
    state = {tag + name: joined(p, name) for tag, p in held.items() for name in ARRAYS}
    counts = {name.split(".")[0]: n for name, n in adam.steps.items()}
    state["steps"] = np.array([counts[name] for name in ARRAYS])
    state["mask"] = trainer.mask.copy()
    for name in SUMS:
        state[name] = getattr(trainer.statistics, name).astype(dtype)
    state["box"] = np.array(trainer.box or np.zeros((0, 3)), dtype).reshape(-1, 3)
    return state


def steps(u, views, iteration, effects, draws=(), **inputs):
    """Yield the losses and learning rates of every step from a state, and the state after it.

    Growing, masking and the change of the stage happen within the steps where the settings say so.
    """
    scene = {name: inputs.pop(name) for name in GIVEN}
    background = scene.pop("background")
    settings = {name: inputs.pop(name) for name in SETTINGS}
    trainer = trainer_of(inputs, views_of(**scene), background, iteration, effects, settings)
    trainer.rng = GivenNumbers(u, draws)
    trainer.order = views[::-1]
    for _ in views:
        rates = [trainer.rate_of(name) for name in ARRAYS]
        losses = trainer.step()[0]
        yield losses, rates, state_of(trainer)


def replay(**inputs):
    """Steps of training from a state: the state after them, and the losses before each of them.

    `rates` are the learning rates of every step.
    """
    rows, rates, states = zip(*steps(**inputs))
    dtype = inputs["x_a"].dtype
    losses = {name: np.array([getattr(row, name) for row in rows], dtype) for name in LOSSES}
    return {**losses, "rates": np.array(rates, dtype), **states[-1]}, no_pullback


def replay_steps(**inputs):
    """The same steps: the loss of each of them and the state after it, the moments first."""
    states = []
    for losses, _, state in steps(**inputs):
        loss = inputs["x_a"].dtype.type(losses.L_total)
        moments_first = sorted(state, key=lambda name: name[:2] not in ROLES)
        states.append({"L_total": loss, **{name: state[name] for name in moments_first}})
    return by_step(states), no_pullback


# --- cases --------------------------------------------------------------------------------------
WARM = 12  # steps before the first case, so that no moment is zero
V = 5


@cache
def scene_inputs(seed=481):
    """Return the views, drawn from another model: {name: array}."""
    rng = np.random.default_rng(seed)
    design = design_of(PRESET, MODEL_EFFECTS)
    teacher = draw(rng, design, 6)
    teacher["psi_c.W2"][...] *= 4  # strong colours
    background = single([0.9, 0.75, 0.3])
    shown = views_of_model(teacher, design, single(np.linspace(0.1, 0.9, V)), background)
    shown["background"] = background
    return {name: shown[name] if name == "size" else single(shown[name]) for name in GIVEN}


def noise(rng, shape):
    """Return noise in [-1/2, 1/2), as the Trainer draws it."""
    return rng.random(shape, np.float32).astype(float) - 0.5


@cache
def starting_state(seed=483):
    """Return the state after some steps without density control, rounded to float32."""
    rng = np.random.default_rng(seed)
    p = draw(rng, design_of(PRESET, MODEL_EFFECTS), PRESET.anchors)
    A, k = PRESET.anchors, PRESET.k
    state = {name: joined(p, name) for name in ARRAYS}
    state |= {tag + name: 0 * state[name] for tag in ("m_", "v_") for name in ARRAYS}
    state |= dict(
        steps=np.zeros(len(ARRAYS), int), mask=np.ones((A, k), bool), box=np.zeros((0, 3))
    )
    state |= {name: np.zeros((A, k)) for name in SUMS} | {"visits": np.zeros(A)}
    still = SETTINGS | {"grow": "off", "mask_from": 99, "stage_ends": (0, 0, WARM, WARM)}
    out = replay(
        **state,
        **scene_inputs(),
        **still,
        u=[noise(rng, (A, PRESET.d + 6 + 3 * k)) for _ in range(WARM)],
        views=rng.integers(0, V, WARM),
        iteration=0,
        effects=MODEL_EFFECTS,
    )[0]
    return rounded(out) | {name: state[name] for name in ("mask", *SUMS)}


def state_names():
    """Return the names of all that a state consists of."""
    named = [tag + name for tag in ROLES for name in ARRAYS]
    return [*named, "steps", "mask", *SUMS, "box"]


def rounded(outputs):
    """Return the state among the outputs of `replay`, in float32's numbers."""
    state = {name: outputs[name] for name in state_names()}
    return {name: single(a) if a.dtype.kind == "f" else a for name, a in state.items()}


def steps_from(state, first, last, rng):
    """Return the inputs of the steps from `first` to `last` - 1, with noise for every step."""
    A, k = state["mask"].shape
    n = PRESET.d + 6 + 3 * k
    inputs = dict(
        **state,
        **scene_inputs(),
        **SETTINGS,
        views=rng.integers(0, V, last - first),
        iteration=first,
        effects=MODEL_EFFECTS,
    )
    before = max(0, min(last, PRESET.grow_every) - first)  # steps before anchors are added
    u = [noise(rng, (A, n)) for _ in range(before)]
    if first < PRESET.grow_every <= last:
        inputs["draws"] = [single(rng.random(A * k)) for _ in range(PRESET.grow_depth)]
        grown = replay(**{**inputs, "views": inputs["views"][:before]}, u=u)[0]
        A = len(grown["x_a"])
    u += [noise(rng, (A, n)) for _ in range(last - first - before)]
    return dict(inputs, u=u)


@cache
def all_inputs():
    """Return {name of a case: its inputs}."""
    start = starting_state()
    inputs = {"growing": steps_from(start, 0, 4, np.random.default_rng(486))}
    state = rounded(replay(**inputs["growing"])[0])
    inputs["stage_switch"] = steps_from(state, 4, 10, np.random.default_rng(484))
    inputs["ten_steps"] = steps_from(start, 0, 10, np.random.default_rng(500))
    inputs["early_stages"] = early_inputs(start)
    return inputs


def early_inputs(start):
    """Return the inputs of a step of stage 1 and one of stage 2, after which an anchor dies.

    After 200 views the limit is 6 units of opacity. The second anchor has 9.5, but most of them
    from a masked child. The fourth has more than 7, but no child has 6 by itself. One scale is
    above its limit. The first level of growing draws no candidates, so the others are not looked
    at, although theirs would be taken.
    """
    state = {name: a.copy() for name, a in start.items()}
    state["visits"] += 198
    state["opacity"] += 9
    state["opacity"][1], state["mask"][1] = (0.5, 9), (True, False)
    state["opacity"][3] = 3.75, 3.5
    state["log_s"][5, 1] = 0.25
    inputs = steps_from(state, 2, 4, np.random.default_rng(502))
    draws = [np.full(state["mask"].size, number) for number in (0.25, 0.875, 0.9375)]
    return {**inputs, "stage_ends": (3, 4, 6, 10), "draws": draws}


def event_cases():
    yield Case("growing", all_inputs()["growing"], ("replay",))
    yield Case("stage_switch", all_inputs()["stage_switch"], ("replay", "masked"))


def training_cases():
    yield from event_cases()
    yield Case("early_stages", all_inputs()["early_stages"], ("replay", "masked", "clamped"))


def whole_cases():
    yield Case("ten_steps", all_inputs()["ten_steps"], ("replay", "masked"))


def shapes():
    """Return the axes of all inputs and outputs; A anchors become B."""
    axes_of = {}
    for tag in ROLES:
        for name, axes in STATE_SHAPES.items():
            ends = f"{axes} -> {axes.replace('A', 'B')}"
            axes_of[tag + name] = ends if name in OF_ANCHORS else axes
    axes_of |= {name: "A k -> B k" for name in ("mask", *SUMS)} | {"visits": "A -> B"}
    cameras = {name: f"V {axes}" for name, axes in CAMERA_SHAPES.items() if name != "size"}
    return {
        **axes_of,
        **cameras,
        "size": "2",
        "times": "V",
        "truth": "V H W 3",
        "background": "3",
        "box": "X 3 -> Y 3",
        "steps": "M",
        "views": "S",
        "u": "*A n",
        "draws": "*C",
        "iteration": "",
        "effects": "",
        **dict.fromkeys(SETTINGS, ""),
        **dict.fromkeys(LOSSES, "S"),
        "rates": "S M",
    }


def subject(key, formula, cases, vjp=replay):
    return Subject(
        key,
        "L4",
        "total_loss",
        "1 to 9, 11 to 17",
        formula,
        shapes(),
        (),
        vjp,
        cases,
        {"arrays": list(ARRAYS), "beta_1": 0.9, "beta_2": 0.999, "epsilon": 1e-15},
        single=True,
        # On a lattice whose corners are float32 numbers: a small coordinate has no more digits.
        even=("out.x_a", *(f"out.x_a.{i}" for i in range(6))),
        twins=with_printed_ssim(vjp),
    )


OF_STATE = {name: axes for name, axes in shapes().items() if name in state_names()}
SUBJECTS = (
    subject(
        "training_steps", "state, views, noise -> state after every step", event_cases, replay_steps
    )._replace(shapes=shapes() | each_step(OF_STATE), group="inside"),
    subject("training", "state, views, noise -> state after an event", training_cases),
    subject("training_whole", "state, views, noise -> state after ten steps", whole_cases),
)
