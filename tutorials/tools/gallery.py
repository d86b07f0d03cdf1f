"""The files in tutorials/pictures/, which come from tutorials, from the demo's file and records.

`python -m tutorials.tools.syllabus` draws them anew.
"""

import shutil

from p4dgs_ref import output
from p4dgs_ref.cli import parser
from p4dgs_ref.codec.file import decode
from p4dgs_ref.report import figures
from p4dgs_ref.report.evaluate import compression, evaluate
from p4dgs_ref.scenes import load_scene
from tutorials.tools import animation, architecture
from tutorials.tools.shared import FOLDER, in_few_bytes

RECORDS = FOLDER / "experiments" / "records"

PICTURES = {  # {picture: the file that a tutorial or a function below writes into a folder}
    "whole_paper.png": "out/00_whole_paper.png",
    "deformed.png": "06_deformed.png",
    "hash_grid.png": "09_hash_grid.png",
    "covariance.png": "13_covariance.png",
    "compositing.png": "15_compositing.png",
    "file.png": "20_file_byte_by_byte.png",
    "desync.png": "22_desync.png",
    "rate_distortion.png": "12_rate_distortion.png",
    "demo.png": "comparison.png",
    "demo_size.png": "size.png",
    "demo.gif": "animation.gif",
    "front_accuracy.png": "accuracy.png",
    "front_stability.png": "stability.png",
    "effects.png": "effects.png",
    "accuracy_likelihood.png": "24_hard_cases.png",
    "architecture.png": "architecture.png",
}


def take(out):
    """Renew those pictures of the gallery whose figures are in the folder `out`."""
    with output.staged_folder(FOLDER / "pictures") as staging:
        for name, figure in PICTURES.items():
            if (out / figure).is_file():
                data = (out / figure).read_bytes()
                if name.endswith(".png"):
                    data = in_few_bytes(data)
                (staging / name).write_bytes(data)


def draw_demo(out):
    """Draw what the demo draws of its file, and the animation, into the folder `out`."""
    data, scene = (FOLDER / "demo.p4dgs").read_bytes(), load_scene("bouncing")
    model = decode(data)
    measures, rows, images = evaluate(model, scene)
    figures.write_comparison(out, scene, rows, images)
    figures.write_size(out, "tiny", compression(model, data, measures["gaussians"]))
    animation.write_animation(out / "animation.gif", model)


def draw_architecture(out):
    """Draw the method into the folder `out`."""
    architecture.save(out / "architecture.png")


def draw_front(out):
    """Run the commands under the first page's pictures, which write them and their numbers."""
    for line in (f"accuracy {FOLDER / 'demo.p4dgs'}", "stability", "effects static"):
        if parser.run([*line.split(), "-o", str(out)], 0):
            raise SystemExit(f"p4dgs-ref {line} failed")
    shutil.copy(out / "accuracy.csv", RECORDS)
