"""The picture `accuracy.png`: six panels, each with its answer as its title, from the record alone.

Each function below takes the rows of the record by knob and returns the title of a panel, its
points, and properties of its axes. A point has x with its quartiles, y, the value that is its
label, and whether it is `ours`, the setting that this project uses.
"""

from textwrap import fill

from ...report.figures import save_figure, styled, subplots
from ..clock import can_tell, disturbance
from ..writer import grouped
from .diagram import lines, place_labels, readable_ticks
from .forms import LANES
from .formulas import TABLE
from .knobs import PSNR
from .verdicts import by_knob, in_words, lost, points, short, stretch

WIDTH = 44  # letters of a title's line
STYLE = {"font.size": 10, "axes.titlesize": 11, "axes.titleweight": "bold", "figure.dpi": 100}


def point(row, y, label=None, ours=False, unit="ms", scale=1.0, **others):
    """A point of a panel at the time of a row."""
    ends = {f"x{end}": scale * row[f"{unit}{end}"] for end in ("", "_low", "_high")}
    value = "ours: " * ours + (label or row["value"])
    return {"line": row["line"], **ends, "y": y, "value": value, "ours": ours, **others}


def by_value(rows, line=None):
    """The points of a line of a knob, {value: row}."""
    return {row["value"]: row for row in points(rows) if line in (None, row["line"])}


def frame(of):
    """What a picture costs, from exact to fast and as the published kernel."""
    exact, fast, paper = by_value(of["renderer"], "a frame").values()
    smallest = 0.1 * min(fast["error"], paper["error"])  # stands for the zero of `exact`
    shown = [
        point(exact, 255 * smallest, "exact (no error)"),
        point(fast, 255 * fast["error"], ours=True),
        point(paper, 255 * paper["error"], "3DGS's kernel"),
    ]
    title = (
        f"A frame in {short(fast['ms'])} ms instead of {short(exact['ms'])}, "
        f"{255 * fast['error']:.1g} grey levels off"
    )
    return title, shown, dict(ylabel="largest error (grey levels of 255)", joined=False)


def symbol(of):
    """Eq. (11) over the declared domain, in both precisions."""
    called = {"literal": "printed: ∞", "HAC, floor 1e-6": "HAC's floor", TABLE: "table"}
    rows = {
        dtype: by_value(of["likelihood"], f"the declared domain, {dtype}")
        for dtype in ("float64", "float32")
    }
    shown = [
        point(
            rows[dtype][value],
            rows[dtype][value]["bits_error"],
            label,
            value == "stable",
            scale=1e6 / rows[dtype][value]["symbols"],
            line=dtype,
        )
        for dtype in rows
        for value, label in {"stable": f"stable, {dtype}", **called}.items()
    ]
    stable, printed = rows["float64"]["stable"], rows["float64"]["literal"]
    title = (
        f"Eq. (11) as printed fails in {100 * printed['failed_share']:.0f} % of bins; "
        f"ours errs by {stable['bits_error']:.0e}"
    )
    if can_tell(stable, printed):
        title += f" in {stable['ms'] / printed['ms']:.1f} times the time"
    axes = dict(xlabel="processor time (ns)", ylabel="worst error of the bits (relative)")
    return title, shown, {**axes, "joined": False}


def noise(of):
    """How well draws of the quantisation noise know the expected bits."""
    rows = by_value(of["noise draws"])
    shown = [
        point(row, 100 * row["error"], f"{value} draw{'s' * (value != '1')}", value == "1")
        for value, row in rows.items()
    ]
    title = (
        f"One draw knows the bits to {100 * rows['1']['error']:.2g} %; "
        f"64 draws cost {rows['64']['ms'] / rows['1']['ms']:.0f} times as much"
    )
    return title, shown, dict(ylabel="error of the expected bits (%)")


def training(of):
    """PSNR over the seconds of trainings, by iterations of the paper's design and by presets."""
    rows = [{**row, "line": "tiny"} for row in of["iterations"]]
    rows += [{**row, "line": row["value"]} for row in of["preset"] if row["value"] != "tiny"]
    (full, half), groups = [*by_value(of["iterations"])][:2], grouped(rows, "line", "value")
    shown = [
        point(
            row,
            row["psnr_db"],
            f"{'tiny: ' * (row['value'] == full)}{row['iterations']:,.0f}"
            if row["line"] == "tiny"
            else None,
            unit="seconds",
            each=[one["psnr_db"] for one in groups[row["line"], row["value"]]],
        )
        | {"ours": row["value"] == full}
        for row in points(rows)
    ]
    before, after = (groups["tiny", value] for value in (full, half))
    title = (
        f"Half of the iterations: {in_words(PSNR, *lost(PSNR, after, before))}, "
        f"{short(after[0]['seconds'])} s instead of {short(before[0]['seconds'])}"
    )
    axes = dict(xlabel="training (s), by iterations", ylabel="PSNR (dB)", yscale="linear")
    return title, shown, axes


def file(of):
    """The entropy coder: bytes above the entropy."""
    shown = [
        point(
            row,
            row["above_bytes"],
            {LANES: line, "zlib": f"zlib, {line}"}.get(value),
            value == LANES,
            line=f"{line} {value == 'zlib'}",
        )
        for line in ("encode", "decode")
        for value, row in by_value(of["coder"], line).items()
        if value != "8 lanes"  # slower than one lane here
    ]
    rows = by_value(of["coder"], "encode")
    title = (
        f"Our coder adds {rows[LANES]['above_bytes']:.0f} bytes to "
        f"{rows[LANES]['entropy_bytes']:,.0f} of entropy, {100 * rows[LANES]['error']:.1g} %; "
        f"zlib adds {100 * rows['zlib']['error']:.0f} %"
    )
    return title, shown, dict(ylabel="bytes above the entropy")


def kernels(of):
    """A training step with pinned kernels and with the processor's own."""
    pinned, native = points(of["same bytes everywhere"])
    title = (
        f"The same bytes everywhere cost {100 * (1 - native['ms'] / pinned['ms']):.0f} % of a "
        "training step"
        if can_tell(pinned, native)
        else "Cannot tell what the same bytes everywhere cost"
    )
    shown = [
        point(row, 100 * row["error"], f"{name}, {short(row['ms'])} ms", row is pinned, line=name)
        for name, row in {"pinned": pinned, "native": native}.items()
    ]
    axes = dict(xlabel="a training step (ms)", ylabel="numbers that differ (%)", yscale="linear")
    return title, shown, axes


PANELS = {  # what draws each panel, and the knobs that it needs
    frame: ["renderer"],
    symbol: ["likelihood"],
    noise: ["noise draws"],
    training: ["iterations", "preset"],
    file: ["coder"],
    kernels: ["same bytes everywhere"],
}


def draw_panel(ax, title, shown, settings):
    """Draw the points of a panel with its answer as title."""
    joined = settings.pop("joined", True)
    ax.set(**{"xscale": "log", "yscale": "log", "xlabel": "processor time (ms)", **settings})
    ax.set_title(fill(title, WIDTH), loc="left")
    ax.margins(0.5, 0.15)
    lines(ax, shown, "x", "y", joined)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            readable_ticks(axis)


@styled({**STYLE, "font.size": 10.5, "figure.dpi": 200})
def draw_front(path, rows):
    """Draw the first lines of four panels below each other, for a picture that is shown small."""
    of = by_knob(rows)
    figure, axes = subplots(4, figsize=(4.2, 6.6), layout=None)
    figure.subplots_adjust(0.125, 0.035, 0.98, 0.91, hspace=1.12)
    for ax, panel in zip(axes, (frame, symbol, noise, training)):
        title, shown, settings = panel(of)
        draw_panel(ax, "", [row for row in shown if row["line"] == shown[0]["line"]], settings)
        words = f"↑ {ax.get_ylabel()}  → {ax.get_xlabel()}"
        ax.set(xlabel="", ylabel="", xmargin=0.4, ymargin=0.6)
        if ax.get_yscale() == "log":
            readable_ticks(ax.yaxis)
        ax.text(-0.13, 1.36, fill(title, WIDTH), fontweight="bold", transform=ax.transAxes)
        ax.text(-0.13, 1.13, words, color="#505050", fontsize=9.1, transform=ax.transAxes)
        ax.locator_params(axis="y", **{"numticks" if ax.get_yscale() == "log" else "nbins": 3})
    place_labels(figure)
    save_figure(figure, path)


@styled(STYLE)
def draw_answers(path, rows):
    """Draw the picture from the rows of a record; a panel without its knobs says so.

    Returns whether any panel has them; without one there is no picture.
    """
    of = by_knob(rows)
    figure, axes = subplots(3, 2, figsize=(9, 12))
    answered = {panel: {*needs} <= {*of} for panel, needs in PANELS.items()}
    for ax, panel in zip(axes.flat, PANELS):
        if not answered[panel]:
            ax.set_axis_off()
            words = f"not measured in this run:\n{', '.join(PANELS[panel])}"
            ax.text(0.5, 0.5, words, ha="center")
            continue
        draw_panel(ax, *panel(of))
    notes = (
        "A star is what this project uses. Bars go from quartile to quartile.",
        disturbance(stretch(rows)),
    )
    figure.supxlabel(fill(" ".join(notes), 130), fontsize=9, ha="left", x=0.01)
    place_labels(figure)
    if any(answered.values()):
        save_figure(figure, path)
    return any(answered.values())
