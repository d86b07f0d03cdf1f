"""The commands of the main job, and those about its files."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import p4dgs_ref as p4

from ..codec import container
from ..messages import number_of
from ..output import new_file, refuse_existing, staged_folder, writable_folder, write_atomically
from ..report import figures
from ..report import inspect as sizes
from ..report import view as pages
from ..report.evaluate import call_with_seconds, compression, json_safe
from ..scenes.files import write_image
from ..scenes.load import read_points_for, read_scene_json
from ..scenes.scene import size_of
from ..training.fit import CHECKPOINT, HOW_TO_RESUME, fit_with_advice, load_model
from ..training.presets import choose
from . import (
    UsageError,
    ask,
    print_message,
    print_result,
    print_warning,
    progress,
    require_usage,
    show,
    text,
)

SECONDS = 6e-3, 5e-6, 2e-6  # of a step on a slow core; for each child of an anchor, each pixel
HOUR = 3600  # a longer training starts only after a question
FIXED = "azimuth elevation distance size frames".split()  # options of the camera of `render`


def read_preset(name, changes=()):
    """Return the preset with its --set changes, checked before any work begins."""
    try:
        return choose(name, dict(item.partition("=")[::2] for item in changes))
    except ValueError as error:
        raise UsageError(str(error)) from None


def read_file(path):
    """Return the bytes of a file, its model, and the seconds that decoding took."""
    require_usage(
        Path(path).is_file() or not Path(path).exists(),
        path,
        "a folder, pipe or device; expected a .p4dgs file",
    )
    try:
        data = container.read_file(path)
        return data, *call_with_seconds(p4.decode, data)
    except container.BitstreamError as error:
        raise UsageError(f"{path}: {error}") from None


def load(arguments):
    """Return the scene of a command; report the pictures that are read every ten seconds."""
    due = time.monotonic() + 2

    def report(done, total):
        nonlocal due
        if time.monotonic() > due:
            print_message(f"{arguments.scene}: {done} of {total} pictures are read")
            due += 10

    return p4.load_scene(arguments.scene, downscale=arguments.downscale, progress=report)


def estimate(arguments, scene, preset):
    """Say about how long a training takes; one of more than an hour starts after a question."""
    anchors = preset.anchors if scene.points is None else len(scene.points)
    image = scene.train[0].image
    step = np.dot(SECONDS, (1, anchors * preset.k, image[..., 0].size))
    what = f"{preset.iterations} iterations on pictures of {size_of(image)}"
    ask(arguments, what, step * preset.iterations, HOUR)


def demo(arguments):
    """Run the main job and write its report."""
    preset = read_preset(arguments.preset, arguments.changes)
    refuse_existing(Path(arguments.output) / "metrics.json")
    scene = load(arguments)
    estimate(arguments, scene, preset)
    metrics = p4.main_job(
        scene,
        preset,
        arguments.seed,
        arguments.output,
        arguments.start,
        None if arguments.quiet else sys.stderr,
    )
    print_result(text.metrics(metrics, arguments.output))


def simulate(arguments):
    """Draw the pictures of a scene.json."""
    p4.simulate(arguments.scene, arguments.output, lambda i, n: progress(f"{i}/{n} pictures"))
    print_result(f"{arguments.output}: drawn")


def train(arguments):
    """Train on a scene and write a run folder."""
    preset, resume = read_preset(arguments.preset, arguments.changes), arguments.resume
    if not resume:
        refuse_existing(Path(arguments.output) / CHECKPOINT, HOW_TO_RESUME)
    scene = load(arguments)
    if arguments.points:
        scene = replace(scene, points=read_points_for(scene.source, arguments.points))
    if not resume:
        estimate(arguments, scene, preset)
        if "effects" not in read_scene_json(scene.source):
            print_warning(
                f"no scene.json lists effects; `p4dgs-ref effects {scene.source} --suggest --apply "
                f"--downscale {arguments.downscale}` finds and lists those that the pictures show"
            )
    with writable_folder(arguments.output) as folder:
        trainer, *_ = fit_with_advice(
            scene,
            preset,
            arguments.seed,
            folder=folder,
            resume=resume,
            stream=None if arguments.quiet else sys.stderr,
        )
        with staged_folder(folder) as staging:
            figures.write_training(staging, trainer.history, preset.stage_ends)
    print_result(
        f"{folder}: {trainer.iteration} iterations, {number_of(len(trainer.mask), 'anchor')}"
    )


def encode(arguments):
    """Compress a run to a file."""
    checkpoint = Path(arguments.run) / CHECKPOINT
    with new_file(arguments.output, checkpoint, start=container.MAGIC) as output:
        model, values = load_model(arguments.run)
        data = p4.encode(model)
        write_atomically(output, lambda file: file.write(data))
    print_result(f"{output}: {len(data):,} bytes, from iteration {values['iteration']}")


def decode(arguments):
    """Write the arrays of a file as model.npz and its design as model.json."""
    _, model, _ = read_file(arguments.file)
    arrays = {
        **model.anchors._asdict(),
        **dict(zip(("lo", "hi"), model.box)),
        "background": model.background,
        **{f"grid.{i}": grid for i, grid in enumerate(model.grids)},
        **{
            f"{name}.{letter}{i}": array
            for name, network in model.networks.items()
            for letter, layers in zip("Wb", network)
            for i, array in enumerate(layers)
        },
    }
    with staged_folder(arguments.output, arguments.file) as staging:
        np.savez(staging / "model.npz", **arrays)
        (staging / "model.json").write_text(
            json.dumps(vars(model.design), indent=1) + "\n", encoding="utf-8"
        )
    print_result(f"{arguments.output}: model.npz with {len(arrays)} arrays, model.json")


def render(arguments):
    """Draw pictures of a file into a new folder; those of a fixed camera also as a GIF."""
    output, scene = Path(arguments.output), arguments.scene
    fixed = {name: value for name in FIXED if (value := getattr(arguments, name)) is not None}
    require_usage(not (scene and fixed), f"--{', --'.join(fixed)}", "expected without --scene")
    require_usage(
        scene or arguments.downscale == 1, "--downscale", "expected together with --scene"
    )
    _, model, _ = read_file(arguments.file)
    with staged_folder(output) as staging:
        require_usage(
            not any(output.glob("[!.]*")),
            output,
            "has files already; expected a new or an empty folder, so that all pictures are of one "
            "run",
        )
        if scene:
            kind, views = "view", [(view.camera, view.time) for view in load(arguments).test]
        else:
            times = np.linspace(0, 1, fixed.pop("frames", 24))
            camera = figures.fixed_camera(model, **fixed)
            kind, views = "t", [(camera, t) for t in times]
        images = [np.clip(model.render(*view), 0, 1) for view in views]
        for i, image in enumerate(images):
            pixels = (image * 255).round().astype(np.uint8)
            write_image(staging / f"{kind}_{i:03d}.png", pixels)
        if not scene:
            (staging / "motion.gif").write_bytes(figures.gif_of(images))
    print_result(f"{output}: {len(images)} images")


def view(arguments):
    """Write a page that shows files."""
    files = {name: read_file(name)[0] for name in arguments.files}
    output = arguments.output or Path(arguments.files[0]).with_suffix(".html")
    size = pages.view(files, output)
    print_result(
        f"{output}: {size:,} bytes, with {', '.join(arguments.files)}; open it in a browser"
    )


def evaluate(arguments):
    """Measure a file on the test views of a scene."""
    data, model, seconds = read_file(arguments.file)
    scene = load(arguments)
    metrics, rows, images = p4.evaluate(model, scene)
    metrics = {
        "scene": scene.name,
        **metrics,
        **compression(model, data, metrics["gaussians"]),
        "decode_seconds": seconds,
    }
    if arguments.output:
        with staged_folder(arguments.output, arguments.file) as staging:
            figures.write_comparison(staging, scene, rows, images)
    show(
        arguments,
        {**json_safe(metrics), "views": [json_safe(row) for row in rows]},
        text.evaluation(metrics, rows),
    )


def inspect(arguments):
    """List the sections of a file."""
    data, _, _ = read_file(arguments.file)
    rows, gaps = sizes.ledger(data), sizes.GAPS
    show(arguments, {"bytes": len(data), "sections": rows, "gaps": gaps}, text.ledger(rows, gaps))


def presets(arguments):
    """Print the presets beside the paper's values."""
    one = arguments.preset
    for name in [one] if one else p4.PRESETS:
        print_result(text.preset(read_preset(name), bool(one)))
