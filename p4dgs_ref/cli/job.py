"""The commands of the main job, and those about its files."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import p4dgs_ref as p4

from ..codec import container
from ..limits import counted
from ..output import new_file, refuse_existing, staged_folder, writable_folder, write_atomically
from ..report import figures
from ..report import inspect as sizes
from ..report import view as pages
from ..report.evaluate import compression, json_safe, timed
from ..scenes.files import write_image
from ..scenes.load import read_points_for, read_scene_json
from ..training import advice
from ..training.fit import CHECKPOINT, HOW_TO_RESUME, fit, load_model
from ..training.presets import choose
from ..training.trainer import Trainer
from . import UsageError, ask, print_result, print_warning, progress, require, show, text


def read_preset(name, changes=()):
    """The preset with its --set changes, checked before any work begins."""
    try:
        return choose(name, dict(item.partition("=")[::2] for item in changes))
    except ValueError as error:
        raise UsageError(str(error)) from None


def read_file(path):
    """The bytes of a file, its model, and the seconds that decoding took."""
    require(
        Path(path).is_file() or not Path(path).exists(),
        path,
        "a folder, pipe or device; expected a .p4dgs file",
    )
    try:
        data = container.read_file(path)
        return data, *timed(p4.decode, data)
    except container.BitstreamError as error:
        raise UsageError(f"{path}: {error}") from None


def estimate(arguments, trainer):
    """Time the first step of a long training, and go on only if the user wants it."""
    iterations = trainer.preset.iterations
    if iterations <= 10_000 and trainer.primitives <= 2000:
        return
    ask(
        arguments,
        f"{iterations} iterations, later ones slower",
        iterations * timed(trainer.step)[1],
    )


def demo(arguments):
    """Run the main job and write its report."""
    preset = read_preset(arguments.preset, arguments.changes)
    scene = p4.load_scene(arguments.scene)
    estimate(arguments, Trainer(scene, preset))
    metrics = p4.main_job(
        scene,
        preset,
        arguments.seed,
        arguments.output,
        arguments.start,
        None if arguments.quiet else sys.stderr,
    )
    show(arguments, json_safe(metrics), text.metrics(metrics, arguments.output))


def simulate(arguments):
    """Draw the pictures of a scene.json."""
    p4.simulate(arguments.scene, arguments.output, lambda i, n: progress(f"{i}/{n} pictures"))
    print_result(f"{arguments.output}: drawn")


def train(arguments):
    """Fit a scene into a run folder."""
    preset, resume = read_preset(arguments.preset, arguments.changes), arguments.resume
    scene = p4.load_scene(arguments.scene, downscale=arguments.downscale)
    if arguments.points:
        scene = replace(scene, points=read_points_for(scene, arguments.points))
    if not resume:
        refuse_existing(Path(arguments.output) / CHECKPOINT, HOW_TO_RESUME)
        estimate(arguments, Trainer(scene, preset))
        if "effects" not in read_scene_json(scene.source):
            print_warning(
                "no scene.json lists effects, so all are trained; "
                f"`p4dgs-ref effects {arguments.scene} --suggest --apply` finds and lists them"
            )
    for sentence in advice.before(scene, preset, arguments.seed):
        print_warning(sentence)
    with writable_folder(arguments.output) as folder:
        trainer = fit(
            scene,
            preset,
            arguments.seed,
            folder=folder,
            resume=resume,
            stream=None if arguments.quiet else sys.stderr,
        )
        with staged_folder(folder) as staging:
            figures.write_training(staging, trainer.history, preset.stage_ends)
    print_warning(advice.after(trainer))
    print_result(
        f"{folder}: {trainer.iteration} iterations, {counted(len(trainer.mask), 'anchor')}"
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
    """Draw pictures of a file into a folder that has none; of a held camera also as a GIF."""
    output, settings = Path(arguments.output), p4.SETTINGS[arguments.settings]
    _, model, _ = read_file(arguments.file)
    if arguments.scene:
        views = [
            (f"view_{i:03d}", v.camera, v.time)
            for i, v in enumerate(p4.load_scene(arguments.scene).test)
        ]
    else:
        held = arguments.azimuth, arguments.elevation, arguments.distance, arguments.size
        camera, times = figures.held_camera(model, *held), np.linspace(0, 1, arguments.frames)
        views = [(f"t_{i:03d}", camera, t) for i, t in enumerate(times)]
    with staged_folder(output) as staging:
        require(
            not any(output.glob("[!.]*")),
            output,
            "has files already; expected a new or an empty folder, so that all pictures are of one "
            "run",
        )
        images = [np.clip(model.render(camera, t, settings), 0, 1) for _, camera, t in views]
        for (name, *_), image in zip(views, images):
            write_image(staging / f"{name}.png", (image * 255).round().astype(np.uint8))
        if not arguments.scene:
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
    """Score a file on the test views of a scene."""
    data, model, seconds = read_file(arguments.file)
    scene = p4.load_scene(arguments.scene)
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
    if arguments.output:
        with staged_folder(arguments.output, arguments.file) as staging:
            figures.write_csv(staging / "sections.csv", rows)
            figures.draw_ledger(staging / "sections.png", rows)
    show(arguments, {"bytes": len(data), "sections": rows, "gaps": gaps}, text.ledger(rows, gaps))


def presets(arguments):
    """Print the presets beside the paper's values."""
    one = arguments.preset
    print_result(
        text.presets([read_preset(name) for name in ([one] if one else p4.PRESETS)], bool(one))
    )
