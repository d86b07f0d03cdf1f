"""The commands of the main job, and those about its files."""

import json
import sys
from collections import Counter
from contextlib import nullcontext
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
from ..scenes.load import find_scene, find_views, read_points_for, read_scene_json
from ..scenes.scene import size_of
from ..training.fit import (
    CHECKPOINT,
    HOW_TO_RESUME,
    fit_with_advice,
    load_checkpoint,
    load_model,
)
from ..training.presets import choose
from ..training.trainer import Trainer
from . import (
    UsageError,
    ask,
    print_result,
    print_warning,
    progress,
    require_usage,
    show,
    text,
)

# Of a training step: fixed, per child of an anchor, per pixel, per child and pixel. Measured with
# 40 to 100,000 children and 256 to 640,000 pixels; right within a factor of 2.
SECONDS = 1.2e-3, 6.5e-6, 1.2e-6, 1.8e-10

HOUR = 3600  # longer trainings start only after a question
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


def load(arguments, preset=None, points=None):
    """Return the scene of a command; on a terminal a line counts the pictures read.

    With a preset, the first picture tells how long its training takes. If that is more than an
    hour, the user is asked before the other pictures are read.
    """
    files = find_views(arguments.scene, downscale=arguments.downscale)
    points = files.points if points is None else points
    if preset:
        children = preset.k * (preset.anchors if points is None else len(points))
        image = (files.train + files.test)[0](files.background, Counter()).image
        step = step_seconds(children, image[..., 0].size)
        what = f"{preset.iterations:,} iterations at {size_of(image)}"
        ask(arguments, what, step * preset.iterations, HOUR)
    return replace(files, points=points).read(
        lambda i, n: progress(f"{arguments.scene}: {i}/{n} pictures read")
    )


def step_seconds(children, pixels):
    """Return about how many seconds a training step takes on a slow core."""
    return np.dot(SECONDS, (1, children, pixels, children * pixels))


def demo(arguments):
    """Run the main job and write its report."""
    preset = read_preset(arguments.preset, arguments.changes)
    with writable_folder(arguments.output):
        refuse_existing(Path(arguments.output) / "metrics.json")
        metrics = p4.main_job(
            load(arguments, preset),
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
    print_result(f"{arguments.output}: pictures drawn")


def train(arguments):
    """Train on a scene and write a run folder."""
    preset, resume = read_preset(arguments.preset, arguments.changes), arguments.resume
    source = find_scene(arguments.scene)
    points = read_points_for(source, arguments.points) if arguments.points else None
    with writable_folder(arguments.output) as folder:
        if resume:
            load_checkpoint(folder)
        else:
            refuse_existing(folder / CHECKPOINT, HOW_TO_RESUME)
        scene = load(arguments, None if resume else preset, points)
        if not resume and "effects" not in read_scene_json(source):
            print_warning(
                f"no scene.json lists effects; `p4dgs-ref effects {source} --suggest --apply "
                f"--downscale {arguments.downscale}` finds and lists those that the pictures show"
            )
        trainer = Trainer(scene, preset, arguments.seed)
        fit_with_advice(trainer, folder, resume, None if arguments.quiet else sys.stderr)
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
    print_result(f"{arguments.output}: model.npz with {len(arrays)} arrays, and model.json")


def render(arguments):
    """Draw pictures of a file into a new folder; those of a fixed camera also as a GIF."""
    output, scene = Path(arguments.output), arguments.scene
    fixed = {name: value for name in FIXED if (value := getattr(arguments, name)) is not None}
    require_usage(
        not (scene and fixed), f"--{', --'.join(fixed)}", "cannot be combined with --scene"
    )
    require_usage(
        scene or arguments.downscale == 1, "--downscale", "expected only together with --scene"
    )
    _, model, _ = read_file(arguments.file)
    with staged_folder(output) as staging:
        require_usage(
            not any(output.glob("[!.]*")),
            output,
            "contains files; expected a new or empty folder, so that all pictures come from one "
            "run",
        )
        if scene:
            kind, views = "view", [(view.camera, view.time) for view in load(arguments).test]
        else:
            kind, views = "t", figures.film_views(model, **fixed)
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
    place = arguments.output
    with staged_folder(place, arguments.file) if place else nullcontext() as staging:
        scene = load(arguments)
        metrics, rows, images = p4.evaluate(model, scene)
        if staging:
            figures.write_comparison(staging, scene, rows, images)
    metrics = {
        "scene": scene.name,
        **metrics,
        **compression(model, data, metrics["gaussians"]),
        "decode_seconds": seconds,
    }
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
