"""Whatever stops a training, resuming it gives the bytes of an uninterrupted one."""

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import p4dgs_ref as p4
from p4dgs_ref.cli import job
from p4dgs_ref.cli import parser as cli
from p4dgs_ref.training import objective
from p4dgs_ref.training.adam import Adam
from p4dgs_ref.training.checkpoint import CHECKPOINT, load
from p4dgs_ref.training.fit import fit, load_model
from tests.sampling import few

ROOT = Path(p4.__file__).resolve().parents[1]
# Every stage, re-seeding and masking, so that a checkpoint has to carry everything.
LIVELY = dict(
    preset="smoke",
    seed=5,
    stage_ends=(12, 20, 40, 60),
    grow="reseed",
    grow_from=5,
    grow_every=10,
    grow_until=35,
    mask_from=45,
    min_opacity=0.2,
)
SCAFFOLD = {
    **LIVELY,
    "grow": "scaffold",
    "min_opacity": 0.1,
    "gradient_threshold": 1e-6,
    "voxel": 0.02,
    "stage_ends": (12, 20, 40, 50),
}


@pytest.fixture(scope="module")
def scene():
    return p4.load_scene("bouncing", downscale=4)


CODED = {**LIVELY, "coded": True, "position_bits": 10, "network_ramp": 9, "lr_step": (0.02, 0.01)}
KINDS = {"coded": CODED, "reseed": LIVELY, "scaffold": SCAFFOLD}


@pytest.fixture(scope="module", params=few(KINDS, 1))
def whole(request, scene):
    """Settings, and the bytes and the history of an uninterrupted training."""
    settings = KINDS[request.param]
    trainer = fit(scene, **settings)
    assert trainer.mask.any() and not trainer.mask.all()
    return settings, p4.encode(trainer.model()), trainer.history


@pytest.fixture
def interruptible():
    """Set Python's own handler of Ctrl-C; a training must put back what it found."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def call_at(monkeypatch, owner, name, number, action):
    """Replace one call of a function, counted from 0, by `action(function, *arguments)`."""
    function, calls = getattr(owner, name), []

    def counted(*args):
        calls.append(None)
        return action(function, *args) if len(calls) == number + 1 else function(*args)

    monkeypatch.setattr(owner, name, counted)


def go_on(scene, settings, folder):
    trainer = fit(scene, **settings, folder=folder, resume=True)
    assert p4.encode(load_model(folder)[0]) == p4.encode(trainer.model())
    return p4.encode(trainer.model()), trainer.history


def half_step(step, adam, parameters, *rest):
    """A step of Adam that is stopped after it has moved the first half of the parameters."""
    before = parameters.vector.copy()
    step(adam, parameters, *rest)
    half = len(before) // 2
    parameters.vector[half:] = before[half:]
    raise KeyboardInterrupt


@pytest.mark.parametrize("at", few([30, 7, 0, 15, 45], 1))
@pytest.mark.parametrize("save_every", few([0, 1000], 1))
def test_stopped_inside_a_step(scene, whole, tmp_path, monkeypatch, at, save_every):
    settings, *want = whole
    call_at(monkeypatch, Adam, "step", at, half_step)
    with pytest.raises(KeyboardInterrupt):
        fit(scene, **settings, folder=tmp_path, save_every=save_every)
    monkeypatch.undo()
    assert load(tmp_path)[1]["iteration"] == (at if save_every == 0 else 0)
    assert [*go_on(scene, settings, tmp_path)] == want


@pytest.mark.parametrize("at", few([25, 0, 11, 44, -1], 1))
def test_ctrl_c_waits_for_the_end_of_the_step(
    scene, whole, tmp_path, monkeypatch, interruptible, at
):
    settings, *want = whole
    at %= settings["stage_ends"][-1]

    def press(function, *args):
        signal.raise_signal(signal.SIGINT)
        return function(*args)

    call_at(monkeypatch, objective, "loss", at, press)
    with pytest.raises(KeyboardInterrupt):
        fit(scene, **settings, folder=tmp_path, save_every=1000)
    monkeypatch.undo()
    assert load(tmp_path)[1]["iteration"] == at + 1
    assert [*go_on(scene, settings, tmp_path)] == want


def test_ctrl_c_after_the_last_step_stops_too(scene, tmp_path, monkeypatch, interruptible):
    def press(replace, *args):
        signal.raise_signal(signal.SIGINT)
        replace(*args)

    call_at(monkeypatch, os, "replace", 1, press)  # 0 is the first checkpoint, 1 the last
    with pytest.raises(KeyboardInterrupt):
        fit(scene, **LIVELY, folder=tmp_path, save_every=1000)
    assert load(tmp_path)[1]["iteration"] == 60


def test_a_second_ctrl_c_does_not_wait(scene, tmp_path, monkeypatch, interruptible):
    def press_twice(function, *args):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the second one must stop at once")

    call_at(monkeypatch, objective, "loss", 30, press_twice)
    with pytest.raises(KeyboardInterrupt):
        fit(scene, **LIVELY, folder=tmp_path, save_every=0)
    assert load(tmp_path)[1]["iteration"] == 30


def test_killed_in_the_middle_of_a_checkpoint(scene, whole, tmp_path, monkeypatch):
    settings, *want = whole

    def killed(*args):
        raise KeyboardInterrupt

    call_at(monkeypatch, os, "replace", 20, killed)
    with pytest.raises(KeyboardInterrupt):
        fit(scene, **settings, folder=tmp_path, save_every=0)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT] and load(tmp_path)[1][
        "iteration"
    ] == 19
    left = tmp_path / ".part-0a_b1c2d"  # what a killed process leaves
    left.mkdir()
    (left / CHECKPOINT).write_bytes(b"half of a checkp")
    assert [*go_on(scene, settings, tmp_path)] == want
    assert {path.name for path in tmp_path.iterdir()} == {CHECKPOINT, left.name}


def test_training_in_a_thread(scene):
    done = []
    thread = threading.Thread(target=lambda: done.append(p4.train(scene, "smoke")))
    thread.start()
    thread.join(60)
    assert len(done) == 1


def test_ctrl_c_without_a_checkpoint(tmp_path, monkeypatch, capsys):
    def stop(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "read_scene", stop)
    assert cli.run(["train", "bouncing", "-o", str(tmp_path)], time.perf_counter()) == 130
    assert capsys.readouterr().err == "p4dgs-ref: stopped\n"


def test_ctrl_c_in_the_demo_leaves_nothing(tmp_path, monkeypatch, capsys):
    call_at(monkeypatch, Adam, "step", 3, half_step)
    argv = [
        "demo",
        "bouncing",
        "--downscale",
        "8",
        "--preset",
        "smoke",
        "--quiet",
        "-o",
        str(tmp_path / "new" / "out"),
    ]
    assert cli.run(argv, time.perf_counter()) == 130
    assert capsys.readouterr().err == "p4dgs-ref: stopped\n" and not list(tmp_path.iterdir())


def start(argv, cwd):
    """Start the command line in a process of its own, to which Ctrl-C can be sent."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-m", "p4dgs_ref", *argv],
        cwd=cwd,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def stop_at(iteration, argv, cwd, how):
    """Start a training, send it a signal at a checkpoint, and wait for its end."""
    process, checkpoint = start(argv, cwd), cwd / argv[argv.index("-o") + 1]
    deadline = time.monotonic() + 40
    while not (
        (checkpoint / CHECKPOINT).exists() and load(checkpoint)[1]["iteration"] >= iteration
    ):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(how)
    return process.wait(timeout=60), process.stderr.read()


def command(run, *more, last):
    ends = f"stage_ends={last // 6},{last // 4},{last // 2},{last}"
    return [
        "train",
        "bouncing",
        "-o",
        run,
        "--preset",
        "smoke",
        "--seed",
        "2",
        "--downscale",
        "4",
        "--set",
        ends,
        "--set",
        "grow=reseed",
        "--save-every",
        "0",
        *more,
    ]


def run_to_the_end(argv, cwd):
    process = start(argv, cwd)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out


@pytest.mark.slow
def test_interrupted_then_killed_then_resumed(tmp_path):
    uninterrupted = start(command("a run", "--quiet", last=240), tmp_path)
    code, err = stop_at(50, command("b run", last=240), tmp_path, signal.SIGINT)
    assert code == 130 and "Traceback" not in err
    told = re.search(r"go on with: (p4dgs-ref train .*)\n$", err)
    resume = shlex.split(told[1])[1:]
    iteration = load(tmp_path / "b run")[1]["iteration"]
    assert 50 <= iteration < 240
    assert stop_at(iteration + 40, resume, tmp_path, signal.SIGKILL)[0] == -signal.SIGKILL
    assert iteration + 40 <= load(tmp_path / "b run")[1]["iteration"] < 240
    run_to_the_end(resume, tmp_path)
    assert uninterrupted.communicate(timeout=120)[1] == "" and uninterrupted.returncode == 0
    for name in ("a", "b"):
        run_to_the_end(["encode", f"{name} run", "-o", f"{name}.p4dgs"], tmp_path)
    assert (tmp_path / "a.p4dgs").read_bytes() == (tmp_path / "b.p4dgs").read_bytes()
    for name in ("training.csv", "training.png"):
        assert (tmp_path / "a run" / name).read_bytes() == (tmp_path / "b run" / name).read_bytes()


@pytest.mark.slow
def test_killed_again_and_again(tmp_path):
    """A training that was killed at a dozen places, in every stage, ends like one that was not."""
    last = 900
    run_to_the_end(command("whole", "--quiet", last=last), tmp_path)
    stop_at(30, command("broken", last=last), tmp_path, signal.SIGKILL)
    for at in range(100, 860, 70):
        stop_at(at, command("broken", "--resume", last=last), tmp_path, signal.SIGKILL)
    run_to_the_end(command("broken", "--resume", last=last), tmp_path)
    files = [p4.encode(load_model(tmp_path / run)[0]) for run in ("whole", "broken")]
    assert files[0] == files[1]
