"""The ledger of effects: the work and the bytes of each effect of a scene.

Work is that of the networks' layers and of the splats in the tiles of drawn frames. The work and
bytes of an effect are what switching it off alone would save; hidden layers that it shares with
another effect stay.
"""

from collections import Counter
from dataclasses import replace
from textwrap import fill

from .. import effects as fx
from ..model import ANCHOR_NETWORKS, declared_numbers
from ..report.figures import BLUE, figure_style, save_figure, subplots
from ..scenes.scene import MODEL_EFFECTS
from ..splatting import fast, render
from ..splatting.settings import FAST
from ..training.presets import TINY
from ..training.trainer import Trainer
from ..training.watch import equation_codes, watch_calls
from .writer import text_table

# Equations that are called only for effects of the view or of motion.
ONLY_FOR_EFFECTS = ("view", "positional_encoding", "deformation", "deformed")


# --- work and bytes -------------------------------------------------------------------------------
def network_work(design, A, N):
    """Return {effect: multiply-adds} of the networks for A anchors and N Gaussians of a frame."""
    layers, work = design.layers(), Counter()
    for name in ANCHOR_NETWORKS:
        inputs, outputs = layers[name][0]
        effect = "view_color" if name == "psi_c" else "view_geometry"
        work[effect] += A * (inputs - design.d) * outputs
    # Time is one input for all Gaussians: what the first layer of psi_d makes of it is not counted.
    widths = (3 * (1 + 2 * design.L_x), *design.deformation)
    trunk = sum(rows * columns for rows, columns in zip(widths, design.deformation))
    heads = dict(zip(fx.MOTION, fx.heads(design.effects)))
    listed = [effect for effect in fx.MOTION if heads[effect]]
    for effect in listed:
        own = trunk if listed == [effect] else 0
        work[effect] = N * (own + widths[-1] * heads[effect])
    return work


def effect_bytes(design):
    """Return {effect: bytes} of the weights, two bytes each, that only this effect needs."""

    def size(effects):
        return 2 * declared_numbers(replace(design, effects=effects), 0)["networks"]

    without = {effect: [e for e in design.effects if e != effect] for effect in MODEL_EFFECTS}
    return {effect: size(design.effects) - size(others) for effect, others in without.items()}


def costs(model, frames):
    """Return what the effects of a model cost in frames, a list of (camera, time).

    Returns {effect: {"work": multiply-adds of the mean frame, "bytes"}}, and the equations that
    were called.
    """
    occlusion = "occlusion" in model.design.effects
    codes = {**equation_codes(), fast.front_to_back.__code__: ("front_to_back", "forward")}
    work, called = Counter(), set()

    def see(event, mark, frame, value):
        called.add(mark[0])
        if event == "call" and mark[0] == "front_to_back":
            # For every splat in a pixel of its tile: its weight, and what it leaves of the light.
            work["occlusion"] += 2 * frame.f_locals["A"].size

    with watch_calls(codes, see):
        for camera, time in frames:
            *looks, index = model.gaussians(time, camera)
            work += network_work(model.design, model.count, len(index))
            render.forward(*looks, camera, model.background, FAST, occlusion)
            if model.background.any():
                work["background"] += 3 * camera.height * camera.width
    sizes = effect_bytes(model.design)
    return {
        effect: {"work": round(work[effect] / len(frames)), "bytes": sizes[effect]}
        for effect in MODEL_EFFECTS
    }, called


# --- the ledger -----------------------------------------------------------------------------------
def toggle_effect(scene, effect):
    """Return the scene with one effect more or less on its list."""
    return replace(scene, effects=set(scene.effects) ^ {effect})


def of_scene(scene):
    """Return the ledger of a scene, from untrained models of `tiny` and its test views.

    Returns {"scene": its name, "effects": a row {effect, listed, work, bytes} for each,
    "never_called": equations that no effect of the list needs}. An effect that is not listed has
    the fields if_work and if_bytes: what it would cost.
    """
    frames = [(view.camera, view.time) for view in scene.test]
    found, called = costs(Trainer(scene, TINY).model(), frames)
    rows = [
        {"effect": effect, "listed": effect in scene.effects, **found[effect]}
        for effect in MODEL_EFFECTS
    ]
    for row in (row for row in rows if not row["listed"]):
        with_it = Trainer(toggle_effect(scene, row["effect"]), TINY).model()
        cost = costs(with_it, frames)[0][row["effect"]]
        row |= {f"if_{kind}": amount for kind, amount in cost.items()}
    never_called = [key for key in ONLY_FOR_EFFECTS if key not in called]
    return {"scene": scene.name, "effects": rows, "never_called": never_called}


# --- the ledger as text and as a picture ----------------------------------------------------------
def amount(row, kind):
    """Return the work or the bytes of a row, as text."""
    if_listed = f" ({row[f'if_{kind}']:,} if listed)" if f"if_{kind}" in row else ""
    return f"{row[kind]:,}{if_listed}"


def to_text(ledger):
    """Return the ledger as text: its answer, then a line per effect."""
    columns = {"effect": "{effect}", "listed": "{yes}", "multiply-adds per frame": "{work}"}
    columns |= {"bytes of weights": "{bytes}"}
    cells = [
        {
            "effect": row["effect"],
            "yes": "yes" if row["listed"] else "no",
            **{kind: amount(row, kind) for kind in ("work", "bytes")},
        }
        for row in ledger["effects"]
    ]
    return "\n".join([*answer(ledger), "", *text_table(columns, cells)])


def answer(ledger):
    """Return what a ledger says, in lines."""
    listed = [row["effect"] for row in ledger["effects"] if row["listed"]]
    return (
        f"{ledger['scene']} lists {', '.join(listed) or 'no effect'}",
        f"equations never called: {', '.join(ledger['never_called']) or 'none'}",
        "counted in an untrained model of preset tiny",
    )


@figure_style({"font.size": 10.5, "axes.titlesize": 10.5, "figure.dpi": 200})
def draw_ledger(path, ledger):
    """Draw work and bytes of every effect.

    Those that the scene does not list cost nothing; a hollow bar is what one would cost alone.
    """
    panels = {
        "work": "Work: multiply-adds per frame",
        "bytes": "Bytes of weights (float16)",
    }
    figure, axes = subplots(len(panels), figsize=(4.2, 5.2))
    for ax, (kind, title) in zip(axes, panels.items()):
        for row in ledger["effects"]:
            size = row.get(f"if_{kind}", row[kind])
            ax.barh(row["effect"], size, color=BLUE if row["listed"] else "none", edgecolor=BLUE)
            ax.annotate(
                amount(row, kind),
                (size, row["effect"]),
                (3, 0),
                textcoords="offset points",
                va="center",
                color="black" if row["listed"] else "#606060",
            )
        ax.set_title(title, loc="left", fontweight="bold")
        ax.margins(x=1.2)
        ax.set(xticks=[])
        ax.invert_yaxis()
        ax.spines[["top", "right", "bottom"]].set_visible(False)
    lines = [
        fill(line, 52)
        for line in (*answer(ledger), "hollow: not listed (in brackets: what it would cost)")
    ]
    figure.suptitle("\n".join(lines), fontsize=10.5, x=0.02, ha="left")
    save_figure(figure, path)
