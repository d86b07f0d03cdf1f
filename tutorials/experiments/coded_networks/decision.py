"""What coded networks buy: the paper's design and this one, on three scenes with three seeds.

    python -m tutorials.experiments.coded_networks.decision

makes the rows that the record lacks (two minutes each), prints the table and draws the picture.
"""

import sys

import p4dgs_ref

p4dgs_ref.prepare()  # before NumPy


from p4dgs_ref.lab.writer import aligned  # noqa: E402
from p4dgs_ref.report.figures import COLORS, save_figure, styled, subplots  # noqa: E402
from p4dgs_ref.scenes import load_scene  # noqa: E402

from ..tables.methods import CODED, PAPERS, task_of  # noqa: E402
from ..tables.rows import Parser, rows, run  # noqa: E402

SCENES, SEEDS, ITERATIONS = ("bouncing", "figure", "glossy"), range(3), 3800
USUAL, HALF = 5e-4, 2.5e-4  # lambda_rate, the price of a bit
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
    """What coded networks change, {(scene, price): {quantity: of each seed}}, against PAPERS."""
    papers = {(row["scene"], row["seed"]): row for row in found if row["method"] == PAPERS}
    result = {}
    for row in found:
        if row["method"] == CODED:
            other = papers[row["scene"], row["seed"]]
            each = result.setdefault((row["scene"], row["lambda_rate"]), {})
            each.setdefault("bytes", []).append(row["bytes"])
            each.setdefault("times", []).append(row["bytes"] / other["bytes"])
            each.setdefault("dB", []).append(row["psnr_db"] - other["psnr_db"])
            each.setdefault("psi_d", []).append(row["deformation_bytes"])
    return result


def table(found):
    """The lines of the table: the least and the greatest value of the seeds."""
    forms = {"bytes": ",", "times": ".3f", "dB": "+.2f", "psi_d": ","}
    lines = [("scene", "price of a bit", *forms)]
    for (scene, price), each in comparisons(found).items():
        ends = [
            f"{min(each[name]):{form}} to {max(each[name]):{form}}" for name, form in forms.items()
        ]
        lines.append((scene, f"{price:g}", *ends))
    return aligned(lines)


@styled()
def draw(found, path):
    """PSNR over the bytes of the file: a point is a seed, lines join the designs of a seed."""
    figure, axes = subplots(1, len(SCENES), figsize=(11, 3.6), sharey=True)
    for scene, ax in zip(SCENES, axes):
        for seed in SEEDS:
            own = [row for row in found if (row["scene"], row["seed"]) == (scene, seed)]
            points = sorted((row["bytes"] / 1000, row["psnr_db"]) for row in own)
            ax.plot(*zip(*points), "o-", color=COLORS[seed])
        ax.set(title=scene, xlabel="size of the file, kB", xlim=(0, 42))
    axes[0].set_ylabel("PSNR of test views, dB")
    axes[0].annotate("networks coded, two prices", (10, axes[0].get_ylim()[0]))
    save_figure(figure, path)


def main(words):
    """Make what is missing, print and draw."""
    parser = Parser(prog="decision", description=__doc__.partition("\n")[0])
    parser.of_rows("report/coded_networks")
    options = parser.parse_args(words)
    found = rows(plan(), "beyond_networks", options.folder, options.part, options.jobs)
    if options.part == (1, 1):
        print(*table(found), sep="\n")
        draw(found, options.folder / "coded_networks.png")


if __name__ == "__main__":
    sys.exit(run(main, sys.argv[1:]))
