"""What the makers of pages share: where tutorials are, how one runs, how a file is written."""

import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from scipy.cluster.vq import kmeans2, vq

from p4dgs_ref.output import write_atomically
from p4dgs_ref.scenes.files import image_bytes

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tutorials"


def run(name, arguments, out):
    """Run Python without a display in `out`, where figures go. Exits with one line if it fails."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    environment = {
        **os.environ,
        "MPLBACKEND": "Agg",
        "OPENBLAS_NUM_THREADS": "1",
        "P4DGS_TUTORIALS_OUT": str(out),
        "PYTHONPATH": path,
        "PYTHONUTF8": "1",
    }
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=environment,
        cwd=out,
        capture_output=True,
        encoding="utf-8",
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        sys.exit(f"{name}, {lines[-1]}")


def write_text(path, text):
    """Write a text file in one step."""
    write_atomically(path, lambda file: file.write(text.encode()))


def in_few_colors(pixels):
    """The pixels [..., 3] in 8 bits, in at most 256 colours.

    The sixteen most frequent ones are among them; the others stand for rare colours, too, because a
    colour counts as the root of its pixels.
    """
    number = pixels.reshape(-1, 3) @ np.array((2**16, 2**8, 1))
    numbers, which, counts = np.unique(number, return_inverse=True, return_counts=True)
    colors = (numbers[:, None] >> (16, 8, 0) & 255).astype(float)
    frequent = colors[np.argsort(-counts, kind="stable")[:16]]
    sample = np.repeat(colors, np.sqrt(counts).astype(int), axis=0)
    sample = sample[:: 1 + len(sample) // 20_000]  # sorted, so that of similar ones some are left
    others = kmeans2(sample, min(240, len(colors)), minit="++", seed=0)[0]
    chosen = np.concatenate([frequent, np.rint(others)])
    return chosen[vq(colors, chosen)[0]].astype(np.uint8)[which].reshape(pixels.shape)


def in_few_bytes(png):
    """The bytes of a PNG in at most 256 colours, which are a half or a third as many."""
    return image_bytes(in_few_colors(iio.imread(png)[..., :3]), ".png", bits=8, optimize=True)


def markdown_table(heads, rows):
    """Return a table as Markdown."""
    lines = [f"| {' | '.join(row)} |" for row in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def at_stage_4(trainer, model):
    """Return the state of a trainer at the beginning of stage 4, with the anchors of a model.

    The networks that draw are also the model's. The trainer must have as many anchors as the model.
    """
    (arrays, values), anchors = trainer.state(), model.anchors
    log_s, log_l = (np.log(np.maximum(values, 1e-4)) for values in (anchors.s_a, anchors.l_a))
    new = {"x_a": anchors.x_a, "f_a": anchors.f_a, "O_a": anchors.O_a}
    new |= {"log_s": log_s, "log_l": log_l}
    for name in model.networks.keys() - {"psi_p", "psi_q"}:
        for kind, layers in zip("Wb", model.networks[name]):
            new |= {f"{name}.{kind}{i}": array for i, array in enumerate(layers)}
    arrays |= {f"p/{name}": array.astype(np.float32) for name, array in new.items()}
    arrays["mask"] = anchors.mask
    return arrays, {**values, "iteration": trainer.preset.stage_ends[2]}


def at_the_end(trainer, model, steps):
    """Put a trainer before its last iterations, with a whole model of as many anchors.

    Adam begins anew. A file has no more of the grid than its signs.
    """
    arrays, values = at_stage_4(trainer, model)
    for name in ("psi_p", "psi_q"):
        for kind, layers in zip("Wb", model.networks[name]):
            arrays |= {f"p/{name}.{kind}{i}": a.astype("f4") for i, a in enumerate(layers)}
    arrays |= {f"p/grid.{i}": 0.05 * grid.astype("f4") for i, grid in enumerate(model.grids)}
    trainer.restore(arrays, {**values, "iteration": trainer.preset.iterations - steps})
    return trainer


def file_of(equation):
    """The path in the checkout of the file that holds an equation of the table."""
    return f"{equation.forward.__module__.replace('.', '/')}.py"
