"""What coded networks buy: the paper's design and this one, on three scenes with three seeds.

    python -m tutorials.experiments.coded_networks.decision

makes the rows that the record lacks (two minutes each), prints the table and draws the picture.
"""

import sys

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy


import numpy as np  # noqa: E402

from p4dgs_ref.lab.writer import align, group_rows  # noqa: E402
from p4dgs_ref.report.figures import COLORS, figure_style, save_figure, subplots  # noqa: E402
from p4dgs_ref.scenes import load_scene  # noqa: E402
from tutorials.tools.shared import in_few_bytes  # noqa: E402

from ..tables.methods import CODED, PAPERS, task_of  # noqa: E402
from ..tables.rows import Parser, rows, run  # noqa: E402

SCENES, SEEDS, ITERATIONS = ("bouncing", "figure", "glossy"), range(3), 3800
HALF = 2.5e-4  # half of the usual lambda_rate, the price of a bit
DESIGNS = ((PAPERS, {}), (CODED, {}), (CODED, {"lambda_rate": HALF}))
COMMAND = "python -m tutorials.experiments.coded_networks.decision"


def plan():
    """The Tasks of all designs, scenes and seeds; one seed of all comes before the next."""
    return [
        task_of(scene, method, seed, ITERATIONS, COMMAND, changes)
        for method, changes in DESIGNS
        for seed in SEEDS
        for scene in map(load_scene, SCENES)
    ]


def comparisons(found):
    """The rows of coded networks, each with what they change against PAPERS of scene and seed."""
    papers = {(row["scene"], row["seed"]): row for row in found if row["method"] == PAPERS}
    for row in found:
        if row["method"] == CODED:
            other = papers[row["scene"], row["seed"]]
            times, gain = row["bytes"] / other["bytes"], row["psnr_db"] - other["psnr_db"]
            yield {**row, "times": times, "gain": gain}


def table(found):
    """The lines of the table: the mean over seeds with the least and the most."""
    forms = {"bytes": ",.0f", "times": ".3f", "gain": "+.2f", "deformation_bytes": ",.0f"}
    lines = [("price of a bit", "scene", "bytes", "of the paper's", "dB", "psi_d, bytes")]
    groups = group_rows(comparisons(found), "lambda_rate", "scene")
    for (price, scene), own in groups.items():
        lines.append([f"{price:g}", scene])
        for name, form in forms.items():
            each = [row[name] for row in own]
            values = (f"{value:{form}}" for value in (np.mean(each), min(each), max(each)))
            lines[-1].append("{} ({} to {})".format(*values))
    return align(lines)


@figure_style()
def draw(found, path):
    """PSNR over the bytes of the file on every scene; a line joins the files of a seed."""
    figure, axes = subplots(1, len(SCENES), figsize=(11, 3.8), sharey=True)
    for scene, ax in zip(SCENES, axes):
        for seed in SEEDS:
            own = [row for row in found if (row["scene"], row["seed"]) == (scene, seed)]
            points = sorted((row["bytes"] / 1000, row["psnr_db"]) for row in own)
            ax.plot(*zip(*points), "o-", color=COLORS[seed])
        ax.set(title=scene, xlabel="size of the file, kB", xlim=(0, 44))
    axes[0].set_ylabel("PSNR of test views, dB")
    _, high = axes[0].get_ylim()
    axes[0].text(14, high, "networks coded\n(two prices)", ha="center", va="top")
    axes[0].text(35, high, "the paper's\ndesign", ha="center", va="top")
    save_figure(figure, path)


def main(words):
    """Make what is missing, print and draw."""
    parser = Parser(prog="decision", description=__doc__.partition("\n")[0])
    parser.of_rows("report/coded_networks")
    options = parser.parse_args(words)
    found = rows(plan(), "beyond_networks", options.folder, options.jobs)
    print(*table(found), sep="\n")
    drawn = options.folder / "coded_networks.png"
    draw(found, drawn)
    drawn.write_bytes(in_few_bytes(drawn))


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
