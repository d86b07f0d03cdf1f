"""What each command does: one thin function a command, around one call of the Python face.

Imports stand inside the functions, so that `p4dgs-ref --help` is quick and an error in an option comes first.
"""
import json
import os
import sys
import time
from pathlib import Path


class UsageError(ValueError):
    """A mistake in what the command line was given: one line naming the option or file and what was expected."""


def show(arguments, value, text):
    """Print a value as JSON or, without --json, its text."""
    print(json.dumps(value, indent=1) if arguments.json else text)


def writable(path):
    """Make a folder and prove that files can be written there, before minutes are spent; returns the Path.

    Raises     UsageError naming the folder
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UsageError(f"{folder}: expected a folder that can be written to ({error.strerror})") from None
    return folder


def read_scene(arguments, name=None):
    from .scenes import load_scene
    background = arguments.background
    if "," in background:
        try:
            background = tuple(float(part) for part in background.split(","))
        except ValueError:
            raise UsageError(f"--background {background}: expected white, black or three numbers r,g,b") from None
    return load_scene(name or arguments.scene, background=background, downscale=arguments.downscale)


def read_changes(arguments):
    """--set key=value, ... as {key: value}, checked against the preset before any work begins."""
    from .training.presets import choose
    changes = {}
    for item in arguments.changes:
        key, equals, value = item.partition("=")
        if not equals:
            raise UsageError(f"--set {item}: expected KEY=VALUE")
        changes[key] = value
    try:
        return choose(arguments.preset, changes), changes
    except ValueError as error:
        raise UsageError(str(error)) from None


def estimate(scene, preset, arguments):
    """Before a training of hours: time its first steps, say so, and go on only with --yes."""
    if preset.anchors <= 1000 and preset.iterations <= 10_000:
        return
    from .training.trainer import Trainer
    trainer, start = Trainer(scene, preset, arguments.seed), time.perf_counter()
    steps = 0
    while steps < 3 and time.perf_counter() - start < 60:
        trainer.step()
        steps += 1
    hours = (time.perf_counter() - start) / steps * preset.iterations / 3600
    print(f"preset {preset.name}: about {hours:.1f} hours for {preset.iterations} iterations, from the first {steps} "
          f"(later stages cost more)", file=sys.stderr)
    if hours > 1 and not arguments.yes:
        raise UsageError("--yes: expected, to start a training of more than an hour")


def demo(arguments):
    from .experiments.main_job import main_job
    preset, changes = read_changes(arguments)
    scene, folder = read_scene(arguments), writable(arguments.output)
    if not scene.test:
        raise UsageError(f"scene {scene.name}: split 'test' has no views, and the report needs them")
    estimate(scene, preset, arguments)
    metrics = main_job(scene, preset, arguments.seed, folder, arguments.start,
                       None if arguments.quiet else sys.stderr)
    show(arguments, metrics, describe(metrics, folder))


def describe(metrics, folder):
    """The metrics in a few lines, for people."""
    decibel = "inf" if metrics["psnr_db"] is None else f"{metrics['psnr_db']:.2f}"
    foreground = metrics["psnr_fg_db"]
    return "\n".join([
        f"scene {metrics['scene']}, preset {metrics['preset']}, seed {metrics['seed']}: "
        f"{metrics['anchors']} anchors, {metrics['gaussians']} Gaussians",
        f"  from the decoded file, test views: PSNR {decibel} dB"
        + ("" if foreground is None else f" (object {foreground:.2f} dB)") + f", SSIM {metrics['ssim']:.4f}",
        f"  file {metrics['bytes']} bytes; the same Gaussians as float32 {metrics['explicit_bytes']} "
        f"({metrics['ratio']:.1f} times; {metrics['ratio_without_sh']:.1f} without SH)",
        f"  train {metrics['train_seconds']:.1f} s ({metrics['ms_per_step']:.1f} ms a step), "
        f"encode {metrics['encode_seconds']:.2f} s, decode {metrics['decode_seconds']:.2f} s, "
        f"render {metrics['render_fps']:.0f} frames/s, in all {metrics['seconds']:.1f} s",
        f"  report in {folder}"])


def simulate(arguments):
    from .scenes import simulate as draw
    folder = Path(arguments.output)
    writable(folder.parent if str(folder.parent) else ".")

    def progress(done, total):
        if not arguments.quiet and (sys.stderr.isatty() or done == total):
            sys.stderr.write(f"\r{done}/{total} pictures" + ("\n" if done == total else ""))

    start = time.perf_counter()
    draw(arguments.scene, folder, progress=progress)
    seconds = time.perf_counter() - start
    show(arguments, {"output": str(folder), "seconds": seconds}, f"{folder}: drawn in {seconds:.1f} s")


def train(arguments):
    from .training.checkpoint import CHECKPOINT, write_atomically
    from .training.fit import fit
    preset, _ = read_changes(arguments)
    scene, folder = read_scene(arguments), writable(arguments.output)
    if (folder / CHECKPOINT).exists() and not arguments.resume:
        raise UsageError(f"{folder / CHECKPOINT}: exists; --resume goes on from it, another -o starts anew")
    if not arguments.resume:
        estimate(scene, preset, arguments)
    start = time.perf_counter()
    trainer = fit(scene, preset, arguments.seed, folder=folder, resume=arguments.resume,
                  stream=None if arguments.quiet else sys.stderr)
    seconds = time.perf_counter() - start
    from .experiments.report import draw_training, write_csv
    from .training.progress import COLUMNS
    if trainer.history:
        write_csv(folder / "training.csv", trainer.history, COLUMNS)
        draw_training(folder / "training.png", trainer.history, preset.stage_ends)
    run = {"scene": scene.name, "preset": preset.name, "seed": arguments.seed, "iterations": trainer.iteration,
           "anchors": len(trainer.mask), "seconds": seconds, "output": str(folder)}
    write_atomically(folder / "run.json", lambda file: file.write(json.dumps(run, indent=1).encode() + b"\n"))
    show(arguments, run, f"{folder}: {run['iterations']} iterations, {run['anchors']} anchors, {seconds:.1f} s")


def encode(arguments):
    from .codec.file import encode as encode_model
    from .training.checkpoint import write_atomically
    from .training.fit import load_model
    output = Path(arguments.output)
    if output.is_dir():
        raise UsageError(f"{output}: expected the name of a file, found a folder")
    model, values = load_model(arguments.run)
    start = time.perf_counter()
    data = encode_model(model)
    seconds = time.perf_counter() - start
    writable(output.parent)
    write_atomically(output, lambda file: file.write(data))
    done = {"output": str(output), "bytes": len(data), "iteration": values["iteration"], "seconds": seconds}
    show(arguments, done, f"{output}: {len(data)} bytes, from iteration {values['iteration']}, {seconds:.2f} s")


def read_file(path):
    """A file's bytes and its model."""
    from .codec.container import BitstreamError
    from .codec.file import decode as decode_model
    data = Path(path).read_bytes()
    try:
        return data, decode_model(data)
    except BitstreamError as error:
        raise UsageError(f"{path}: {error}") from None


def decode(arguments):
    import numpy as np

    from .training.checkpoint import write_atomically
    _, model = read_file(arguments.file)
    folder = writable(arguments.output)
    arrays = {**model.anchors._asdict(), "lo": model.box[0], "hi": model.box[1], "background": model.background}
    arrays.update({f"grid.{i}": grid for i, grid in enumerate(model.grids)})
    for name, (weights, biases) in model.networks.items():
        arrays.update({f"{name}.W{i}": W for i, W in enumerate(weights)})
        arrays.update({f"{name}.b{i}": b for i, b in enumerate(biases)})
    settings = json.dumps(model.design._asdict(), indent=1).encode() + b"\n"
    write_atomically(folder / "model.npz", lambda file: np.savez(file, **arrays))
    write_atomically(folder / "model.json", lambda file: file.write(settings))
    done = {"output": str(folder), "anchors": len(model.anchors.mask), "arrays": len(arrays)}
    show(arguments, done, f"{folder}: model.npz with {len(arrays)} arrays, model.json")


def held_camera(arguments, model):
    """The camera that --azimuth, --elevation, --distance, --fov and --size describe, looking at the box's centre."""
    import numpy as np

    from .splatting.camera import look_at
    if not (0 < arguments.fov < 180 and arguments.distance > 0 and -90 < arguments.elevation < 90
            and 1 <= arguments.size <= 4096):
        raise UsageError("--fov in (0, 180), --distance > 0, --elevation in (-90, 90), --size in 1 ... 4096 expected")
    azimuth, elevation = np.radians([arguments.azimuth, arguments.elevation])
    middle = (model.box[0].astype(float) + model.box[1]) / 2
    outward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    focal = arguments.size / 2 / np.tan(np.radians(arguments.fov) / 2)
    return look_at(middle + arguments.distance * outward, middle, focal, focal, arguments.size, arguments.size)


def render(arguments):
    import imageio.v3 as iio
    import numpy as np

    from .splatting.settings import SETTINGS
    if arguments.settings not in SETTINGS:
        raise UsageError(f"--settings {arguments.settings}: expected one of {', '.join(SETTINGS)}")
    if arguments.frames < 1:
        raise UsageError(f"--frames {arguments.frames}: expected at least 1")
    _, model = read_file(arguments.file)
    if arguments.scene:
        scene = read_scene(arguments)
        views = [(Path(v.name).name, v.camera, v.time) for v in getattr(scene, arguments.split)]
    else:
        camera = held_camera(arguments, model)
        views = [(f"t_{i:03d}", camera, t) for i, t in enumerate(np.linspace(0, 1, arguments.frames))]
    folder, pixels, seconds = writable(arguments.output), [], []
    for name, camera, t in views:
        start = time.perf_counter()
        image = model.render(camera, t, SETTINGS[arguments.settings])
        seconds.append(time.perf_counter() - start)
        pixels.append((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
        iio.imwrite(folder / f"{Path(name).stem}.png", pixels[-1])
    if not arguments.scene and len(pixels) > 1:
        iio.imwrite(folder / "motion.gif", pixels + pixels[-2:0:-1], duration=60, loop=0)
    done = {"output": str(folder), "images": len(pixels), "ms_per_image": 1e3 * float(np.median(seconds or [0]))}
    show(arguments, done, f"{folder}: {len(pixels)} images, {done['ms_per_image']:.1f} ms each")


def evaluate(arguments):
    from .codec.inspect import components
    from .experiments import evaluate as measures
    data, model = read_file(arguments.file)
    scene = read_scene(arguments)
    if not scene.test:
        raise UsageError(f"scene {scene.name}: split 'test' has no views to evaluate on")
    metrics, rows, images = measures.evaluate(model, scene)
    explicit = measures.explicit_bytes(model, metrics["gaussians"])
    metrics = {"scene": scene.name, **measures.json_safe(metrics), "bytes": len(data), "explicit_bytes": explicit,
               "ratio": explicit / len(data), "components": components(data)}
    if arguments.output:
        from .experiments.report import draw_comparison, write_csv
        folder = writable(arguments.output)
        draw_comparison(folder / "comparison.png", scene.test, images, rows)
        write_csv(folder / "comparison.csv", rows)
    lines = [f"{row['name']:>12}  t {row['time']:.3f}  PSNR {row['psnr_db']:6.2f} dB  SSIM {row['ssim']:.4f}" for row in rows]
    decibel = "inf" if metrics["psnr_db"] is None else f"{metrics['psnr_db']:.2f}"
    lines.append(f"mean of {len(rows)}: PSNR {decibel} dB, SSIM {metrics['ssim']:.4f}; {len(data)} bytes, "
                 f"{metrics['render_fps']:.0f} frames/s")
    show(arguments, metrics, "\n".join(lines))


def inspect(arguments):
    from .codec.inspect import components, ledger
    data, model = read_file(arguments.file)
    rows = ledger(data)
    if arguments.output:
        from .experiments.evaluate import explicit_bytes
        from .experiments.report import draw_size, write_csv
        folder = writable(arguments.output)
        write_csv(folder / "size.csv", rows)
        draw_size(folder / "size.png", components(data), explicit_bytes(model, int(model.anchors.mask.sum())))
    lines = [f"{'section':16} {'bytes':>8} {'share':>7} {'entropy':>10} {'symbols':>8} {'bits each':>9}"]
    for row in rows:
        symbols = "" if row["symbols"] is None else row["symbols"]
        each = "" if row["bits_per_symbol"] is None else f"{row['bits_per_symbol']:.3f}"
        lines.append(f"{row['name']:16} {row['bytes']:8d} {100 * row['bytes'] / len(data):6.1f}% "
                     f"{row['estimate_bytes']:10.1f} {symbols:>8} {each:>9}")
    lines.append(f"{'file':16} {sum(row['bytes'] for row in rows):8d}")
    show(arguments, {"bytes": len(data), "sections": rows}, "\n".join(lines))


def equations(arguments):
    from . import catalogue
    show(arguments, {"equations": catalogue.rows()}, catalogue.table())


def presets(arguments):
    from .training.presets import PAPER_REAL, PAPER_SYNTHETIC, PRESETS, differences
    if arguments.preset and arguments.preset not in PRESETS:
        raise UsageError(f"preset {arguments.preset!r}: expected one of {', '.join(PRESETS)}")
    chosen = [PRESETS[arguments.preset]] if arguments.preset else list(PRESETS.values())
    lines = []
    for preset in chosen:
        changed = differences(preset)
        lines.append(f"{preset.name}: {len(changed)} fields differ from {PAPER_SYNTHETIC.name}"
                     if preset is not PAPER_SYNTHETIC else f"{preset.name}: the paper's values")
        table = {field: (paper, here) for field, paper, here in changed}
        fields = preset._asdict() if arguments.preset else table
        for field in fields:
            if field == "name":
                continue
            here = f"{getattr(preset, field)}"
            mark = f"   (paper {table[field][0]}; real {getattr(PAPER_REAL, field)})" if field in table else ""
            lines.append(f"  {field:20} {here}{mark}")
    value = {preset.name: {"fields": preset._asdict(), "differs": [
        {"field": field, "paper": paper, "here": here} for field, paper, here in differences(preset)]} for preset in chosen}
    show(arguments, value, "\n".join(lines))


def bench(arguments):
    from .experiments.bench import bench as measure
    from .experiments.bench import describe as text
    result = measure(arguments.quick)
    show(arguments, result, text(result))
