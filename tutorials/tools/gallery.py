"""The pictures of tutorials/README.md, which come from tutorials, from the demo's file and records.

`python -m tutorials.tools.syllabus` draws them anew.
"""

from collections import namedtuple

import imageio.v3 as iio

from p4dgs_ref import output
from p4dgs_ref.codec.file import decode
from p4dgs_ref.lab import effect_ledger, stability
from p4dgs_ref.lab.accuracy import answers, verdicts
from p4dgs_ref.lab.writer import read_csv
from p4dgs_ref.report import figures
from p4dgs_ref.report.evaluate import compression, evaluate
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.files import image_bytes
from tutorials.tools import animation, architecture
from tutorials.tools.shared import FOLDER, in_colors, palette

RECORDS = FOLDER / "records"
ARCHITECTURE = "architecture.png"

# One picture: the file that a tutorial or a function below writes into a folder, and the caption;
# without one it is on other pages.
Picture = namedtuple("Picture", "figure caption", defaults=(None,))

PICTURES = {
    "demo.png": Picture(
        "comparison.png",
        "The demo on test views that were not used for training: truth, decoded picture, error",
    ),
    "demo_size.png": Picture("size.png", "The bytes of the demo's file by part"),
    "demo.gif": Picture(
        "animation.gif",
        "The demo's file over time, seen by a moving camera: truth, decoded picture, error",
    ),
    "whole_paper.png": Picture(
        "out/00_whole_paper.png",
        "The paper in one file: unseen views, the decoded pictures, their error, and the bytes",
    ),
    "deformed.png": Picture(
        "06_deformed.png",
        "Eq. (6): one canonical Gaussian is moved, stretched and rotated over time",
    ),
    "hash_grid.png": Picture(
        "09_hash_grid.png",
        "Eq. (9): a grid that stores only signs, and nodes that share table entries",
    ),
    "covariance.png": Picture(
        "13_covariance.png", "From a quaternion and three scales to an ellipsoid"
    ),
    "compositing.png": Picture(
        "15_compositing.png",
        "The backward of compositing: every pixel pulls on the splats that cover it",
    ),
    "file.png": Picture("19_file_byte_by_byte.png", "A whole model, byte by byte"),
    "intervals.gif": Picture(
        "20_intervals_to_rans.gif", "Entropy coding: every symbol narrows the interval"
    ),
    "desync.png": Picture(
        "21_desync.png",
        "An error of one unit in the last place makes the decoder reconstruct another model",
    ),
    "rate_distortion.png": Picture(
        "27_rate_distortion.png", "Rate against distortion, in bytes of real files"
    ),
    "accuracy.png": Picture("accuracy.png", "What accuracy costs in time"),
    "accuracy_likelihood.png": Picture(
        "stability.png",
        "Three ways to compute Eq. (11), over distance and bin width; failures are red",
    ),
    "effects.png": Picture(
        "effects.png",
        "What each effect of the scene `bouncing` costs and gains; those not listed are at zero",
    ),
    "front_accuracy.png": Picture("front_accuracy.png"),
    "front_stability.png": Picture("front_stability.png"),
    ARCHITECTURE: Picture(ARCHITECTURE),
}


def gallery():
    """The pictures as Markdown."""
    return "\n\n".join(
        f"![{picture.caption}](pictures/{name})\n{picture.caption}."
        for name, picture in PICTURES.items()
        if picture.caption
    )


def in_few_bytes(figure):
    """The bytes of a picture's file; a PNG gets 256 colours, with which it is a third as large."""
    if figure.suffix != ".png":
        return figure.read_bytes()
    image = iio.imread(figure)[..., :3]
    return image_bytes(in_colors(image, palette(image)), ".png", bits=8, optimize=True)


def take(out):
    """Renew those pictures of the gallery whose figures are in the folder `out`."""
    with output.filled(FOLDER / "pictures") as staging:
        for name, picture in PICTURES.items():
            if (out / picture.figure).is_file():
                (staging / name).write_bytes(in_few_bytes(out / picture.figure))


def draw_demo(out):
    """Draw what the demo draws of its file, and the animation, into the folder `out`."""
    data, scene = (FOLDER / "demo.p4dgs").read_bytes(), load_scene("bouncing")
    model = decode(data)
    measures, rows, images = evaluate(model, scene)
    figures.write_comparison(out, scene, rows, images)
    figures.write_size(out, "tiny", compression(model, data, measures["gaussians"]))
    animation.write_animation(out / PICTURES["demo.gif"].figure, model)


def draw_architecture(out):
    """Draw the method into the folder `out`."""
    architecture.save(out / ARCHITECTURE)


def draw_records(out):
    """Draw the records of accuracy and of effects and the stability maps into the folder `out`."""
    rows = verdicts.read(RECORDS / "accuracy.csv")
    answers.draw_answers(out / "accuracy.png", rows)
    answers.draw_front(out / "front_accuracy.png", rows)
    stability.draw_map(out / "stability.png")
    stability.draw_front(out / "front_stability.png")
    effects = effect_ledger.summaries(read_csv(RECORDS / "effects.csv"))
    effect_ledger.draw_ledger(out / "effects.png", effects)
