"""The commands of the main job: fit, compress, decode, render, measure."""

import json
import time
import warnings
from contextlib import nullcontext
from pathlib import Path

from . import text
from .base import Line, UsageError, log, report_folder, require_known, say, show


def read_scene(arguments, split="train", purpose="train"):
    """The scene that the command line names, with views of the split for a purpose."""
    from ..scenes import load_scene

    scene = load_scene(arguments.scene, arguments.background, arguments.downscale)
    if not getattr(scene, split):
        raise UsageError(
            f"{scene.source}: split '{split}': no views; expected at least one to {purpose}"
        )
    return scene


def read_test_scene(arguments):
    """The scene, which must have views to measure on."""
    return read_scene(arguments, "test", "measure on")


def read_preset(arguments):
    """The preset with its --set changes, checked before any work begins."""
    from ..training.presets import choose

    for item in arguments.changes:
        if "=" not in item:
            raise UsageError(f"--set {item}: expected KEY=VALUE")
    changes = dict(item.split("=", 1) for item in arguments.changes)
    try:
        return choose(arguments.preset, changes)
    except ValueError as error:
        raise UsageError(str(error)) from None


def read_file(path):
    """The bytes of a file, its model, and the seconds that decoding took."""
    from ..codec import container
    from ..codec.file import decode as decode_model

    if Path(path).exists() and not Path(path).is_file():  # a pipe would block, a device never end
        raise UsageError(f"{path}: expected a regular file, found a directory, device or pipe")
    try:
        data = container.read_file(path)
        start = time.perf_counter()
        return data, decode_model(data), time.perf_counter() - start
    except container.BitstreamError as error:
        raise UsageError(f"{path}: {error}") from None


def estimate(scene, preset, arguments, trainings=1, points=None):
    """Time the first steps of long trainings; more than an hour needs --yes."""
    from ..training.trainer import Trainer

    points = scene.points if points is None else points
    anchors = preset.anchors if points is None else len(points)
    if anchors <= 1000 and preset.iterations <= 10_000:
        return
    trainer = Trainer(scene, preset, arguments.seed, points=points)
    steps, start = 0, time.perf_counter()
    while steps < min(3, preset.iterations) and time.perf_counter() - start < 60:
        trainer.step()
        steps += 1
    iterations = trainings * preset.iterations
    minutes = (time.perf_counter() - start) / steps * iterations / 60
    say(
        f"preset {preset.name}: about {minutes:.0f} minutes for {iterations} iterations, "
        f"judging by the first {steps} (later stages cost more)"
    )
    if minutes > 60 and not arguments.yes:
        raise UsageError("this would take more than an hour; add --yes to start it all the same")


def demo(arguments):
    """Run the main job and write its report."""
    from ..report.evaluate import json_safe
    from ..report.main_job import main_job

    preset, scene = read_preset(arguments), read_test_scene(arguments)
    estimate(scene, preset, arguments, 2 if preset.coded and arguments.jobs == 1 else 1)
    metrics = main_job(
        scene,
        preset,
        arguments.seed,
        arguments.output,
        arguments.start,
        log(arguments),
        arguments.jobs,
    )
    show(arguments, json_safe(metrics), text.metrics(metrics, arguments.output))


def simulate(arguments):
    """Draw the pictures of a scene.json."""
    from ..scenes.simulator import simulate as draw

    folder, start = arguments.output, time.perf_counter()
    with Line(arguments) as line:
        draw(arguments.scene, folder, lambda done, total: line(f"{done}/{total} pictures"))
    seconds = time.perf_counter() - start
    show(
        arguments,
        {"output": str(Path(folder)), "seconds": seconds},
        f"{folder}: drawn in {seconds:.1f} s",
    )


def train(arguments):
    """Fit a scene into a run folder."""
    from ..report.figures import write_training
    from ..scenes.load import read_description, read_points_for
    from ..scenes.output import made
    from ..training.checkpoint import CHECKPOINT
    from ..training.fit import fit

    preset, scene = read_preset(arguments), read_scene(arguments)
    checkpoint = Path(arguments.output) / CHECKPOINT
    if checkpoint.exists() and not arguments.resume:
        raise UsageError(f"{checkpoint}: exists; --resume goes on from it, another -o starts anew")
    if arguments.resume and arguments.points:
        raise UsageError("--points: not allowed with --resume; the checkpoint holds the anchors")
    points = read_points_for(scene, arguments.points) if arguments.points else None
    if not arguments.resume:
        estimate(scene, preset, arguments, points=points)
    start = time.perf_counter()
    with made(arguments.output) as folder:
        if not arguments.resume and "effects" not in read_description(scene.source):
            warnings.warn(
                f"{scene.source}: no scene.json lists effects, so all are trained; "
                f"`p4dgs-ref effects {arguments.scene} --suggest --apply` finds and lists them"
            )
        trainer = fit(
            scene,
            preset,
            arguments.seed,
            points=points,
            folder=folder,
            resume=arguments.resume,
            stream=log(arguments),
            save_every=arguments.save_every,
        )
        run = {
            "scene": scene.name,
            "preset": preset.name,
            "seed": arguments.seed,
            "iterations": trainer.iteration,
            "anchors": len(trainer.mask),
            "seconds": time.perf_counter() - start,
            "output": str(folder),
        }
        with report_folder(folder) as beside:
            write_training(beside, trainer.history, preset.stage_ends)
            (beside / "run.json").write_text(json.dumps(run, indent=1) + "\n")
    show(arguments, run, text.training(run))


def encode(arguments):
    """Compress a run to a file."""
    from ..codec.file import encode as encode_model
    from ..codec.quantise import underflows
    from ..scenes.output import new_file, write_atomically
    from ..training.fit import load_model

    with new_file(arguments.output) as output:
        model, values = load_model(arguments.run)
        start = time.perf_counter()
        data = encode_model(model)
        seconds = time.perf_counter() - start
        write_atomically(output, lambda file: file.write(data))
    done = {
        "output": str(output),
        "bytes": len(data),
        "iteration": values["iteration"],
        "seconds": seconds,
        "weights_rounded_to_zero": underflows(model.networks),  # too small for float16 (Q18)
    }
    show(arguments, done, text.encoding(done))


def decode(arguments):
    """Write the arrays of a file as model.npz and its design as model.json."""
    import numpy as np

    _, model, seconds = read_file(arguments.file)
    arrays = {
        **model.anchors._asdict(),
        "lo": model.box[0],
        "hi": model.box[1],
        "background": model.background,
        **{f"grid.{i}": grid for i, grid in enumerate(model.grids)},
    }
    for name, (weights, biases) in model.networks.items():
        arrays.update({f"{name}.W{i}": W for i, W in enumerate(weights)})
        arrays.update({f"{name}.b{i}": b for i, b in enumerate(biases)})
    with report_folder(arguments.output) as beside:
        np.savez(beside / "model.npz", **arrays)
        (beside / "model.json").write_text(json.dumps(model.design._asdict(), indent=1) + "\n")
    show(
        arguments,
        {
            "output": arguments.output,
            "anchors": len(model.anchors.mask),
            "arrays": len(arrays),
            "seconds": seconds,
        },
        f"{arguments.output}: model.npz with {len(arrays)} arrays, model.json; {seconds:.3f} s",
    )


def checked(arguments):
    """With --check-finite, a context that names the first equation that makes a NaN or infinity."""
    from ..training.finite import watched

    return watched() if arguments.check_finite else nullcontext()


CAMERA = {
    "frames": 24,
    "azimuth": 40.0,
    "elevation": 30.0,
    "distance": 3.6,
    "fov": 41.0,
    "size": 128,
}


def held_camera(arguments, model):
    """The camera that looks at the middle of the box as --azimuth and the other options say."""
    import numpy as np

    from ..splatting.camera import look_at

    azimuth, elevation, distance, fov, size = (
        CAMERA[name] if getattr(arguments, name, None) is None else getattr(arguments, name)
        for name in ("azimuth", "elevation", "distance", "fov", "size")
    )
    azimuth, elevation = np.radians([azimuth, elevation])
    middle = (model.box[0].astype(float) + model.box[1]) / 2
    outward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    focal = size / 2 / np.tan(np.radians(fov) / 2)
    return look_at(middle + distance * outward, middle, focal, focal, size, size)


def views_to_render(arguments, model):
    """The (name, camera, time) of every picture: views of a scene, or times of a held camera."""
    import numpy as np

    if not arguments.scene:
        camera = held_camera(arguments, model)
        times = np.linspace(0, 1, arguments.frames or CAMERA["frames"])
        return [(f"t_{i:03d}", camera, t) for i, t in enumerate(times)]
    views = scene_views(arguments, "--scene, which has its own cameras")
    return [(view.name.replace("/", "_"), view.camera, view.time) for view in views]


def scene_views(arguments, instead):
    """The views of --split of --scene; options that place a camera are refused beside them."""
    for name in CAMERA:
        if getattr(arguments, name, None) is not None:
            raise UsageError(f"--{name}: not allowed with {instead}")
    return getattr(read_scene(arguments, arguments.split, "render"), arguments.split)


def render(arguments):
    """Draw pictures of a file."""
    import imageio.v3 as iio
    import numpy as np

    from ..report.figures import write_gif
    from ..splatting.settings import SETTINGS

    require_known("--settings", [arguments.settings], SETTINGS)
    _, model, _ = read_file(arguments.file)
    views, images, seconds = views_to_render(arguments, model), [], []
    with report_folder(arguments.output) as beside:
        for name, camera, t in views:
            start = time.perf_counter()
            with checked(arguments):
                images.append(np.clip(model.render(camera, t, SETTINGS[arguments.settings]), 0, 1))
            seconds.append(time.perf_counter() - start)
            iio.imwrite(beside / f"{name}.png", (images[-1] * 255).round().astype(np.uint8))
        if not arguments.scene and len(images) > 1:
            write_gif(beside / "motion.gif", images)
    ms = 1e3 * float(np.median(seconds))
    show(
        arguments,
        {"output": arguments.output, "images": len(images), "ms_per_image": ms},
        f"{arguments.output}: {len(images)} images, {ms:.1f} ms each",
    )


def frozen_camera(arguments, model):
    """The camera whose view is exported, and its name for the header."""
    if arguments.camera is None and not arguments.scene:
        return held_camera(arguments, model), "a held camera"
    # `demo` names a file after its scene
    arguments.scene = arguments.scene or Path(arguments.file).stem
    views, i = scene_views(arguments, "--camera or --scene"), arguments.camera or 0
    if i >= len(views):
        raise UsageError(f"--camera {i}: expected one of the views 0 ... {len(views) - 1}")
    return views[i].camera, f"view {views[i].name} of {arguments.scene}"


def header_of(model, camera, name):
    """The comments of a PLY file that say what was frozen, besides the time."""
    effects = model.design.effects
    frozen = {"view_color": "colours", "view_geometry": "opacities, scales and rotations"}
    seen = [words for effect, words in frozen.items() if effect in effects] or ["no attributes"]
    x, y, z = camera.center
    comments = [
        f"frozen view: {name}, camera at {x:.4g} {y:.4g} {z:.4g}",
        f"of this view alone: {' and '.join(seen)}",
        "background of the model: {:.3g} {:.3g} {:.3g}".format(*model.background),
    ]
    if "occlusion" not in effects:
        comments.append("the model adds up all light, a viewer hides what is behind")
    return comments


def export_ply(arguments):
    """Write the Gaussians of one time, or of several, as one camera sees them."""
    import numpy as np

    from ..codec.splats import write_gaussians
    from ..scenes.output import new_file

    _, model, _ = read_file(arguments.file)
    camera, name = frozen_camera(arguments, model)
    header, file = header_of(model, camera, name), Path(arguments.file)
    title, counts = f"{file.stem}, a P-4DGS model, frozen at time", []

    def write(path, t):
        gaussians = model.gaussians(t, camera)
        write_gaussians(path, gaussians, [f"{title} {t:.6g}", *header])
        counts.append(len(gaussians.alpha))

    if arguments.all_times:
        output = arguments.output or file.with_name(f"{file.stem}_ply")
        with report_folder(output) as beside:
            for i, t in enumerate(np.linspace(arguments.time, 1, arguments.all_times)):
                write(beside / f"t_{i:03d}.ply", t)
    else:
        output = arguments.output or file.with_suffix(".ply")
        with new_file(output) as path:
            write(path, arguments.time)
    show(
        arguments,
        {"output": str(output), "files": len(counts), "gaussians": max(counts)},
        f"{output}: {max(counts)} Gaussians, frozen for {name}"
        + (f", {len(counts)} files" if arguments.all_times else ""),
    )


def evaluate(arguments):
    """Score a file on the test views of a scene."""
    from ..codec.file import encode as encode_model
    from ..codec.quantise import EncodeError
    from ..report import evaluate as study
    from ..report.figures import write_comparison

    data, model, seconds = read_file(arguments.file)
    scene = read_test_scene(arguments)
    with checked(arguments):
        metrics, rows, images = study.evaluate(model, scene)
    try:
        encoding = study.timed(encode_model, model)[1]
    except (OverflowError, EncodeError):  # a file can hold numbers that our encoder refuses
        encoding = None
    metrics = {
        "scene": scene.name,
        **metrics,
        **study.compression(model, data, metrics["gaussians"]),
        "encode_seconds": encoding,
        "decode_seconds": seconds,
    }
    with report_folder(arguments.output) as beside:
        if beside:
            write_comparison(beside, scene, rows, images)
    show(
        arguments,
        {**study.json_safe(metrics), "views": [study.json_safe(row) for row in rows]},
        text.evaluation(metrics, rows),
    )


def inspect(arguments):
    """List the sections of a file."""
    from ..report.figures import draw_ledger, write_csv
    from ..report.inspect import GAPS, ledger

    if arguments.heat and not arguments.output:
        raise UsageError("--heat: expected -o FOLDER, where the picture is written")
    data, _, _ = read_file(arguments.file)
    rows = ledger(data)
    with report_folder(arguments.output) as beside:
        if beside:
            write_csv(beside / "size.csv", rows)
            draw_ledger(beside / "size.png", rows)
        if arguments.heat:
            write_heat(arguments, data, beside)
    show(arguments, {"bytes": len(data), "sections": rows, "gaps": GAPS}, text.ledger(rows, GAPS))


def write_heat(arguments, data, folder):
    """Write heat.png, the scene in colours that show the bits of its anchors, and heat.csv."""
    from ..report.figures import HEAT, draw_heat, heat_image, write_csv
    from ..report.inspect import anchor_bits

    model, bits = anchor_bits(data)
    limits = bits.min(), bits.max()
    image = heat_image(model, bits, held_camera(arguments, model), arguments.time, limits, HEAT)
    rows = [[a, *x, b] for a, (x, b) in enumerate(zip(model.anchors.x_a, bits))]
    write_csv(folder / "heat.csv", rows, ("anchor", "x", "y", "z", "bits"))
    draw_heat(folder / "heat.png", image, bits, limits)


def equations(arguments):
    """Print the table of equations, also the baselines' and those beyond the paper."""
    from .. import table
    from ..lab.baselines.table import ALL_EQUATIONS

    rows = {"equations": table.rows(ALL_EQUATIONS)}
    show(arguments, rows, table.table(ALL_EQUATIONS))


def presets(arguments):
    """Print the presets beside the paper's values."""
    from ..training.presets import PAPER_REAL, PAPER_SYNTHETIC, PRESETS, SOURCES, differences

    names = [arguments.preset] if arguments.preset else list(PRESETS)
    require_known("preset", names, PRESETS)
    value = {
        name: {
            "fields": PRESETS[name]._asdict(),
            "differs": [
                dict(zip(("field", "paper", "here"), row)) for row in differences(PRESETS[name])
            ],
            "sources_of_paper_presets": SOURCES,
        }
        for name in names
    }
    chosen, paper = [PRESETS[name] for name in names], (PAPER_SYNTHETIC, PAPER_REAL)
    every_field = bool(arguments.preset)
    show(arguments, value, text.presets(chosen, paper, differences, SOURCES, every_field))


def bench(arguments):
    """Time the renderer, a training step and the coder."""
    from ..lab import bench as study

    result = study.bench(arguments.quick)
    show(arguments, result, study.describe(result))
