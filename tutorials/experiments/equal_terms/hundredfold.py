"""Where the hundredfold comes from: one step at a time from D3DGS's file to ours, at one PSNR.

The last two steps are ours. Single children come last: they switch off the paper's first idea, the
prediction of several neighbours, so that they must not be counted as coding.

The bytes at that PSNR are those of a method's curve, interpolated between its best points as in
`curve`. Network and Gaussians are told apart by their shares at the two neighbouring points.
"""

import numpy as np

from p4dgs_ref.report.figures import BLUE, ORANGE, save_figure, styled, subplots
from p4dgs_ref.writer import best, bytes_at, front, of_every_seed, points_of, text_table
from .methods import ALIKE, AS_STORED, CODED, HALF, OURS

LEVELS = {"figure": 34.8, "glossy": 36.0}  # dB, which every step reaches
SINGLE = "preset=small_coded"  # in the labels of designs with single children
STEPS = {  # of each step the method, its storage, and what its labels must not have
    "D3DGS: its authors' network, float32": ("d3dgs", AS_STORED, None),
    "a network of our size": ("d3dgs_small", AS_STORED, None),
    "float16": ("d3dgs_small", HALF, None),
    "quantised and entropy coded": ("d3dgs_small", ALIKE, None),
    "prediction, context and rate: the paper's design": (OURS, ALIKE, None),
    "coded networks and positions: ours, four children": (CODED, AS_STORED, SINGLE),
    "single children where they are better: ours": (CODED, AS_STORED, None),
}
KINDS = {"network_bytes": ("network", BLUE), "gaussians_bytes": ("Gaussians, anchors", ORANGE)}
COLUMNS = {
    "scene": "{scene}, {psnr_db:g} dB",
    "step": "{step}",
    "bytes": "{bytes:,.0f}",
    "±": "{bytes_spread:,.0f}",
    "network": "{network_bytes:,.0f}",
    "Gaussians": "{gaussians_bytes:,.0f}",
    "times smaller": "{factor:.2f}",
}


def steps(rows):
    """The bytes of every step on the scenes of LEVELS, and how many times smaller it makes a file.

    Half the range over the seeds that reach the PSNR is `bytes_spread`. A step whose curve does not
    reach it has no bytes.
    """
    found, rows = [], of_every_seed(rows)
    for scene in LEVELS:
        own, before = [row for row in rows if row["scene"] == scene], None
        for step, (method, storage, without) in STEPS.items() if own else ():
            chosen = [
                row
                for row in own
                if (row["method"], row["storage"]) == (method, storage)
                and not (without and without in row["label"])
            ]
            found.append({"scene": scene, "psnr_db": LEVELS[scene], "step": step})
            found[-1] |= sizes_at(chosen, LEVELS[scene])
            size = found[-1].get("bytes")
            if size and before:
                found[-1]["factor"] = before / size
            before = size or before
    return found


def sizes_at(rows, level):
    """The bytes of a method and storage at a PSNR, with their spread over seeds; or nothing."""
    row = at(rows, level)
    seeds = {row["seed"] for row in rows}
    each = [at([row for row in rows if row["seed"] == seed], level) for seed in seeds]
    sizes = [one["bytes"] for one in each if one]
    return {**row, "bytes_spread": float(np.ptp(sizes) / 2)} if row and len(sizes) > 1 else row


def at(rows, level):
    """The bytes, and those of network and Gaussians, of the best points of rows at a PSNR."""
    points = {(p["bytes"], p["psnr_db"]): p for p in best(points_of(rows))}
    curve = front(points)
    if not len(curve) or not curve[0, 1] <= level <= curve[-1, 1]:
        return {}
    share = {
        kind: np.interp(level, curve[:, 1], [points[tuple(p)][kind] / p[0] for p in curve])
        for kind in KINDS
    }
    size = bytes_at(curve, level)
    return {"bytes": size, **{kind: float(size * of) for kind, of in share.items()}}


@styled()
def draw_steps(path, found):
    """Bytes of network and Gaussians after every step, and what it makes of the whole file.

    They are dots, because the length of a bar means nothing on a logarithmic axis.
    """
    scenes = [*dict.fromkeys(row["scene"] for row in found)]
    figure, axes = subplots(
        1, len(scenes), figsize=(13, 5.5), sharey=True, sharex=True, squeeze=False
    )
    for ax, scene in zip(axes[0], scenes):
        rows = [row for row in found if row["scene"] == scene]
        for i, row in enumerate(rows):
            text = "does not reach this PSNR"
            if "bytes" in row:
                for j, (kind, (_, color)) in enumerate(KINDS.items()):
                    ax.plot(row[kind], i + 0.24 * j - 0.12, "o", color=color, markersize=9)
                text = f"{row['bytes']:,.0f} bytes"
                text += f"\n{change(row['factor'])}" if "factor" in row else ""
            most = max([row.get(kind, 0) for kind in KINDS] + [1000])
            ax.annotate(text, (most, i), (10, 0), textcoords="offset points", va="center")
        level = LEVELS[scene]
        ax.set(
            xscale="log",
            xlim=(500, 3e7),
            xlabel="bytes of one part of the file",
            title=f"{scene}, every file at {level:g} dB",
        )
        ax.set_yticks(range(len(STEPS)), [broken(step) for step in STEPS])
        ax.set_ylim(len(STEPS) - 0.5, -0.5)
        ax.grid(axis="x", color="#dddddd", linewidth=0.7)
    for y, (name, color) in zip((0.09, 0.015), KINDS.values()):
        axes[0, -1].text(0.98, y, name, color=color, ha="right", transform=axes[0, -1].transAxes)
    save_figure(figure, path)


def change(factor):
    """How many times smaller or larger a step makes a file, as a text."""
    return f"÷ {factor:.1f}" if factor >= 1 else f"× {1 / factor:.1f}: larger"


def broken(step):
    """The name of a step in two lines."""
    return step.replace(": ", ":\n")


def to_lines(found):
    """The table as lines of text."""
    if not found:
        return []
    title = "Where the factor comes from: bytes at one PSNR, each step against the one above it"
    return [title, *text_table(COLUMNS, found), ""]
