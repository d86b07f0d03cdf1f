"""The main job: fit a scene, compress it to a file, decode that file, render, measure, draw."""

import json
import time
import warnings
from pathlib import Path
from typing import Any, TextIO

from ..codec.file import decode, encode
from ..scenes.output import filled
from ..scenes.scene import Scene
from ..training.fit import fit
from ..training.presets import PRESETS, Preset, choose, differences, paper_design
from . import figures as report
from .evaluate import compression, evaluate, json_safe, timed
from .jobs import processes


def one_design(scene, preset, seed, path, stream):
    """Train, write the file, decode it and measure the decoded model.

    Returns metrics, the rows and images of the views, the model, and the history of the training.
    """
    trainer, train_seconds = timed(lambda: fit(scene, preset, seed, stream=stream))
    data, encode_seconds = timed(encode, trainer.model())
    path.write_bytes(data)
    model, decode_seconds = timed(decode, path.read_bytes())
    metrics, rows, images = evaluate(model, scene)
    metrics = {
        **metrics,
        **compression(model, data, metrics["gaussians"]),
        "train_seconds": train_seconds,
        "ms_per_step": 1e3 * train_seconds / preset.iterations,
        "encode_seconds": encode_seconds,
        "decode_seconds": decode_seconds,
    }
    return metrics, rows, images, model, trainer.history


def unwatched(*task):
    """The metrics of a design that is trained beside another; its warnings are dropped."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return one_design(*task, stream=None)[0]


def both_designs(scene, preset, seed, path, stream, jobs):
    """The metrics of the paper's design, and what `one_design` returns for the preset itself."""
    paper_path = path.with_name(f"{path.stem}_paper_design{path.suffix}")
    paper = scene, paper_design(preset), seed, paper_path
    if jobs > 1:
        announce(stream, f"preset {preset.name}; the paper's design is trained beside it")
        with processes(1) as pool:
            waiting = pool.submit(unwatched, *paper)
            own = one_design(scene, preset, seed, path, stream)
            return waiting.result(), own
    announce(stream, "1 of 2 trainings: the paper's design, for comparison")
    metrics, *_ = one_design(*paper, stream)
    announce(stream, f"2 of 2 trainings: preset {preset.name}")
    return metrics, one_design(scene, preset, seed, path, stream)


def announce(stream, what):
    """A line before a training."""
    if stream is not None:
        print(what, file=stream)


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

    A preset with coded networks is trained twice: as it is, and as the paper's design; at once if
    `jobs` is at least 2, and then times are those of two processes that share the machine. Pictures
    and metrics are those of the preset's own decoded model; `paper_design` has bytes, PSNR and SSIM
    of the other, or of the same model where the preset is the paper's design. The folder gets all
    files at the end, or none. `start` is the `time.perf_counter()` from which the seconds of the
    whole job count; the other arguments are those of `train`. Raises the errors of `train`,
    ValueError for a scene without test views, and OutputError for a folder that cannot be written.
    """
    start = time.perf_counter() if start is None else start
    chosen, name = choose(preset, changes), scene.name.replace("/", "_")
    if not scene.test:
        raise ValueError(
            f"scene {scene.name}: split 'test': no views; expected at least one to measure on"
        )
    with filled(folder) as beside:
        path, paper = beside / f"{name}.p4dgs", None
        if chosen.coded:
            paper, found = both_designs(scene, chosen, seed, path, stream, jobs)
        else:
            found = one_design(scene, chosen, seed, path, stream)
        own, rows, images, model, history = found
        metrics = {
            "scene": scene.name,
            "preset": chosen.name,
            "seed": seed,
            **own,
            "paper_design": {key: (paper or own)[key] for key in ("bytes", "psnr_db", "ssim")},
            "trained_at_once": chosen.coded and jobs > 1,
            "effects": list(scene.effects),
            "changes": {
                field: here for field, _, here in differences(chosen, PRESETS[chosen.name])
            },
        }
        report.write_comparison(beside, scene, rows, images)
        report.write_motion(beside / "motion.gif", model, scene.test[0].camera)
        report.write_size(beside, chosen.name, own, paper)
        report.write_training(beside, history, chosen.stage_ends)
        metrics["seconds"] = time.perf_counter() - start
        (beside / "metrics.json").write_text(json.dumps(json_safe(metrics), indent=1) + "\n")
    return metrics
