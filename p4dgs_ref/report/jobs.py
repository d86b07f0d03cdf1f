"""The main job: train on a scene, compress to a file, decode it, render, measure, draw."""

import json
import re
import time
import warnings
from pathlib import Path
from typing import Any, TextIO

from ..arithmetic import arithmetic
from ..codec.container import EncodeError
from ..codec.file import decode, encode
from ..output import refuse_existing, staged_folder
from ..scenes.scene import Scene
from ..training.fit import fit_with_advice, identity, save_checkpoint
from ..training.presets import PRESETS, Preset, choose, differences
from . import figures
from .evaluate import call_with_seconds, compression, evaluate, json_safe

OVERFITTED = 6  # dB; training views that are better than test views by more get a warning


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

    Pictures and metrics are those of the decoded model. The folder gets all files at the end, or
    none. `start` is the `time.perf_counter()` from which the seconds of the whole job count; the
    other arguments are those of `train`. Raises the errors of `train` and `evaluate`, OutputError
    for a folder that cannot be written or holds an earlier report, and EncodeError for a model that
    no file holds, whose checkpoint stays in the folder.
    """
    start = time.perf_counter() if start is None else start
    preset, name = choose(preset, changes), re.sub(r"[/\\:]", "_", scene.name)
    with staged_folder(folder) as staging:
        path = staging / f"{name}.p4dgs"
        for file in (path.name, "metrics.json"):
            refuse_existing(Path(folder) / file)
        trainer, seconds, warning = fit_with_advice(scene, preset, seed, stream=stream)
        try:
            data, encode_seconds = call_with_seconds(encode, trainer.model())
        except (EncodeError, OverflowError) as error:
            save_checkpoint(trainer, folder, identity(trainer))
            raise EncodeError(f"{error}; the training is kept in {folder}") from None
        path.write_bytes(data)
        model, decode_seconds = call_with_seconds(decode, path.read_bytes())
        measures, rows, images = evaluate(model, scene)
        trained = evaluate(model, scene, split="train")[0]["psnr_db"]
        if trained > measures["psnr_db"] + OVERFITTED:
            warnings.warn(
                f"scene {scene.name}: training views have {trained:.2f} dB at {measures['size']}, "
                f"test views {measures['psnr_db']:.2f} dB: the model knows the pictures better "
                "than the scene; more cameras, or slower motion between them, would tell more",
                stacklevel=2,
            )
        metrics = {
            "scene": scene.name,
            "preset": preset.name,
            "seed": seed,
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
        figures.write_comparison(staging, scene, rows, images)
        figures.write_motion(staging / "motion.gif", model, scene.test[0].camera)
        figures.write_size(staging, preset.name, metrics)
        figures.write_training(staging, trainer.history, preset.stage_ends)
        metrics["seconds"] = time.perf_counter() - start
        (staging / "metrics.json").write_text(
            json.dumps(json_safe(metrics), indent=1) + "\n", encoding="utf-8"
        )
    return metrics
