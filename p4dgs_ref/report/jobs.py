"""The main job: train on a scene, compress to a file, decode it, render, measure, draw."""

import json
import re
import time
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from ..arithmetic import arithmetic
from ..codec.file import decode, encode
from ..output import refuse_existing, staged_folder
from ..scenes.scene import Scene
from ..training.fit import (
    CHECKPOINT,
    HOW_TO_RESUME,
    fit_with_advice,
    identity,
    save_checkpoint,
)
from ..training.presets import PRESETS, Preset, choose, differences
from ..training.trainer import Trainer
from . import figures
from .evaluate import call_with_seconds, compression, evaluate, json_safe

OVERFITTED = 6  # dB; a warning is given if training views are better than test views by more


def main_job(
    scene: Scene,
    preset: str | Preset = "tiny",
    seed: int = 0,
    folder: str | Path = "report",
    start: float | None = None,
    stream: TextIO | None = None,
    **changes: Any,
) -> dict:
    """Run everything, write the report into `folder` and return the metrics.

    Pictures and metrics are those of the decoded model; what a scene without test views cannot tell
    is None. The folder gets all files at the end, or none; only the checkpoint of the trained model
    stays in it if something fails after the training. `start` is the `time.perf_counter()` from
    which the seconds of the whole job count; the other arguments are those of `train`. Raises the
    errors of `train` and `evaluate`, OutputError for a folder that cannot be written or has an
    earlier report, and EncodeError for a model that no file can contain.
    """
    start = time.perf_counter() if start is None else start
    preset, name = choose(preset, changes), re.sub(r"[/\\:]", "_", scene.name)
    with keep_training(folder) as keep, staged_folder(folder) as staging:
        path = staging / f"{name}.p4dgs"
        for file in (path.name, "metrics.json"):
            refuse_existing(Path(folder) / file)
        trainer = Trainer(scene, preset, seed)
        warning, seconds = fit_with_advice(trainer, stream=stream, keep=keep)
        data, encode_seconds = call_with_seconds(encode, trainer.model())
        path.write_bytes(data)
        model, decode_seconds = call_with_seconds(decode, path.read_bytes())
        measures, *_ = evaluate(model, scene, split="train")
        trained = measures["psnr_db"]
        if scene.test:
            measures, rows, images = evaluate(model, scene)
            figures.write_comparison(staging, scene, rows, images)
        else:
            measures |= dict.fromkeys(("psnr_db", "psnr_fg_db", "ssim"))
        if scene.test and trained > measures["psnr_db"] + OVERFITTED:
            warnings.warn(
                f"scene {scene.name}: training views have {trained:.2f} dB at {measures['size']}, "
                f"test views {measures['psnr_db']:.2f} dB: the model has learned the training "
                "pictures rather than the scene; more cameras, or less motion, would help",
                stacklevel=2,
            )
        metrics = {
            "scene": scene.name,
            "preset": preset.name,
            "seed": trainer.seed,
            "arithmetic": arithmetic(),
            **measures,
            "train_psnr_db": trained,
            **compression(model, data, measures["gaussians"]),
            "train_seconds": seconds,
            "ms_per_step": 1e3 * seconds / preset.iterations,
            "encode_seconds": encode_seconds,
            "decode_seconds": decode_seconds,
            "warning": warning,
            "effects": list(scene.effects),
            "changes": {
                field: here for field, _, here in differences(preset, PRESETS[preset.name])
            },
        }
        figures.write_motion(staging / "motion.gif", model, scene)
        figures.write_size(staging, preset.name, metrics)
        figures.write_training(staging, trainer.history, preset.stage_ends)
        metrics["seconds"] = time.perf_counter() - start
        (staging / "metrics.json").write_text(
            json.dumps(json_safe(metrics), indent=1) + "\n", encoding="utf-8"
        )
    return metrics


@contextmanager
def keep_training(folder):
    """Yield a function that saves a trained Trainer; the checkpoint stays if a later step fails."""
    checkpoint = Path(folder) / CHECKPOINT
    refuse_existing(checkpoint, HOW_TO_RESUME)
    try:
        yield lambda trainer: save_checkpoint(trainer, folder, identity(trainer))
    except BaseException:
        if checkpoint.exists():
            warnings.warn(f"the training is kept in {checkpoint}; `encode` reads it")
        raise
    checkpoint.unlink()
