"""The vectors of the training: replayed in plain loops, and gradients by finite differences."""

from types import SimpleNamespace

import numpy as np
import pytest

from p4dgs_ref import model
from p4dgs_ref.equations import hash_grid, rate_loss, ssim
from p4dgs_ref.oracle import FolderPort, checker, published
from p4dgs_ref.oracle.compare import compare
from p4dgs_ref.oracle.published import flatten
from p4dgs_ref.oracle.report import as_json, name_of
from p4dgs_ref.scenes.scene import MODEL_EFFECTS
from p4dgs_ref.splatting import render
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training import density, loop, objective, parameters, trainer
from p4dgs_ref.training.initial import design_of
from p4dgs_ref.training.presets import Preset, rows_of
from p4dgs_ref.training.trainer import LEARNING_RATES
from tests.golden import pipeline, replay
from tests.golden.mistakes import MISTAKES
from tests.golden.mistakes.training import StockAdam
from tests.golden.pipeline import by_step
from tests.oracle.answers import Port, right, write
from tests.sampling import few

CASES = [c for key in ("training", "training_whole") for c in published.cases(key)]
EVERY_STEP = published.cases("training_steps")
DESIGN = design_of(replay.PRESET, MODEL_EFFECTS)
ROWS = ("x_a", "f_a", "log_s", "log_l", "O_a")
FIRST_STAGE = {"psi_d": 3, "psi_p": 4, "psi_q": 4, "grid": 4}


# --- the same steps in plain loops --------------------------------------------------------------
def rate(i, name, n):
    """The learning rate of an array in iteration n (Q17)."""
    stage = 1 + sum(n >= end for end in i["stage_ends"][:3])
    if (name == "x_a" and stage == 4) or stage < FIRST_STAGE.get(name, 1):
        return 0.0
    first, last = i[LEARNING_RATES[name]]
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
    fixed = objective.StepInputs(
        state["mask"],
        located,
        i["background"],
        stage,
        i["lambda_rate"],
        i["lambda_ssim"],
        EXACT,
    )
    networks = {name: p.network(name) for name in DESIGN.layers()}
    losses, rendered, back = objective.loss(p, DESIGN, networks, p.listed("grid"), fixed, view, u)
    bars, mean2d_bar = back()
    return losses, {name: replay.joined(bars, name) for name in replay.ARRAYS}, rendered, mean2d_bar


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
    added = []
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
        if level and not added:
            continue
        occupied = {tuple(np.round(np.array(x) / size)) for x in taken}
        new = [(cell, parents) for cell, parents in sorted(cells.items()) if cell not in occupied]
        for cell, parents in new:
            added.append((np.array(cell) * size, np.max(parents, axis=0), np.log(size)))
        taken += [tuple(np.array(cell) * size) for cell, _ in new]
    return added


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
    """The outputs of a case, and the state after every step."""
    state = {name: i[name].copy() for name in replay.state_names()}
    counts = dict(zip(replay.ARRAYS, state.pop("steps").tolist()))
    box = tuple(state["box"]) if len(state["box"]) else None
    views = replay.views_of(*(i[name] for name in replay.GIVEN[:-1]))
    rows, rates, states = [], [], []
    for step, (number, u) in enumerate(zip(i["views"], i["u"])):
        n = i["iteration"] + step
        if n >= i["stage_ends"][2] and box is None:
            x = state["x_a"].astype(np.float32).astype(float)
            box = x.min(axis=0), x.max(axis=0)
            state["x_a"] = lattice(state["x_a"], *box)
        view = views[number]
        losses, bars, rendered, mean2d_bar = gradients_of(i, state, view, u, box, n)
        now = {name: rate(i, name, n) for name in replay.ARRAYS}
        adam(state, bars, counts, now)
        state["visits"] += 1
        state["opacity"] += np.where(rendered.alpha > 0, rendered.alpha, 0)
        k = i["k"]
        for row, visible, (g_x, g_y) in zip(rendered.index, rendered.visible, mean2d_bar):
            if visible:
                size = g_x * view.camera.width / 2, g_y * view.camera.height / 2
                state["gradient"][row // k, row % k] += np.hypot(*size)
                state["seen"][row // k, row % k] += 1
        if (n + 1) % i["grow_every"] == 0:
            adjust(i, state, n + 1, i.get("draws"))
        rows.append(losses)
        rates.append([now[name] for name in replay.ARRAYS])
        states.append({name: a.copy() for name, a in state.items()})
        states[-1]["steps"] = np.array([counts[name] for name in replay.ARRAYS])
        states[-1]["L_total"] = np.float64(losses.L_total)
        states[-1]["box"] = np.array(box or np.zeros((0, 3))).reshape(-1, 3)
    losses = {name: np.array([getattr(row, name) for row in rows]) for name in replay.LOSSES}
    outputs = {**by_step(states), **states[-1], **losses, "rates": np.array(rates)}
    return flatten(outputs, "out.")


@pytest.mark.parametrize("case", CASES + EVERY_STEP, ids=lambda case: case.id)
def test_plain_loops_come_to_the_same_states(case):
    got = {name: a for name, a in plainly(case.inputs()).items() if name in case.tensors}
    assert compare(case.tensors, got, case.tolerance("float64")) == []


# --- what happens in the cases ------------------------------------------------------------------


def test_every_field_of_the_preset_is_a_setting():
    for case in CASES:
        settings = case.inputs()
        assert {*replay.SETTINGS} <= {*settings}
        assert {*rows_of(Preset)} - {*replay.SETTINGS} == {*replay.UNUSED}


# --- a port that shows its steps ----------------------------------------------------------------
def test_a_report_says_after_which_step_which_array_differs_first(tmp_path):
    """A port may leave out the subject, and some of its arrays; what it answers must be right."""
    shown = right("training_steps")
    for name in [name for name in shown if name.startswith(("growing/out.m_", "growing/out.v_"))]:
        del shown[name]
    (tmp_path / "right").mkdir()
    port = FolderPort(write(tmp_path / "right", training_steps=shown, training=right("training")))
    assert checker.check_port(port, ["L4"], ["training", "training_steps"]).ok
    late = [f"growing/out.{name}.{n}" for n in (2, 3) for name in replay.ARRAYS[1:]]
    wrong = shown | {name: shown[name] + 1 for name in late}
    report = checker.check_port(FolderPort(write(tmp_path, training_steps=wrong)), only="inside")
    first_lines = report.first.id, str(report).split("growing: fail\n")[1].splitlines()[:9]
    assert first_lines[0] == "training_steps/growing" and report.levels().keys() == {"inside"}
    assert first_lines[1][0].startswith("    after step 3: out.f_a.2[")
    first_wrong = {row["id"]: row["first"] for row in as_json(report)["cases"]}
    assert first_wrong["training_steps/growing"] == "out.f_a.2"
    assert first_lines[1][8] == f"    and {len(late) - 8} more tensors"
    shown["growing/out.fa.2"] = shown.pop("growing/out.f_a.2")
    report = checker.check_port(FolderPort(write(tmp_path, training_steps=shown)), only="inside")
    assert "\n    out.fa.2: extra: not expected in this case" in str(report) and not report.ok


# --- mistakes -----------------------------------------------------------------------------------
def halved(*arguments):
    return {name: bar / 2 for name, bar in render.backward(*arguments).items()}


@pytest.mark.parametrize(
    "module, name, wrong, room",
    few(
        [
            (parameters, "BETA_1", 0.8, "Adam"),
            (parameters, "EPSILON", 1e-3, "Adam"),
            (trainer, "exponential", lambda _, first, *others: first, "learning rates"),
            (trainer.Trainer, "first_stage", {}, "learning rates"),
            (density, "MAX_LOG_SCALE", -2.0, "density control"),
            (density, "often_seen", lambda statistics, _: statistics.seen >= 0, "density control"),
            (model, "LATTICE", 2**15 - 1, "lattice"),
            (ssim, "C1", 0.02, "ssim"),
            (rate_loss, "in_precision_of", lambda a, n: 2 * n, "rate_loss"),
            (
                objective,
                "render",
                SimpleNamespace(forward=render.forward, backward=halved),
                "gradients",
            ),
        ],
        3,
    ),
)
def test_the_first_line_names_the_part_with_the_first_wrong_number(
    monkeypatch, module, name, wrong, room
):
    monkeypatch.setattr(module, name, wrong)
    pairs = {"trace_steps", "trace"}, {"training_steps", "training"}
    wrong = [
        report for pair in pairs if not (report := checker.check_port(Port(), ["L4"], pair)).ok
    ]
    assert {report.first.equation for report in wrong} == {room}
    assert f"first divergence: {name_of(room)}\n" in str(wrong[0])


def test_stock_adam_is_named_in_every_subject(monkeypatch):
    for module in (pipeline, loop, replay):
        monkeypatch.setattr(module, "Adam", StockAdam)
    subjects = {"trace_steps", "trace", "training_steps", "training", "training_whole"}
    report = checker.check_port(Port(), ["L4"], subjects)
    assert "first divergence: Adam\n" in str(report) and all(r.wrong for r in report.results)
    assert all("[adam-epsilon-after-correction]" in r.explanation for r in report.results)


@pytest.mark.parametrize("id", ["training-moments-not-reset", "training-positions-move"])
def test_a_mistake_is_noticed_and_explained_in_all_ten_steps_too(id):
    """The doctor has answers to `training`; what fails in `training_whole` refers to it."""
    mistake = next(mistake for mistake in MISTAKES if mistake.id == id)

    def mistaken(case, dtype):
        return flatten(mistake.run(case.inputs(), {})[0], "out.")

    results = checker.check_port(Port(mistaken), ("L4",), {"training", "training_whole"}).results
    verdicts = {r.id: f"[{id}]" in r.explanation for r in results if r.verdict == "fail"}
    assert verdicts["training_whole/ten_steps"] and all(verdicts.values()) and len(verdicts) >= 2
