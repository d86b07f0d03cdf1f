"""The main job: fit a scene, compress it to a file, decode that file, render, measure, draw."""

import json
import time

from ..codec.file import decode, encode
from ..scenes.output import filled
from ..training.fit import fit
from ..training.presets import PRESETS, differences
from .evaluate import compression, evaluate, json_safe, timed
from .report import write_report


def main_job(scene, preset="tiny", seed=0, folder="report", start=None, stream=None, **changes):
    """Run everything, write the report into `folder` and return the metrics.

    Pictures and metrics are those of the decoded model. The folder gets all files at the end, or
    none. `start` is the `time.perf_counter()` from which the seconds of the whole job count; the
    other arguments are those of `train`. Raises the errors of `train`, ValueError for a scene
    without test views, and OutputError for a folder that cannot be written.
    """
    start = time.perf_counter() if start is None else start
    if not scene.test:
        raise ValueError(
            f"scene {scene.name}: split 'test': no views; expected at least one to measure on"
        )
    with filled(folder) as beside:
        trainer, train_seconds = timed(lambda: fit(scene, preset, seed, stream=stream, **changes))
        data, encode_seconds = timed(encode, trainer.model())
        path = beside / f"{scene.name.replace('/', '_')}.p4dgs"
        path.write_bytes(data)
        model, decode_seconds = timed(decode, path.read_bytes())
        metrics, rows, images = evaluate(model, scene)
        chosen = trainer.preset
        metrics = {
            "scene": scene.name,
            "preset": chosen.name,
            "seed": seed,
            **metrics,
            **compression(model, data, metrics["gaussians"]),
            "train_seconds": train_seconds,
            "ms_per_step": 1e3 * train_seconds / chosen.iterations,
            "encode_seconds": encode_seconds,
            "decode_seconds": decode_seconds,
            "effects": list(scene.effects),
            "changes": {
                field: here for field, _, here in differences(chosen, PRESETS[chosen.name])
            },
        }
        write_report(
            beside, model, scene, rows, images, metrics, trainer.history, chosen.stage_ends
        )
        metrics["seconds"] = time.perf_counter() - start
        (beside / "metrics.json").write_text(json.dumps(json_safe(metrics), indent=1) + "\n")
    return metrics
