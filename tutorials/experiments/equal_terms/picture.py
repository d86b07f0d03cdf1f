"""The picture of equal terms: curves, four steps as bands, and the paper's Table 3, on one axis."""

from p4dgs_ref.report.figures import (
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    figure_style,
    save_figure,
    subplots,
)

from ..tables.methods import PAPERS
from .curve import ALIKE, SCENES, STORED, chosen, curve_of
from .steps import STEPS, bands

CURVES = {  # method and storage: the name and its colour
    ("d3dgs", STORED): ("D3DGS, its authors' network, float32", RED),
    ("hexplane", STORED): ("4DHexPlane, float32", GREEN),
    ("gaussian4d", STORED): ("4DGS, float32", PINK),
    ("d3dgs_small", STORED): ("D3DGS, network of two layers, float32", ORANGE),
    (PAPERS, STORED): ("the paper's design, networks float16", BLUE),
    ("d3dgs_small", ALIKE): ("D3DGS, two layers, coded alike", ORANGE),
    (PAPERS, ALIKE): ("the paper's design, coded alike", BLUE),
}
SHADES = dict(zip(SCENES, ("0.15", "0.45", "0.7")))
TABLE_3 = {  # MB of the paper's T-Rex
    "D3DGS": 56.7,
    "+ spatial prediction": 7.27,
    "+ compact deformation MLP": 5.39,
    "+ quantisation, entropy coding": 0.85,
}


@figure_style()
def draw(rows, path):
    """Draw the curves above, the steps and the table below."""
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    figure, (top, below) = subplots(2, 1, figsize=(11, 10.5), sharex=True, height_ratios=(5, 6))
    for (method, storage), (name, color) in CURVES.items():
        points = curve_of(chosen(rows, method=method, storage=storage))
        full = "none" if storage == ALIKE else "full"
        look = dict(color=color, markersize=6, fillstyle=full, label=name)
        top.semilogx(*zip(*points), "o-", **look)
    top.set(ylabel="PSNR of test views here (dB)", ylim=(31, 37.5))
    top.legend(loc="lower right", frameon=False, fontsize=10)
    for i, step in enumerate(STEPS):
        for j, scene in enumerate(SCENES):
            for band in chosen(bands(rows), scene=scene, step=step):
                place, look = i + 0.24 * (j - 1), dict(height=0.2, color=SHADES[scene])
                width = max(band["most"] - band["least"], 0.03 * band["least"])
                below.barh(place, width, left=band["least"], **look, label=scene if not i else "")
    for i, (step, size) in enumerate(TABLE_3.items(), len(STEPS) + 1):
        below.barh(i, 1e6 * size - 5e3, left=5e3, height=0.6, color="#cfe3f2")
        below.text(1e6 * size, i, f" {size:g} MB", va="center", fontsize=11)
    names = [*STEPS, "", *(f"T-Rex: {step}" for step in TABLE_3)]
    below.set_yticks(range(len(names)), names, fontsize=11)
    below.set(ylim=(len(names) - 0.4, -0.6), xlim=(5e3, 2.5e8), xlabel="bytes of a file")
    below.xaxis.set(
        major_locator=LogLocator(),
        major_formatter=EngFormatter(sep=""),
        minor_formatter=NullFormatter(),
    )
    below.text(5.6e3, len(STEPS) - 0.15, "the paper's Table 3, at one quality", color="0.4")
    below.legend(loc="upper right", frameon=False, title="here, at equal PSNR")
    save_figure(figure, path)
