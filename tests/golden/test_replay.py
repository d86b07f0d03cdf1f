"""The vectors of the training: replayed in plain loops, and gradients by finite differences."""

import numpy as np
import pytest

from p4dgs_ref.equations import hash_grid
from p4dgs_ref.oracle import checker, published
from p4dgs_ref.oracle.compare import compare
from p4dgs_ref.oracle.published import flatten
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training import objective
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import Preset
from tests.golden import replay
from tests.golden.mistakes import MISTAKES
from tests.oracle.answers import Port

CASES = published.cases("training") + published.cases("training_whole")
DESIGN = design_of(replay.PRESET, MODEL_EFFECTS)
ROWS = ("x_a", "f_a", "log_s", "log_l", "O_a")
FROM_STAGE_4 = ("psi_p", "psi_q", "grid")


# --- the same steps in plain loops --------------------------------------------------------------
def rate(i, name, n):
    """The learning rate of an array in iteration n (Q17)."""
    stage = 1 + sum(n >= end for end in i["stage_ends"][:3])
    if (name == "x_a" and stage == 4) or (name in FROM_STAGE_4 and stage < 4):
        return 0.0
    first, last = i[replay.LEARNING_RATES[name]]
    share = min(max((n - i["decay_from"]) / (i["stage_ends"][-1] - i["decay_from"]), 0), 1)
    return first ** (1 - share) * last**share


def lattice(x, lo, hi):
    """Positions on the lattice of 16 bits over a box."""
    step = (hi - lo) / 65535
    return lo + np.round((x - lo) / step) * step


def gradients_of(i, state, view, u, box, n):
    """Losses, gradients by array, opacities, and what the splats' centres receive."""
    stage = 1 + sum(n >= end for end in i["stage_ends"][:3])
    p = replay.parted({name: state[name] for name in replay.ARRAYS}, DESIGN)
    tables = [T for T, _ in DESIGN.levels()]
    located = hash_grid.locate(p["x_a"], *box, DESIGN.grid, tables) if box is not None else None
    fixed = objective.Fixed(
        state["mask"],
        located,
        i["background"],
        stage,
        i["lambda_rate"],
        i["lambda_ssim"],
        EXACT,
    )
    networks = {name: p.network(name) for name in DESIGN.layers()}
    losses, seen, back = objective.loss(p, DESIGN, networks, p.listed("grid"), fixed, view, u)
    bars, mean2d_bar = back()
    return losses, {name: replay.joined(bars, name) for name in replay.ARRAYS}, seen, mean2d_bar


def adam(state, bars, counts, rates):
    """One step of Adam, number by number."""
    for name, g in bars.items():
        counts[name] += rates[name] > 0
        m, v = state["m_" + name], state["v_" + name]
        m[...] = 0.9 * m + 0.1 * g
        v[...] = 0.999 * v + 0.001 * g**2
        if rates[name]:
            unbiased = np.sqrt(1 - 0.999 ** counts[name]) / (1 - 0.9 ** counts[name])
            state[name] -= rates[name] * unbiased * m / (np.sqrt(v) + 1e-15)


def grown_anchors(i, state, draws):
    """The new anchors [(place, feature, size)] of Scaffold-GS's rule, child by child (Q16)."""
    A, k = state["mask"].shape
    taken = [tuple(x) for x in state["x_a"]]
    found = []
    for level in range(i["grow_depth"]):
        size = i["voxel"] * max(i["grow_init"] // i["grow_hierarchy"] ** level, 1)
        threshold = i["gradient_threshold"] * (i["grow_hierarchy"] // 2) ** level
        cells = {}
        for a in range(A):
            for c in range(k):
                views = state["seen"][a, c]
                strong = state["gradient"][a, c] / max(views, 1) >= threshold
                lucky = draws[level][a * k + c] > 0.5 ** (level + 1)
                if views > i["grow_every"] * i["success"] / 2 and strong and lucky:
                    x = state["x_a"][a] + state["O_a"][a, c] * np.exp(state["log_l"][a])
                    cells.setdefault(tuple(np.round(x / size)), []).append(state["f_a"][a])
        if level and not found:
            continue
        occupied = {tuple(np.round(np.array(x) / size)) for x in taken}
        new = [(cell, parents) for cell, parents in sorted(cells.items()) if cell not in occupied]
        for cell, parents in new:
            found.append((np.array(cell) * size, np.max(parents, axis=0), np.log(size)))
        taken += [tuple(np.array(cell) * size) for cell, _ in new]
    return found


def adjust(i, state, n, draws):
    """Masking, then growing and pruning, as the settings say for the end of iteration n."""
    visited = state["visits"] > i["grow_every"] * i["success"]
    if n >= i["mask_from"]:
        faint = state["opacity"] < i["min_opacity"] * state["visits"][:, None]
        state["mask"] &= ~(visited[:, None] & faint)
    total = (state["opacity"] * state["mask"]).sum(axis=1)
    dead = visited & (total < i["min_opacity"] * state["visits"])
    growing = i["grow_from"] < n < i["grow_until"]
    if growing:
        added = grown_anchors(i, state, draws)
        keep = ~dead
        for name in (*ROWS, *(tag + name for tag in ("m_", "v_") for name in ROWS)):
            old = state[name][keep]
            new = np.zeros((len(added), *old.shape[1:]))
            for row, (x, f, size) in zip(new, added):
                if name in ROWS[:4]:
                    row[...] = {"x_a": x, "f_a": f}.get(name, size)
            state[name] = np.concatenate([old, new])
        state["log_s"] = np.minimum(state["log_s"], 0.05)
        for name in ("mask", *replay.SUMS):
            old = state[name][keep]
            new = np.full((len(added), *old.shape[1:]), name == "mask", old.dtype)
            state[name] = np.concatenate([old, new])
    if growing or n >= i["mask_from"]:
        children = state["seen"] > i["grow_every"] * i["success"] / 2
        anchors = state["visits"] > i["grow_every"] * i["success"]
        for name, judged in zip(
            ("gradient", "seen", "opacity", "visits"), [children, children] + [anchors] * 2
        ):
            state[name][judged] = 0


def plainly(i):
    """The outputs of a case."""
    state = {name: i[name].copy() for name in replay.state_names()}
    counts = dict(zip(replay.ARRAYS, state.pop("steps").tolist()))
    box = tuple(state["box"]) if len(state["box"]) else None
    views = replay.views_of(*(i[name] for name in replay.GIVEN[:-1]))
    rows, rates = [], []
    for step, (number, u) in enumerate(zip(i["views"], i["u"])):
        n = i["iteration"] + step
        if n >= i["stage_ends"][2] and box is None:
            x = state["x_a"].astype(np.float32).astype(float)
            box = x.min(axis=0), x.max(axis=0)
            state["x_a"] = lattice(state["x_a"], *box)
        view = views[number]
        losses, bars, seen, mean2d_bar = gradients_of(i, state, view, u, box, n)
        now = {name: rate(i, name, n) for name in replay.ARRAYS}
        adam(state, bars, counts, now)
        state["visits"] += 1
        state["opacity"] += np.where(seen.alpha > 0, seen.alpha, 0)
        k = i["k"]
        for row, visible, (g_x, g_y) in zip(seen.index, seen.visible, mean2d_bar):
            if visible:
                size = g_x * view.camera.width / 2, g_y * view.camera.height / 2
                state["gradient"][row // k, row % k] += np.hypot(*size)
                state["seen"][row // k, row % k] += 1
        if (n + 1) % i["grow_every"] == 0:
            adjust(i, state, n + 1, i.get("draws"))
        rows.append(losses)
        rates.append([now[name] for name in replay.ARRAYS])
    found = {f"out.{name}": a for name, a in state.items()}
    found["out.steps"] = np.array([counts[name] for name in replay.ARRAYS])
    found["out.box"] = np.array(box or np.zeros((0, 3))).reshape(-1, 3)
    found["out.rates"] = np.array(rates)
    return found | {f"out.{n}": np.array([getattr(r, n) for r in rows]) for n in replay.LOSSES}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_plain_loops_end_in_the_same_state(case):
    assert compare(case.tensors, plainly(case.inputs()), case.tolerance("float64")) == []


# --- gradients ----------------------------------------------------------------------------------
# Not log_l and O_a: they move x, and no gradient flows back from E(x) (Q10).


# --- what happens in the cases ------------------------------------------------------------------


def test_every_field_of_the_preset_is_a_setting():
    for case in CASES:
        settings = case.inputs()
        assert {*replay.SETTINGS} <= {*settings}
        assert {*Preset._fields} - {*replay.SETTINGS} == {*replay.UNUSED}


# --- mistakes -----------------------------------------------------------------------------------
@pytest.mark.parametrize("id", ["training-moments-not-reset", "training-positions-move"])
def test_a_mistake_is_noticed_and_explained_in_all_ten_steps_too(id):
    """The doctor has answers to `training`; what fails in `training_whole` refers to it."""
    mistake = next(mistake for mistake in MISTAKES if mistake.id == id)

    def mistaken(case, dtype):
        return flatten(mistake.run(case.inputs(), {})[0], "out.")

    results = checker.check_port(Port(mistaken), ("L4",), {"training", "training_whole"}).results
    verdicts = {r.id: f"[{id}]" in r.explanation for r in results if r.verdict == "fail"}
    assert verdicts["training_whole/ten_steps"] and all(verdicts.values()) and len(verdicts) >= 2
