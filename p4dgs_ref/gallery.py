"""The gallery of tutorials/README.md: pictures of the main job and of the tutorials, made small; see `syllabus`."""

import tempfile
from pathlib import Path

import numpy as np

WIDTH = 640  # pixels of a figure
LARGEST = 1_500_000  # bytes of all pictures together
JOB = "main job: "  # marks what is drawn by `p4dgs-ref demo`, and the next by `p4dgs-ref accuracy`; all else by tutorials
STUDY = "accuracy: "

# Picture -> (where it comes from, what to see in it).
PICTURES = {
    "demo.png": (
        JOB + "comparison.png",
        "The demo: test views that were not trained on: truth, decoded, error",
    ),
    "bouncing.gif": (
        JOB + "motion.gif",
        "The demo's file, decoded and rendered over time from one camera",
    ),
    "deformed.png": (
        "06_deformed.png",
        "Eq. (6): one canonical Gaussian, thrown, stretched and turned",
    ),
    "hash_grid.png": (
        "09_hash_grid.png",
        "Eq. (9): a grid that knows only signs, and nodes that share entries",
    ),
    "covariance.png": ("13_covariance.png", "From a quaternion and three scales to an ellipsoid"),
    "compositing.png": (
        "15_compositing.png",
        "Compositing backward: every pixel pulls at the splats that cover it",
    ),
    "file.png": ("19_file_byte_by_byte.png", "A whole model, byte by byte"),
    "intervals.gif": (
        "20_intervals_to_rans.gif",
        "Entropy coding: every symbol narrows the interval",
    ),
    "desync.png": (
        "21_desync.png",
        "One unit in the last place, and the decoder reads another model",
    ),
    "accuracy_rendering.png": (
        STUDY + "rendering.png",
        "Rendering: error against time; what each cut, box and precision buys",
    ),
    "accuracy_likelihood.png": (
        STUDY + "likelihood_bits.png",
        "Eq. (11) in six ways, over distance and bin width; red fails",
    ),
    "rate_distortion.png": ("27_rate_distortion.png", "Rate against distortion, in real bytes"),
}


def gallery():
    """The pictures as Markdown."""
    return "\n\n".join(
        f"![{caption}](pictures/{name})\n{caption}." for name, (_, caption) in PICTURES.items()
    )


def take(out, pictures):
    """Make those pictures of the gallery whose figures are in the folder `out`; the others stay.

    Raises     ValueError where the gallery would become too large
    """
    from .scenes.output import filled

    with filled(pictures) as beside:
        for name, (source, _) in PICTURES.items():
            path = Path(out) / source.removeprefix(JOB).removeprefix(STUDY)
            if path.is_file() and name.endswith(".gif"):
                animation(path, beside / name)
            elif path.is_file() and source.startswith(JOB):
                (beside / name).write_bytes(path.read_bytes())
            elif path.is_file():
                picture(path, beside / name)
        sizes = {
            file.name: file.stat().st_size
            for place in (Path(pictures), beside)
            for file in place.iterdir()
            if file.is_file()
        }
        if sum(sizes.values()) > LARGEST:
            raise ValueError(
                f"{pictures}: expected at most {LARGEST:,} bytes of pictures, got {sum(sizes.values()):,}"
            )


def main_job(out):
    """Run the demo and leave its pictures in the folder `out`."""
    from .scenes import load_scene
    from .studies.main_job import main_job as run

    with tempfile.TemporaryDirectory() as report:
        run(load_scene("bouncing"), "tiny", 0, report)
        for source, _ in PICTURES.values():
            if source.startswith(JOB):
                name = source.removeprefix(JOB)
                (Path(out) / name).write_bytes((Path(report) / name).read_bytes())


def studies(out):
    """Run the two studies whose pictures are shown, and leave those in the folder `out`."""
    from .studies.accuracy import run

    run(["rendering", "likelihood"], out)


def picture(source, target):
    """A figure, WIDTH pixels wide."""
    import imageio.v3 as iio

    image = iio.imread(source)[..., :3].astype(float)
    height, width = image.shape[:2]
    if width > WIDTH:
        rows, columns = shares(height, round(height * WIDTH / width)), shares(width, WIDTH)
        image = np.einsum("ih,hwc,jw->ijc", rows, image, columns, optimize=True)
    iio.imwrite(
        target, image.round().clip(0, 255).astype(np.uint8), extension=".png", optimize=True
    )


def shares(n, m):
    """How much of each of n old pixels is in each of m new ones, rows summing to 1: (m, n)."""
    edges = np.linspace(0, n, m + 1)
    low, high = edges[:-1, None], edges[1:, None]
    overlap = np.minimum(high, np.arange(1, n + 1)) - np.maximum(low, np.arange(n))
    return np.clip(overlap, 0, None) * m / n


def animation(source, target):
    """A GIF whose pixels are repeated is taken to half its size; any other stays as it is."""
    import imageio.v3 as iio

    frames = iio.imread(source)
    half = frames[:, ::2, ::2]
    if (
        frames.shape[1] % 2
        or frames.shape[2] % 2
        or not np.array_equal(half.repeat(2, 1).repeat(2, 2), frames)
    ):
        Path(target).write_bytes(Path(source).read_bytes())
        return
    duration = iio.immeta(source).get("duration", 60)
    iio.imwrite(target, half, extension=".gif", duration=duration, loop=0)
