"""One drawing of P-4DGS: from anchors to the picture, and from anchors to the bits of the file.

    figure = architecture.draw_method()  # everything lit
    figure = architecture.draw_method(("step", "prior"))  # two equations lit, the others grey

Positions are literal, in hundredths of the drawing's width.
"""

from collections import namedtuple

from matplotlib.colors import to_rgb
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch
from matplotlib.path import Path

from p4dgs_ref import EQUATIONS
from p4dgs_ref.lessons import TUTORIALS
from p4dgs_ref.report.figures import figure_style
from tutorials.tools import figures

BLUE, RED, GREEN, PINK, ORANGE, SKY, BLACK = figures.COLORS
INK, DARK, GREY, WHITE = "#1a1a1a", "#606060", "#9a9a9a", "#ffffff"
WIDTH, HEIGHT = 100, 54.5
INCHES = 9.0  # of the width: 900 pixels at 100 dots an inch
ROW = 3.6  # from one box of a frame to the next
TITLE = 3.4  # height of a frame's title
GAP, MARGIN = 0.6, 0.7  # between the boxes of a frame, and around them
CENTRED = {"ha": "center", "va": "center_baseline"}


# A part of the method: a title over boxes, one for an equation. A key is that of the table of
# equations, which has the number, or one of its own where the table has none.
Frame = namedtuple("Frame", "title color left top width boxes")
Box = namedtuple("Box", "key text")
# What flows between the frames; x and y are its centre, and its ellipses are (x, y, width, height,
# angle, colour) about the centre.
Icon = namedtuple("Icon", "text x y ellipses framed", defaults=(False,))
# A line through points with its head at the last one, and a text with its centre `at` a point.
Arrow = namedtuple("Arrow", "points text at", defaults=("", (0, 0)))

FRAMES = (
    Frame(
        "spatial prediction",
        BLUE,
        13,
        54,
        19,
        (
            Box("offsets", r"$x = x_a + O_a \cdot l_a$"),
            Box("view", r"view $\delta_{vc},\ d_{vc}$"),
            Box("mlp", r"networks $\psi(f_a, \delta_{vc}, d_{vc})$"),
            Box("opacity", r"opacity $\alpha$"),
            Box("color", r"colour $c$"),
            Box("rotation", r"rotation $r$"),
            Box("scale", r"scale $s$"),
            Box("masking", r"mask, $\alpha \geq \tau_\alpha$"),
        ),
    ),
    Frame(
        "temporal prediction",
        GREEN,
        43,
        45,
        19,
        (
            Box("positional_encoding", r"encoding $\mathcal{E}(x),\ \mathcal{E}(t)$"),
            Box("deformation", r"$\psi_d$: $\Delta x, \Delta s, \Delta r$"),
            Box("deformed", r"$x + \Delta x$, …"),
        ),
    ),
    Frame(
        "splatting",
        SKY,
        73,
        45,
        12.5,
        (
            Box("covariance", r"covariance $\Sigma$"),
            Box("projection", "projection"),
            Box("compositing", "compositing"),
        ),
    ),
    Frame(
        "loss",
        DARK,
        86.5,
        27.5,
        13,
        (
            Box("ssim", "SSIM"),
            Box("render_loss", r"$\mathcal{L}_{render}$"),
            Box("total_loss", r"$\mathcal{L}_{total}$"),
        ),
    ),
    Frame(
        "context",
        ORANGE,
        13,
        15.2,
        15,
        (
            Box("hash_grid", r"hash grid $h$"),
            Box("step", r"step $q$"),
            Box("prior", r"prior $\mu,\ \sigma$"),
        ),
    ),
    Frame(
        "quantisation",
        RED,
        34,
        15.2,
        17,
        (
            Box("noise", r"training: noise"),
            Box("rounding", r"file: rounding"),
        ),
    ),
    Frame(
        "rate",
        PINK,
        58,
        18.8,
        13,
        (
            Box("likelihood", r"$-\log_2 p$"),
            Box("anchor_rate", r"$R_{anchor}$"),
            Box("hash_rate", r"$R_{hash}$"),
            Box("rate_loss", r"$\mathcal{L}_{rate}$"),
        ),
    ),
    Frame("coding", DARK, 75.5, 8.8, 13.5, (Box("entropy_coder", "entropy coder"),)),
    Frame("file", DARK, 92, 8.8, 7.5, (Box("file", "10110…"),)),
)
GAUSSIANS = (
    (-1.6, 1.2, 3.6, 1.6, 30, BLUE),
    (1.6, 1.5, 1.6, 2.6, 20, RED),
    (0.0, -1.0, 4.2, 1.5, -20, GREEN),
    (2.4, -1.2, 1.5, 2.2, 0, ORANGE),
)
MOVED = (
    (-1.2, 1.9, 3.6, 1.6, 70, BLUE),
    (2.2, 0.9, 1.6, 2.6, -15, RED),
    (-0.6, -0.8, 4.2, 1.2, 15, GREEN),
    (2.2, -1.8, 1.5, 1.6, 0, ORANGE),
)
CHILDREN = ((-0.9, 0.7), (1.1, 0.8), (-0.4, -1.1))  # about each anchor
ANCHORS = tuple(
    dot
    for x, y in ((-2.2, 1.6), (1.6, 0.9), (-0.4, -1.8))
    for dot in (
        (x, y, 1.1, 1.1, 0, BLACK),
        *((x + dx, y + dy, 0.6, 0.6, 0, BLUE) for dx, dy in CHILDREN),
    )
)
ICONS = (
    Icon("anchors", 5, 35.5, ANCHORS),
    Icon("canonical\nGaussians", 37.5, 37.5, GAUSSIANS),
    Icon("Gaussians\nat time $t$", 67.5, 37.5, MOVED),
    Icon("image", 93, 37.5, MOVED, True),
)
ARROWS = (
    Arrow(((9.2, 37.5), (13, 37.5)), "$x_a$", (11, 38.8)),
    Arrow(((32, 37.5), (34.5, 37.5))),
    Arrow(((40.6, 37.5), (43, 37.5))),
    Arrow(((62, 37.5), (64.5, 37.5))),
    Arrow(((70.6, 37.5), (73, 37.5))),
    Arrow(((85.5, 37.5), (89, 37.5))),
    Arrow(((93, 31), (93, 27.5))),
    Arrow(((5, 29.5), (5, 9), (13, 9)), "$x_a$", (11, 10.3)),
    Arrow(((6.5, 29.5), (6.5, 17.4), (39, 17.4), (39, 15.2)), "$f_a, s_a, l_a, O_a$", (14.3, 18.7)),
    Arrow(
        ((46, 15.2), (46, 19.6), (22, 19.6), (22, 21.2)),
        r"$\tilde f_a, \tilde s_a, \tilde l_a, \tilde O_a$",
        (39, 20.9),
    ),
    Arrow(((28, 9), (34, 9)), "$q$", (31, 10.2)),
    Arrow(((28, 2.4), (58, 2.4)), r"$\mu,\ \sigma$", (31, 3.6)),
    Arrow(((51, 9), (58, 9))),
    Arrow(((71, 14.5), (86.5, 14.5)), "bits per value", (78.5, 15.6)),
    Arrow(((71, 4.5), (75.5, 4.5)), "$p$", (73.2, 5.7)),
    Arrow(((89, 4.5), (92, 4.5))),
)


def show(name, *keys):
    """Show the drawing with what a tutorial explains lit, and save it as out/NUMBER_map.png.

    These are the boxes of its equations, or of `keys` where it explains none; without any, all.
    """
    own = {tutorial.name: tutorial.keys for tutorial in TUTORIALS}[name]
    figures.show(draw_method(own or keys), f"{name[:2]}_map")


@figure_style(figures.STYLE)
def draw_method(lit=(), dpi=100):
    """Return a figure of the method in which the boxes of the keys `lit` stand out, or all."""
    figure = figures.bare_pyplot().figure(figsize=(INCHES, INCHES * HEIGHT / WIDTH), dpi=dpi)
    paint(figure.add_axes((0, 0, 1, 1)), lit)
    return figure


@figure_style(figures.STYLE)
def save(path):
    """Write the drawing as a PNG, without matplotlib's version in it."""
    draw_method(dpi=150).savefig(path, metadata={"Software": None})


def paint(axes, lit=()):
    """Draw on axes that are WIDTH : HEIGHT."""
    axes.set(xlim=(0, WIDTH), ylim=(0, HEIGHT))
    axes.set_axis_off()
    for arrow in ARROWS:
        style = {"arrowstyle": "-|>", "mutation_scale": 8, "color": DARK, "linewidth": 1.2}
        axes.add_artist(FancyArrowPatch(path=Path(arrow.points), **style))
        write(axes, *arrow.at, arrow.text)
    for icon in ICONS:
        paint_icon(axes, icon, 0.3 if lit else 0.8)
    for frame in FRAMES:
        paint_frame(axes, frame, lit)


def paint_icon(axes, icon, alpha):
    if icon.framed:
        rounded(axes, icon.x - 4, icon.y - 4, 8, 8, WHITE, GREY)
    for x, y, width, height, angle, color in icon.ellipses:
        style = {"angle": angle, "color": color, "alpha": alpha, "lw": 0}
        axes.add_artist(Ellipse((icon.x + x, icon.y + y), width, height, **style))
    write(axes, icon.x, icon.y - 4.4, icon.text, va="top")


def paint_frame(axes, frame, lit):
    on = not lit or any(box.key in lit for box in frame.boxes)
    color, ink = (frame.color, INK) if on else (GREY, GREY)
    height = TITLE + ROW * len(frame.boxes) + MARGIN
    outer = frame.left, frame.top - height, frame.width, height
    rounded(axes, *outer, pale(color, 0.08), color)
    middle = frame.left + frame.width / 2
    write(axes, middle, frame.top - TITLE / 2, frame.title, color=ink, weight="bold")
    for i, box in enumerate(frame.boxes):
        on = not lit or box.key in lit
        color, ink = (frame.color, INK) if on else (GREY, GREY)
        y = frame.top - TITLE - ROW * (i + 1) + GAP / 2
        edge = 1.8 if lit and on else 0.8
        inner = frame.left + MARGIN, y, frame.width - 2 * MARGIN, ROW - GAP
        rounded(axes, *inner, pale(color, 0.3) if on else WHITE, color, edge)
        y, number = y + (ROW - GAP) / 2, number_of(box.key)
        write(axes, frame.left + 2 * MARGIN, y, number, color=ink, weight="bold", ha="left")
        write(axes, middle + 1.6 * bool(number), y, box.text, color=ink)


def number_of(key):
    """The number of an equation, "(3)" or "(3')"; "" where the paper prints none."""
    number = EQUATIONS[key].number if key in EQUATIONS else ""
    return f"({number})" if number else ""


def write(axes, x, y, text, size=8.5, color=INK, **style):
    axes.text(x, y, text, size=size, color=color, **{**CENTRED, **style})


def rounded(axes, x, y, width, height, face, edge, linewidth=0.9):
    style = {"boxstyle": "round,pad=0,rounding_size=0.6", "fc": face, "ec": edge, "lw": linewidth}
    axes.add_artist(FancyBboxPatch((x, y), width, height, **style))


def pale(color, share):
    """A colour mixed with white."""
    return tuple(1 - share * (1 - part) for part in to_rgb(color))
