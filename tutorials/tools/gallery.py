"""The pictures of tutorials/README.md, which come from commands and from the tutorials.

`python -m tutorials.tools.syllabus` draws them anew. Which code drew a picture is recorded in
gallery.json, so that a test notices pictures that are out of date.
"""

import hashlib
import inspect
import json
from collections import namedtuple
from pathlib import Path

import imageio.v3 as iio
from p4dgs_ref.designs import decode

from p4dgs_ref import output
from p4dgs_ref.lab import effect_ledger, stability
from p4dgs_ref.lab.accuracy import answers, diagram, report, verdicts
from p4dgs_ref.lab.accuracy.knobs import KNOBS
from p4dgs_ref.lab.tables import curve, hundredfold
from p4dgs_ref.report import figures, jobs
from p4dgs_ref.scenes import load_scene
from p4dgs_ref.scenes.files import image_bytes
from tutorials.tools import animation, architecture, handout, records, show, tour
from tutorials.tools.shared import FOLDER, in_colors, palette, write_text

DRAWN = Path(__file__).with_name("gallery.json")  # {picture: hash of the code that drew it}


# What `p4dgs-ref accuracy` has measured; CONTRIBUTING.md says how it is renewed.
ACCURACY = FOLDER / "records" / "accuracy.csv"

# One picture of the gallery: what draws it ("demo" and "accuracy" are commands of p4dgs-ref), the
# file that this command or tutorial writes, and the caption; without one it is on other pages.
Picture = namedtuple("Picture", "drawn_by figure caption")

DRAWING, HANDOUT, TOUR = "architecture.png", "handout.pdf", "tour.pdf"
PICTURES = {
    "curve.png": Picture(
        "record",
        "curve.png",
        "PSNR against bytes: ours, and every other method over its own size, in two storages",
    ),
    "hundredfold.png": Picture(
        "record",
        "hundredfold.png",
        "Where the hundredfold comes from: from D3DGS's file to ours, one step at a time",
    ),
    "demo.png": Picture(
        "demo",
        "comparison.png",
        "The demo on test views that were not used for training: truth, decoded picture, error",
    ),
    "demo_size.png": Picture(
        "demo",
        "size.png",
        "The bytes of the demo's file by part, and those of the paper's design",
    ),
    "demo.gif": Picture(
        "demo",
        "animation.gif",
        "The demo's file over time, seen by a moving camera: truth, decoded picture, error",
    ),
    "whole_paper.png": Picture(
        "tutorial",
        "out/00_whole_paper.png",
        "The paper in one file: unseen views, the decoded pictures, their error, and the bytes",
    ),
    "deformed.png": Picture(
        "tutorial",
        "06_deformed.png",
        "Eq. (6): one canonical Gaussian is moved, stretched and rotated over time",
    ),
    "hash_grid.png": Picture(
        "tutorial",
        "09_hash_grid.png",
        "Eq. (9): a grid that stores only signs, and nodes that share table entries",
    ),
    "covariance.png": Picture(
        "tutorial",
        "13_covariance.png",
        "From a quaternion and three scales to an ellipsoid",
    ),
    "compositing.png": Picture(
        "tutorial",
        "15_compositing.png",
        "The backward of compositing: every pixel pulls on the splats that cover it",
    ),
    "file.png": Picture(
        "tutorial",
        "19_file_byte_by_byte.png",
        "A whole model, byte by byte",
    ),
    "intervals.gif": Picture(
        "tutorial",
        "20_intervals_to_rans.gif",
        "Entropy coding: every symbol narrows the interval",
    ),
    "desync.png": Picture(
        "tutorial",
        "21_desync.png",
        "An error of one unit in the last place makes the decoder reconstruct another model",
    ),
    "accuracy.png": Picture(
        "record",
        "accuracy.png",
        "What accuracy costs in time, in six answers",
    ),
    "accuracy_likelihood.png": Picture(
        "accuracy",
        "stability.png",
        "Three ways to compute Eq. (11), over distance and bin width; failures are red",
    ),
    "effects.png": Picture(
        "record",
        "effects.png",
        "What each effect of the scene `bouncing` costs and gains; those not listed are at zero",
    ),
    "rate_distortion.png": Picture(
        "tutorial",
        "27_rate_distortion.png",
        "Rate against distortion, in bytes of real files",
    ),
    "beyond_networks.png": Picture(
        "tutorial",
        "beyond_networks.png",
        "Beyond the paper: networks that pay for their bits, against the paper's design",
    ),
    "growing_detail.png": Picture(
        "tutorial",
        "growing_detail.png",
        "From where on prediction pays: one scene in finer and finer detail, both sides coded",
    ),
    "front_accuracy.png": Picture("record", "front_accuracy.png", None),
    "front_stability.png": Picture("accuracy", "front_stability.png", None),
    DRAWING: Picture("drawing", DRAWING, None),
}

DRAW = {  # what draws the pictures that come from no tutorial
    "curve.png": (curve.draw_curves, curve.draw_curve),
    "hundredfold.png": (hundredfold.draw_steps,),
    "demo.png": (figures.write_comparison,),
    "demo_size.png": (figures.write_size,),
    "demo.gif": (animation,),
    "accuracy.png": (answers, diagram.lines, diagram.place_labels),
    "front_accuracy.png": (answers, diagram.lines, diagram.place_labels),
    "accuracy_likelihood.png": (stability.maps, stability.draw_maps, stability.draw_map),
    "front_stability.png": (stability.maps, stability.draw_maps, stability.draw_front),
    "effects.png": (effect_ledger.summaries, effect_ledger.said, effect_ledger.draw_ledger),
    DRAWING: (architecture,),
    HANDOUT: (architecture, handout),
    TOUR: (show, tour),
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


def take(out, pictures):
    """Renew those pictures of the gallery whose figures are in the folder `out`; keep the others.

    Returns the names of those that were renewed.
    """
    figures = {name: Path(out) / picture.figure for name, picture in PICTURES.items()}
    renewed = [name for name, figure in figures.items() if figure.is_file()]
    with output.staged_folder(pictures) as staging:
        for name in renewed:
            (staging / name).write_bytes(in_few_bytes(figures[name]))
    return renewed


def code_hash(name):
    """A hash of the code, without prose and comments, that draws a picture.

    The code of a tutorial ends where the exercises begin, which draw nothing.
    """
    if name in DRAW:
        text = "".join(inspect.getsource(source) for source in DRAW[name])
    else:
        figure = Path(PICTURES[name].figure)
        same_name = FOLDER / f"{figure.stem}.py"
        (file,) = [same_name] if same_name.is_file() else FOLDER.glob(f"{figure.stem[:2]}_*.py")
        text = file.read_text(encoding="utf-8").split("# ## Exercises")[0]
    code = (line.rstrip() for line in text.splitlines() if line.strip() and line[0] != "#")
    return hashlib.sha256("\n".join(code).encode()).hexdigest()[:16]


def record(names):
    """Note in gallery.json that the code as it is drew these pictures."""
    drawn = json.loads(DRAWN.read_text(encoding="utf-8")) | {
        name: code_hash(name) for name in names
    }
    write_text(DRAWN, json.dumps(drawn, indent=1, sort_keys=True) + "\n")


def stale():
    """Names of the pictures that other code than today's has drawn."""
    drawn = json.loads(DRAWN.read_text(encoding="utf-8"))
    return [name for name in {**PICTURES, **DRAW} if drawn.get(name) != code_hash(name)]


def draw_demo(out):
    """Run the demo, and leave its pictures and the animation of its file in the folder `out`."""
    jobs.main_job(load_scene("bouncing"), folder=out)
    animation.write_animation(
        Path(out) / PICTURES["demo.gif"].figure,
        decode((Path(out) / "bouncing.p4dgs").read_bytes()),
    )


def draw_curve(out):
    """Draw the record of the curve, and where its factor comes from, into the folder `out`."""
    rows = records.rows("curve")
    curve.draw_curves(Path(out) / PICTURES["curve.png"].figure, rows)
    hundredfold.draw_steps(Path(out) / PICTURES["hundredfold.png"].figure, hundredfold.steps(rows))


def draw_effects(out):
    """Draw the record of effects into the folder `out`."""
    effect_ledger.draw_ledger(
        Path(out) / PICTURES["effects.png"].figure, effect_ledger.summaries(records.rows("effects"))
    )


def draw_tour(_):
    """Draw the paper in ten pictures, which have a folder of their own."""
    tour.draw_pictures()
    record([TOUR])


def with_table(text):
    """The text of reference.md with the table of the record of accuracy."""
    table = report.markdown_table(verdicts.findings(KNOBS, verdicts.read(ACCURACY)))
    before, mark, after = text.partition("<!-- accuracy -->\n")
    rest = after.partition("<!-- end -->")[2]
    return "\n".join([f"{before}{mark}{table[0]}", *table[1:], f"<!-- end -->{rest}"])


def draw_accuracy(out):
    """Draw the record of accuracy and the stability map, also small; renew the table."""
    rows = verdicts.read(ACCURACY)
    answers.draw_answers(Path(out) / PICTURES["accuracy.png"].figure, rows)
    answers.draw_front(Path(out) / PICTURES["front_accuracy.png"].figure, rows)
    stability.draw_map(Path(out) / PICTURES["accuracy_likelihood.png"].figure)
    stability.draw_front(Path(out) / PICTURES["front_stability.png"].figure)
    reference = FOLDER / "reference.md"
    write_text(reference, with_table(reference.read_text(encoding="utf-8")))
