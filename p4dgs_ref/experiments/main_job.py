"""The main job: a scene is fitted, compressed to a file, decoded from that file alone, rendered, measured, drawn."""
import json
import time
from pathlib import Path

from ..codec.file import decode, encode
from ..codec.inspect import components
from ..training.checkpoint import write_atomically
from ..training.fit import fit
from ..training.presets import PRESETS, differences
from .evaluate import FLOATS_WITHOUT_SH_REST, evaluate, explicit_bytes, json_safe
from .report import write_report


def timed(function, *args):
    """A function's value and the seconds it took."""
    start = time.perf_counter()
    return function(*args), time.perf_counter() - start


def main_job(scene, preset, seed, folder, start=None, stream=None, **changes):
    """Run everything and write the report into `folder`, which must exist; returns the metrics.

    `start` is the `time.perf_counter()` from which the command's seconds count.  Pictures and metrics are those of
    the decoded model; a picture appears in `folder` only when all are done.
    """
    start = time.perf_counter() if start is None else start
    folder = Path(folder)
    trainer, train_seconds = timed(lambda: fit(scene, preset, seed, stream=stream, **changes))
    data, encode_seconds = timed(encode, trainer.model())
    path = folder / f"{scene.name}.p4dgs"
    write_atomically(path, lambda file: file.write(data))
    model, decode_seconds = timed(decode, path.read_bytes())
    metrics, rows, images = evaluate(model, scene)
    changed = {field: here for field, _, here in differences(trainer.preset, PRESETS[trainer.preset.name])}
    sizes, explicit = components(data), explicit_bytes(model, metrics["gaussians"])
    metrics = {"scene": scene.name, "preset": trainer.preset.name, "seed": seed, **json_safe(metrics),
               "bytes": len(data), "train_seconds": train_seconds,
               "ms_per_step": 1e3 * train_seconds / trainer.preset.iterations, "encode_seconds": encode_seconds,
               "decode_seconds": decode_seconds, "explicit_bytes": explicit, "ratio": explicit / len(data),
               "ratio_without_sh": explicit_bytes(model, metrics["gaussians"], FLOATS_WITHOUT_SH_REST) / len(data),
               "components": sizes, "effects": list(scene.effects), "changes": changed}
    write_report(folder, model, scene, rows, images, sizes, explicit, trainer.history, trainer.preset.stage_ends)
    metrics["seconds"] = time.perf_counter() - start
    text = json.dumps(metrics, indent=1).encode() + b"\n"
    write_atomically(folder / "metrics.json", lambda file: file.write(text))
    return metrics
