"""The commands of the main job, and those about its files."""

import json
import sys
import warnings
from pathlib import Path

import imageio.v3 as iio
import numpy as np

import p4dgs_ref as p4

from ..codec import container, quantise, splats
from ..report import figures
from ..report import inspect as sizes
from ..report.evaluate import compression, json_safe, timed
from ..scenes.load import find_scene, read_description, read_points_for
from ..scenes.output import filled, made, new_file, write_atomically
from ..training.fit import CHECKPOINT, fit, load_model
from ..training.presets import SOURCES, choose, differences
from ..training.trainer import Trainer
from . import text
from .base import UsageError, expect, expect_known, progress, report_folder, say, show, tell


def read_scene(arguments, split="train", purpose="train"):
    """The scene that the command line names, with views of the split for a purpose."""
    scene = p4.load_scene(
        arguments.scene,
        getattr(arguments, "background", "white"),  # some commands need cameras alone
        getattr(arguments, "downscale", 1),
    )
    expect(
        getattr(scene, split),
        f"{scene.source}: split '{split}': no views; expected at least one to {purpose}",
    )
    return scene


def read_preset(arguments):
    """The preset with its --set changes, checked before any work begins."""
    for item in arguments.changes:
        expect("=" in item, f"--set {item}: expected KEY=VALUE")
    try:
        return choose(arguments.preset, dict(item.split("=", 1) for item in arguments.changes))
    except ValueError as error:
        raise UsageError(str(error)) from None


def read_file(path):
    """The bytes of a file, its model, and the seconds that decoding took."""
    expect(  # a pipe would block, a device never end
        Path(path).is_file() or not Path(path).exists(),
        f"{path}: expected a regular file, found a directory, device or pipe",
    )
    try:
        data = container.read_file(path)
        return data, *timed(p4.decode, data)
    except container.BitstreamError as error:
        raise UsageError(f"{path}: {error}") from None


def estimate(scene, preset, arguments, points, trainings=1):
    """Time the first steps of long trainings; more than an hour needs --yes."""
    anchors = preset.anchors if points is None else len(points)
    if anchors <= 1000 and preset.iterations <= 10_000:
        return
    trainer = Trainer(scene, preset, arguments.seed, points=points)
    steps, iterations = min(3, preset.iterations), trainings * preset.iterations
    _, seconds = timed(lambda: [trainer.step() for _ in range(steps)])
    minutes = seconds / steps * iterations / 60
    say(
        f"preset {preset.name}: about {minutes:.0f} minutes for {iterations} iterations, "
        f"judging by the first {steps} (later stages cost more)"
    )
    expect(
        minutes <= 60 or arguments.yes,
        "this would take more than an hour; add --yes to start it all the same",
    )


def demo(arguments):
    """Run the main job and write its report."""
    preset, scene = read_preset(arguments), read_scene(arguments, "test", "measure on")
    one_after_another = preset.coded and arguments.jobs == 1
    estimate(scene, preset, arguments, scene.points, 2 if one_after_another else 1)
    metrics = p4.main_job(
        scene,
        preset,
        arguments.seed,
        arguments.output,
        arguments.start,
        None if arguments.quiet else sys.stderr,
        arguments.jobs,
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
    preset, scene, resume = read_preset(arguments), read_scene(arguments), arguments.resume
    checkpoint, points = Path(arguments.output) / CHECKPOINT, scene.points
    expect(
        resume or not checkpoint.exists(),
        f"{checkpoint}: exists; --resume goes on from it, another -o starts anew",
    )
    if arguments.points:
        expect(not resume, "--points: not allowed with --resume; the checkpoint holds the anchors")
        points = read_points_for(scene, arguments.points)
    if not resume:
        estimate(scene, preset, arguments, points)
    with made(arguments.output) as folder:
        if not resume and "effects" not in read_description(find_scene(arguments.scene)):
            warnings.warn(
                f"{scene.source}: no scene.json lists effects, so all are trained; "
                f"`p4dgs-ref effects {arguments.scene} --suggest --apply` finds and lists them"
            )
        trainer, seconds = timed(
            fit,
            scene,
            preset,
            arguments.seed,
            points=points,
            folder=folder,
            resume=resume,
            stream=None if arguments.quiet else sys.stderr,
            save_every=arguments.save_every,
        )
        run = {
            "scene": scene.name,
            "preset": preset.name,
            "seed": arguments.seed,
            "iterations": trainer.iteration,
            "anchors": len(trainer.mask),
            "seconds": seconds,
            "output": str(folder),
        }
        with filled(folder) as beside:
            figures.write_training(beside, trainer.history, preset.stage_ends)
            (beside / "run.json").write_text(json.dumps(run, indent=1) + "\n")
    tell(f"{folder}: {run['iterations']} iterations, {run['anchors']} anchors, {seconds:.1f} s")


def encode(arguments):
    """Compress a run to a file."""
    with new_file(arguments.output) as output:
        model, values = load_model(arguments.run)
        data, seconds = timed(p4.encode, model)
        write_atomically(output, lambda file: file.write(data))
    lost = quantise.underflows(model.networks)  # too small for float16 (Q18)
    note = f"; {lost} network weights are too small for float16 and became 0" if lost else ""
    tell(
        f"{output}: {len(data):,} bytes, from iteration {values['iteration']}, "
        f"{seconds:.3f} s{note}"
    )


def decode(arguments):
    """Write the arrays of a file as model.npz and its design as model.json."""
    _, model, seconds = read_file(arguments.file)
    lo, hi = model.box
    arrays = {**model.anchors._asdict(), "lo": lo, "hi": hi, "background": model.background}
    arrays.update({f"grid.{i}": grid for i, grid in enumerate(model.grids)})
    for name, network in model.networks.items():
        for letter, layers in zip("Wb", network):
            arrays.update({f"{name}.{letter}{i}": array for i, array in enumerate(layers)})
    with filled(arguments.output) as beside:
        np.savez(beside / "model.npz", **arrays)
        (beside / "model.json").write_text(json.dumps(model.design._asdict(), indent=1) + "\n")
    tell(f"{arguments.output}: model.npz with {len(arrays)} arrays, model.json; {seconds:.3f} s")


CAMERA = {"azimuth": 40.0, "elevation": 30.0, "distance": 3.6, "size": 128}
FRAMES, FIELD_OF_VIEW = 24, 41.0  # pictures of a held camera; degrees


def held_camera(model, azimuth, elevation, distance, size):
    """The camera that looks at the middle of a model's box; angles in degrees."""
    azimuth, elevation = np.radians([azimuth, elevation])
    middle, level = (model.box[0].astype(float) + model.box[1]) / 2, np.cos(elevation)
    outward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    focal = size / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    return p4.look_at(middle + distance * outward, middle, focal, focal, size, size)


def views_to_render(arguments, model):
    """The (name, camera, time) of every picture: views of a scene, or times of a held camera."""
    asked = {name: getattr(arguments, name) for name in (*CAMERA, "frames")}
    given = {name: value for name, value in asked.items() if value is not None}
    if arguments.scene:
        expect(
            not given,
            f"--{', --'.join(given)}: not allowed with --scene, which has its own cameras",
        )
        views = read_scene(arguments, "test", "render").test
        return [(view.name.replace("/", "_"), view.camera, view.time) for view in views]
    times = np.linspace(0, 1, given.pop("frames", FRAMES))
    camera = held_camera(model, **{**CAMERA, **given})
    return [(f"t_{i:03d}", camera, t) for i, t in enumerate(times)]


def render(arguments):
    """Draw pictures of a file."""
    _, model, _ = read_file(arguments.file)
    views, images, seconds = views_to_render(arguments, model), [], []
    with filled(arguments.output) as beside:
        for name, camera, t in views:
            image, taken = timed(model.render, camera, t, p4.SETTINGS[arguments.settings])
            images.append(np.clip(image, 0, 1))
            seconds.append(taken)
            iio.imwrite(beside / f"{name}.png", (images[-1] * 255).round().astype(np.uint8))
        if not arguments.scene and len(images) > 1:
            figures.write_gif(beside / "motion.gif", images)
    tell(f"{arguments.output}: {len(images)} images, {1e3 * np.median(seconds):.1f} ms each")


def frozen_camera(arguments, model):
    """The camera whose view is exported, and its name for the header."""
    if arguments.camera is None and not arguments.scene:
        return held_camera(model, **CAMERA), "a held camera"
    # `demo` names a file after its scene
    arguments.scene = arguments.scene or Path(arguments.file).stem
    views, i = read_scene(arguments, "test", "render").test, arguments.camera or 0
    expect(i < len(views), f"--camera {i}: expected one of the views 0 ... {len(views) - 1}")
    return views[i].camera, f"view {views[i].name} of {arguments.scene}"


def header_of(model, camera, name):
    """The comments of a PLY file that say what was frozen, besides the time."""
    effects = model.design.effects
    frozen = {"view_color": "colours", "view_geometry": "opacities, scales and rotations"}
    seen = [words for effect, words in frozen.items() if effect in effects] or ["no attributes"]
    x, y, z = camera.center
    return [
        f"frozen view: {name}, camera at {x:.4g} {y:.4g} {z:.4g}",
        f"of this view alone: {' and '.join(seen)}",
        "background of the model: {:.3g} {:.3g} {:.3g}".format(*model.background),
        *(
            []
            if "occlusion" in effects
            else ["the model adds up all light, a viewer hides what is behind"]
        ),
    ]


def export_ply(arguments):
    """Write the Gaussians of one time as one camera sees them."""
    _, model, _ = read_file(arguments.file)
    camera, name = frozen_camera(arguments, model)
    file, t = Path(arguments.file), arguments.time
    title = f"{file.stem}, a P-4DGS model, frozen at time {t:.6g}"
    gaussians = model.gaussians(t, camera)
    with new_file(arguments.output or file.with_suffix(".ply")) as output:
        splats.write_gaussians(output, gaussians, [title, *header_of(model, camera, name)])
    tell(f"{output}: {len(gaussians.alpha)} Gaussians, frozen for {name}")


def evaluate(arguments):
    """Score a file on the test views of a scene."""
    data, model, seconds = read_file(arguments.file)
    scene = read_scene(arguments, "test", "measure on")
    metrics, rows, images = p4.evaluate(model, scene)
    try:
        encoding = timed(p4.encode, model)[1]
    except (OverflowError, quantise.EncodeError):  # a file may hold what our encoder refuses
        encoding = None
    metrics = {
        "scene": scene.name,
        **metrics,
        **compression(model, data, metrics["gaussians"]),
        "encode_seconds": encoding,
        "decode_seconds": seconds,
    }
    with report_folder(arguments.output) as beside:
        if beside:
            figures.write_comparison(beside, scene, rows, images)
    shown = {**json_safe(metrics), "views": [json_safe(row) for row in rows]}
    show(arguments, shown, text.evaluation(metrics, rows))


def inspect(arguments):
    """List the sections of a file."""
    expect(
        arguments.output or not arguments.heat,
        "--heat: expected -o FOLDER, where the picture is written",
    )
    data, _, _ = read_file(arguments.file)
    rows, gaps = sizes.ledger(data), sizes.GAPS
    with report_folder(arguments.output) as beside:
        if beside:
            figures.write_csv(beside / "size.csv", rows)
            figures.draw_ledger(beside / "size.png", rows)
        if arguments.heat:
            model, bits = sizes.anchor_bits(data)
            figures.write_heat(beside, model, bits, held_camera(model, **CAMERA))
    show(arguments, {"bytes": len(data), "sections": rows, "gaps": gaps}, text.ledger(rows, gaps))


def presets(arguments):
    """Print the presets beside the paper's values."""
    names = [arguments.preset] if arguments.preset else list(p4.PRESETS)
    expect_known("preset", names, p4.PRESETS)
    chosen = [p4.PRESETS[name] for name in names]
    value = {
        preset.name: {
            "fields": preset._asdict(),
            "differs": [
                {"field": field, "paper": paper, "here": here}
                for field, paper, here in differences(preset)
            ],
            "sources_of_paper_presets": SOURCES,
        }
        for preset in chosen
    }
    show(arguments, value, text.presets(chosen, bool(arguments.preset)))
