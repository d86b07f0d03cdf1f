"""The commands of the main job, and those about its files."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import p4dgs_ref as p4

from ..codec import container
from ..output import new_file, refuse_existing, staged_folder, writable_folder, write_atomically
from ..report import figures, splats
from ..report import inspect as sizes
from ..report import view as pages
from ..report.evaluate import compression, json_safe, timed
from ..scenes.files import write_image
from ..scenes.load import find_scene, read_points_for, read_scene_json
from ..training import advice
from ..training.fit import CHECKPOINT, HOW_TO_RESUME, fit, load_model
from ..training.presets import choose
from ..training.trainer import Trainer
from . import UsageError, caution, progress, require, say, show, tell, text

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".apng", ".mp4")  # no names of folders
HELD = ("azimuth", "elevation", "distance", "size", "frames")  # options about a held camera


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


def estimate(arguments, trainers, jobs=1):
    """Time the first steps of long trainings; more than an hour needs --yes, if there is one.

    `trainers` holds pairs of a Trainer and the number of trainings like it, of which `jobs` run at
    once.
    """
    iterations = sum(count * trainer.preset.iterations for trainer, count in trainers)
    if iterations <= 10_000 and all(trainer.primitives <= 2000 for trainer, _ in trainers):
        return
    minutes = sum(count * seconds_of(trainer) for trainer, count in trainers) / 60 / jobs
    say(
        f"about {minutes:.0f} minutes for {iterations:.0f} iterations, judging by the first of "
        "every training (later stages cost more)"
    )
    require(
        minutes <= 60 or getattr(arguments, "yes", True),
        "--yes",
        "this would take more than an hour; expected --yes to start it all the same",
    )


def seconds_of(trainer):
    """About how long a training takes, judging by its first iterations, which are done.

    The median of three leaves out what only the first one does.
    """
    iterations = trainer.preset.iterations
    return np.median([timed(trainer.step)[1] for _ in range(min(3, iterations))]) * iterations


def demo(arguments):
    """Run the main job and write its report."""
    preset = read_preset(arguments.preset, arguments.changes)
    scene = p4.load_scene(arguments.scene)
    estimate(arguments, [(Trainer(scene, preset), 1)])
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
    _, seconds = timed(
        p4.simulate,
        arguments.scene,
        arguments.output,
        lambda i, n: progress(f"{i}/{n} pictures"),
    )
    tell(f"{arguments.output}: drawn in {seconds:.1f} s")


def train(arguments):
    """Fit a scene into a run folder."""
    preset, resume = read_preset(arguments.preset, arguments.changes), arguments.resume
    scene = p4.load_scene(arguments.scene, downscale=arguments.downscale)
    if arguments.points:
        scene = replace(scene, points=read_points_for(scene, arguments.points))
    if not resume:
        refuse_existing(Path(arguments.output) / CHECKPOINT, HOW_TO_RESUME)
        estimate(arguments, [(Trainer(scene, preset), 1)])
    if not resume and "effects" not in read_scene_json(find_scene(arguments.scene)):
        caution(
            "no scene.json lists effects, so all are trained; "
            f"`p4dgs-ref effects {arguments.scene} --suggest --apply` finds and lists them"
        )
    for sentence in advice.before(scene, preset, arguments.seed):
        caution(sentence)
    with writable_folder(arguments.output) as folder:
        trainer, seconds = timed(
            fit,
            scene,
            preset,
            arguments.seed,
            folder=folder,
            resume=resume,
            stream=None if arguments.quiet else sys.stderr,
        )
        with staged_folder(folder) as staging:
            figures.write_training(staging, trainer.history, preset.stage_ends)
    caution(advice.after(trainer))
    tell(f"{folder}: {trainer.iteration} iterations, {len(trainer.mask)} anchors, {seconds:.1f} s")


def encode(arguments):
    """Compress a run to a file."""
    checkpoint = Path(arguments.run) / CHECKPOINT
    with new_file(arguments.output, checkpoint, start=container.MAGIC) as output:
        model, values = load_model(arguments.run)
        data, seconds = timed(p4.encode, model)
        write_atomically(output, lambda file: file.write(data))
    tell(f"{output}: {len(data):,} bytes, from iteration {values['iteration']}, {seconds:.3f} s")


def decode(arguments):
    """Write the arrays of a file as model.npz and its design as model.json."""
    _, model, seconds = read_file(arguments.file)
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
    tell(f"{arguments.output}: model.npz with {len(arrays)} arrays, model.json; {seconds:.3f} s")


def views_of(scene):
    """Names, cameras and times of a scene's test views; no two of the names are equal."""
    names = [view.name.replace("/", "_") for view in scene.test]
    if len(set(names)) < len(names):
        names = [f"{i:03d}_{name}" for i, name in enumerate(names)]
    return [(name, view.camera, view.time) for name, view in zip(names, scene.test)]


def render(arguments):
    """Draw pictures of a file, into a folder that has none, or as one GIF."""
    output, known = Path(arguments.output), p4.SETTINGS
    values = {name: getattr(arguments, name) for name in HELD}
    given = {name: value for name, value in values.items() if value is not None}
    require(
        arguments.settings in known,
        f"--settings {arguments.settings}",
        f"expected one of {', '.join(known)}",
    )
    require(
        not (arguments.scene and given),
        " ".join(f"--{name}" for name in given),
        "expected without --scene, whose cameras and times are drawn",
    )
    suffix = output.suffix.lower()
    require(suffix not in PICTURES, output, "expected a folder, or a name that ends in .gif")
    is_gif = suffix == ".gif"
    require(
        is_gif or not any(output.glob("[!.]*")),
        output,
        "has files already; expected a new or an empty folder, so that all pictures are of one run",
    )
    (_, model, _), reads = read_file(arguments.file), [arguments.file]
    if arguments.scene:
        scene = p4.load_scene(arguments.scene)
        views = views_of(scene)
        reads += scene.source.rglob("*") if is_gif else ()  # a folder of pictures is new anyway
    else:
        times = np.linspace(0, 1, given.pop("frames", 24))
        camera = figures.held_camera(model, **given)
        views = [(f"t_{i:03d}", camera, t) for i, t in enumerate(times)]
    with new_file(output, *reads, start=b"GIF8") if is_gif else staged_folder(output) as place:
        images = [
            np.clip(model.render(camera, t, known[arguments.settings]), 0, 1)
            for _, camera, t in views
        ]
        if is_gif:
            write_atomically(place, lambda file: file.write(figures.gif_of(images)))
        else:
            for (name, *_), image in zip(views, images):
                write_image(place / f"{name}.png", (image * 255).round().astype(np.uint8))
            if not arguments.scene:
                (place / "motion.gif").write_bytes(figures.gif_of(images))
    tell(f"{output}: {len(images)} images")


def export_ply(arguments):
    """Write the Gaussians of one time as the held camera sees them."""
    file, (_, model, _) = Path(arguments.file), read_file(arguments.file)
    camera = figures.held_camera(model)
    gaussians = model.gaussians(arguments.time, camera)
    with new_file(arguments.output or file.with_suffix(".ply"), file, start=b"ply\n") as output:
        splats.write_gaussians(
            output,
            gaussians,
            comments=(
                f"{file.stem}, a P-4DGS model, frozen at time {arguments.time:.6g}",
                "colours as seen from {:.4g} {:.4g} {:.4g}".format(*camera.center),
                "background of the model: {:.3g} {:.3g} {:.3g}".format(*model.background),
                f"effects of the model: {' '.join(model.design.effects) or 'none'}",
            ),
        )
    tell(f"{output}: {len(gaussians.alpha)} Gaussians")


def view(arguments):
    """Write a page that shows files."""
    files = {name: read_file(name)[0] for name in arguments.files}
    output = arguments.output or Path(arguments.files[0]).with_suffix(".html")
    size = pages.view(files, output)
    tell(f"{output}: {size:,} bytes, with {', '.join(arguments.files)}; open it in a browser")


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
    tell(text.presets([read_preset(name) for name in ([one] if one else p4.PRESETS)], bool(one)))
