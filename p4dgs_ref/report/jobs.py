"""The main job: fit a scene, compress it to a file, decode that file, render, measure, draw.

Its two designs are independent, as are the trainings of a study, and can run in several processes.
Studies never take times in them.
"""

import json
import multiprocessing
import os
import signal
import threading
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from ..arithmetic import arithmetic, keep_pages
from ..designs import (
    PRESETS,
    beyond,
    choose,
    decode,
    encode,
    fit,
    paper_name,
    paper_preset,
    what_is_lost,
)
from ..output import absent, filled
from ..scenes.scene import Scene
from ..signals import SIGNALS, deferred
from ..training.fit import doubts, warn
from ..training.presets import Preset, differences
from . import figures as report
from .evaluate import compression, evaluate, json_safe, timed

# --- several processes ----------------------------------------------------------------------------
UNGUARDED = 70  # exit code of a worker that the script would let start workers


def begin():
    """What a worker does first. It has inherited the kernels and the number of BLAS threads."""
    keep_pages()
    # Those that reach all processes of a terminal; the parent stops its workers by SIGTERM.
    for number in SIGNALS - {signal.SIGTERM}:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent():
    """Wait in a worker until its parent has ended, however it did, then end the worker."""
    multiprocessing.parent_process().join()
    os._exit(1)


def recorded(function, *arguments):
    """The result of a call in a worker, and the warnings that it gave."""
    with warnings.catch_warnings(record=True) as given:
        result = function(*arguments)
    return result, [one.message for one in given]


def received(result, given):
    """The result of a call in a worker; its warnings are given again, by this process."""
    for warning in given:
        warnings.warn(warning, stacklevel=3)
    return result


@contextmanager
def processes(jobs):
    """Yield `start(function, *arguments)`, which calls a function in one of `jobs` processes.

    `start` returns at once; what it returns waits for the result when it is called. The processes
    end with this context, also where it is left early. Raises ChildProcessError where one of them
    ends before its work is done.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(UNGUARDED)  # a worker that imports the script may start none
    others, workers = set(multiprocessing.active_children()), set()
    pool = ProcessPoolExecutor(
        jobs,
        multiprocessing.get_context("spawn"),
        initializer=begin,
    )

    def start(function, *arguments):
        # A process that has not read what it is to do when its parent is interrupted ends with a
        # traceback.
        with deferred():
            future = pool.submit(recorded, function, *arguments)
            workers.update(multiprocessing.active_children())
        return lambda: received(*future.result())

    try:
        yield start
    except BrokenProcessPool:
        pool.shutdown()  # the exit codes of all are known then
        is_unguarded = UNGUARDED in {process.exitcode for process in workers - others}
        raise ChildProcessError(
            "a worker process ran the script, which starts workers itself; expected its calls "
            'below `if __name__ == "__main__":`, or jobs=1'
            if is_unguarded
            else "a worker process was killed, probably because memory ran out; --jobs 1 (jobs=1) "
            "needs the least"
        ) from None
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)


def in_processes(function, tasks, jobs):
    """Yield function(task) for every task of a list, in their order, from `jobs` processes.

    With one job everything runs in this process. A task and its result must be picklable. The
    processes end with this generator, also where it is stopped early.
    """
    if min(jobs, len(tasks)) <= 1:
        yield from map(function, tasks)
    else:
        with processes(min(jobs, len(tasks))) as start:
            for result in [start(function, task) for task in tasks]:
                yield result()


# --- the main job ---------------------------------------------------------------------------------
def one_design(scene, preset, seed, path, stream=None):
    """Train, write the file, decode it and measure the decoded model.

    Returns metrics, the rows and images of the views, the model, and the history of the training.
    """
    trainer, seconds = timed(fit, scene, preset, seed, stream=stream)
    data, encode_seconds = timed(encode, trainer.model())
    path.write_bytes(data)
    model, decode_seconds = timed(decode, path.read_bytes())
    metrics, rows, images = evaluate(model, scene)
    metrics = {
        **metrics,
        **compression(model, data, metrics["gaussians"]),
        "train_seconds": seconds,
        "ms_per_step": 1e3 * seconds / preset.iterations,
        "encode_seconds": encode_seconds,
        "decode_seconds": decode_seconds,
        "warning": what_is_lost(trainer),
    }
    return metrics, rows, images, model, trainer.history


def designs(scene, preset, seed, path, stream, jobs):
    """What `one_design` returns for the preset, and the metrics of the paper's design beside it.

    There are no other metrics where the preset is the paper's design.
    """
    ours = (scene, preset, seed, path)
    if not beyond(preset):
        return one_design(*ours, stream), None
    paper_path = path.with_name(f"{path.stem}_paper_design{path.suffix}")
    paper = (scene, paper_preset(preset), seed, paper_path)
    if jobs == 1:
        return one_design(*ours, stream), one_design(*paper, stream)[0]
    done = None
    try:
        with processes(1) as start:
            waiting = start(one_design, *paper)
            done = one_design(*ours, stream)
            return done, waiting()[0]
    except (ChildProcessError, MemoryError) as error:
        if done is None:
            raise
        warn(f"{error or 'out of memory'}; this process trains the paper's design again")
        return done, one_design(*paper, stream)[0]


def main_job(
    scene: Scene,
    preset: str | Preset = "tiny_coded",
    seed: int = 0,
    folder: str | Path = "report",
    start: float | None = None,
    stream: TextIO | None = None,
    jobs: int = 1,
    **changes: Any,
) -> dict:
    """Run everything, write the report into `folder` and return the metrics.

    A preset that goes beyond the paper is trained as it is and as the paper's design, in two
    processes at once if `jobs` is at least 2; then the times are those of two processes that share
    the machine. Pictures and metrics are those of the preset's own decoded model;
    `beyond_the_paper` lists what is ours in it, and `paper_design` has name, bytes, PSNR and SSIM
    of the other, or of the same model where the preset is the paper's. The folder gets all files at
    the end, or none. `start` is the `time.perf_counter()` from which the seconds of the whole job
    count; the other arguments are those of `train`. Raises the errors of `train` and `evaluate`,
    and OutputError for a folder that cannot be written or holds an earlier report.
    """
    start = time.perf_counter() if start is None else start
    preset, name = choose(preset, changes), scene.name.replace("/", "_")
    with filled(folder) as staging:
        for file in (f"{name}.p4dgs", f"{name}_paper_design.p4dgs", "metrics.json"):
            absent(Path(folder) / file)
        for sentence in doubts(scene, preset, seed):
            warn(sentence)
        (ours, rows, images, model, history), paper = designs(
            scene, preset, seed, staging / f"{name}.p4dgs", stream, jobs
        )
        metrics = {
            "scene": scene.name,
            "preset": preset.name,
            "seed": seed,
            "arithmetic": arithmetic(),
            **ours,
            "beyond_the_paper": beyond(preset),
            "paper_design": {
                "name": paper_name(preset),
                **{key: (paper or ours)[key] for key in ("bytes", "psnr_db", "ssim")},
            },
            "trained_at_once": paper is not None and jobs > 1,
            "effects": list(scene.effects),
            "changes": {
                field: here for field, _, here in differences(preset, PRESETS[preset.name])
            },
        }
        report.write_comparison(staging, scene, rows, images)
        report.write_motion(staging / "motion.gif", model, scene.test[0].camera)
        report.write_size(staging, {preset.name: ours, paper_name(preset): paper})
        report.write_training(staging, history, preset.stage_ends)
        warn(ours["warning"])
        warn(paper and paper["warning"] and f"{paper_name(preset)}: {paper['warning']}")
        metrics["seconds"] = time.perf_counter() - start
        (staging / "metrics.json").write_text(
            json.dumps(json_safe(metrics), indent=1) + "\n", encoding="utf-8"
        )
    return metrics
